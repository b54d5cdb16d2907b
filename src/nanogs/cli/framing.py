"""`--frame`: the coordinate frame a model is in, and the one it is written in."""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from nanogs.cli.file_options import Frames
from nanogs.errors import OptionError
from nanogs.frames import TRAINED, Y_UP
from nanogs.io import open as open_model
from nanogs.io import registry
from nanogs.io.frames import refuse_mixed_frames


def frames_of(
    sources: Sequence[Path], target: Path, given: Frames | None, called: Path | None = None
) -> tuple[str, str] | None:
    """Return the frames (from, to) of a model, from the option and the formats; None without one.

    Args:
        sources: Its files; without a frame before the colon, they must all be in one frame.
        target: The output.
        given: The option.
        called: Name of the output in messages, if it is not one file.

    Raises:
        ModelError: No frame is given for files that are in different frames.
        OptionError: A frame is missing or contradicts the format or the file.
    """
    if given is None:
        return None
    before, after = given
    read = [_frame_read(path, before, after) for path in sources]
    known = set(read) - {""}
    if len(known) > 1 and not before:
        with ExitStack() as stack:
            refuse_mixed_frames([stack.enter_context(open_model(path)) for path in sources])
    if "" in read:
        path = sources[read.index("")]
        suffix, likely = registry.reader(path).suffix, next(iter(known), Y_UP)
        raise OptionError(
            f"The frame of {path} is not known, because {suffix} files use different frames and"
            f" this one does not state its own; give it too, as in --frame {likely}:{after}."
        )
    # All are the same now, or the frame before the colon applies to every file that states none.
    return before or read[0], _frame_written(target, before, after, called or target)


def turned(source: Path) -> tuple[str, str]:
    """Return the frames (from, to) that --turn stands for.

    Raises:
        OptionError: Files of this format are turned when they are read.
    """
    known = registry.reader(source)
    if known.turns:
        raise OptionError(
            f"{source} is turned when it is read, as all {known.suffix} files are; leave out"
            " --turn."
        )
    return Y_UP, TRAINED


def _frame_read(path: Path, before: str, after: str) -> str:
    """Return the frame of a file as it is read; empty if nothing says it."""
    known = registry.reader(path)
    if known.turns:
        if before not in ("", TRAINED):
            raise OptionError(
                f"The frame of {path} cannot be chosen, because {known.suffix} files state it"
                " themselves; give only the frame of OUT."
            )
        return TRAINED
    stated = known.axes or _stated(path)
    if known.axes is None and before and stated and before != stated:
        raise OptionError(
            f"{path} states the frame {stated}, but --frame says {before}; leave that out, as in"
            f" --frame {after or TRAINED}."
        )
    return before or stated


def _stated(path: Path) -> str:
    with open_model(path) as source:
        return source.frame


def _frame_written(path: Path, before: str, after: str, called: Path) -> str:
    known = registry.writable(path)
    if known.turns:
        if after:
            raise OptionError(
                f"The frame of {called} cannot be chosen, because all {known.suffix} files use the"
                f" same one; give that of IN alone, with --frame {before or 'rub'}: and nothing"
                " after the colon."
            )
        return TRAINED
    if not after:
        raise OptionError(
            f"The frame of {called} is missing; give it too, as in --frame {before}:rdf."
        )
    return after
