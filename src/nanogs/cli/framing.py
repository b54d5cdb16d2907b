"""`--frame`: the coordinate frame a model is in, and the one it is written in."""

from pathlib import Path

from nanogs.cli.file_options import Frames
from nanogs.errors import OptionError
from nanogs.frames import TRAINED
from nanogs.io import open as open_model
from nanogs.io import registry
from nanogs.io.collect import Pair


def frames_of(pair: Pair, given: Frames | None) -> tuple[str, str] | None:
    """Return the frames (from, to) of a file, from the option and the formats; None without one.

    Raises:
        OptionError: A frame is missing or contradicts the format or the file.
    """
    if given is None:
        return None
    before, after = given
    return _frame_read(pair.source, before, after), _frame_written(pair.target, before, after)


def _frame_read(path: Path, before: str, after: str) -> str:
    known = registry.reader(path)
    if known.turns:
        if before:
            raise OptionError(
                f"{path}: {known.suffix} states its frame; give that of the output alone."
            )
        return TRAINED
    stated = known.axes or _stated(path)
    if not before and not stated:
        raise OptionError(
            f"{path}: {known.suffix} files differ in their frame and this one does not say it;"
            f" state it too, as in --frame rub:{after}."
        )
    if known.axes is None and before and stated and before.lower() != stated:
        raise OptionError(
            f"{path} states its frame, {stated}, and --frame says {before}; leave the latter out,"
            f" as in --frame {after or TRAINED}."
        )
    return before or stated


def _stated(path: Path) -> str:
    with open_model(path) as source:
        return source.frame


def _frame_written(path: Path, before: str, after: str) -> str:
    known = registry.writable(path)
    if known.turns:
        if after:
            raise OptionError(
                f"{path}: {known.suffix} has a frame of its own; say only what the input is in, as"
                f" in --frame {before or 'rub'}:"
            )
        return TRAINED
    if not after:
        raise OptionError(f"{path}: say which frame it is to be in, as in --frame {before}:rdf.")
    return after
