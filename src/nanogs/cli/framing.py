"""`--frame`: the frame a model is in, and the one it is to be written in."""

from pathlib import Path

from nanogs.errors import OptionError
from nanogs.frames import TRAINED, checked_frame
from nanogs.io import registry
from nanogs.io.collect import Pair

Frames = tuple[str, str]
"""From and to."""


def parse_frames(text: str | None) -> Frames | None:
    """The frames before and after the colon, empty where none is given.

    Raises:
        OptionError: One of them is no frame, or there is none.
    """
    if text is None:
        return None
    before, colon, after = text.partition(":")
    given = (before, after) if colon else ("", before)
    checked = tuple(checked_frame(name) if name else "" for name in given)
    if not any(checked):
        raise OptionError("--frame needs a frame, like rub or rdf:rub.")
    return checked[0], checked[1]


def frames_of(pair: Pair, given: Frames | None) -> Frames | None:
    """Frames from and to which a file is turned, by option and formats; None without an option.

    Raises:
        OptionError: A frame is missing or contradicts what a format says.
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
    if not before and known.axes is None:
        raise OptionError(
            f"{path}: {known.suffix} files differ in their frame and do not say it; state it too,"
            f" as in --frame rub:{after}."
        )
    return before or known.axes or TRAINED


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
