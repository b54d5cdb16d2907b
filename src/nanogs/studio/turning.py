"""Which way is up: the frame that a model is in by that, and the one that its file is to be in."""

from collections.abc import Sequence
from pathlib import Path

from nanogs.errors import OptionError
from nanogs.frames import TRAINED, Y_UP
from nanogs.io import registry
from nanogs.io.parts import FileSource

FRAMES = {"-y": "rdf", "+y": "rub", "+z": "rfu", "-z": "rbd", "+x": "ubr", "-x": "dfr"}
"""Frames that are turns of each other, by the axis that points up in them."""


def direction_of(up: str) -> tuple[float, float, float]:
    """The unit vector of an axis with its sign, such as "-y"."""
    sign = -1.0 if up[0] == "-" else 1.0
    x, y, z = (sign if axis == up[1] else 0.0 for axis in "xyz")
    return x, y, z


def up_of(direction: Sequence[float]) -> str:
    """The axis with its sign that is nearest to a direction."""
    axis = max(range(3), key=lambda each: abs(direction[each]))
    return ("-" if direction[axis] < 0 else "+") + "xyz"[axis]


def axis_of(direction: Sequence[float]) -> str:
    """The axis with its sign along which a direction is.

    Raises:
        OptionError: It is along none.
    """
    if sum(value != 0 for value in direction) != 1:
        raise OptionError(
            "The studio takes an axis as `up`, such as 0,0,1; turn a model that leans first."
        )
    return up_of(direction)


def stated_up(source: FileSource, path: Path) -> str | None:
    """The axis that a file says, or its format, is up; None where neither does.

    Args:
        source: The file, open.
        path: Its name.
    """
    known = registry.reader(path)
    frame = known.axes or source.frame
    return next((up for up, name in FRAMES.items() if name == frame), None)


def states_frame(source: FileSource, path: Path) -> bool:
    """Whether a file itself states its frame, so that nobody can say another."""
    known = registry.reader(path)
    return known.turns or (known.axes is None and bool(source.frame))


def frames_to(up: str, target: Path) -> tuple[str, str]:
    """The frames from and to which a model is turned that is upright with an axis up.

    Args:
        up: That axis.
        target: What is to be written, or a model of it; only its suffix counts.

    Returns:
        Names of frames, the second empty where the format has a frame of its own.

    Raises:
        OptionError: The format is not written.
    """
    known = registry.writable(target)
    return FRAMES[up], "" if known.turns else known.axes or Y_UP


def turned(frames: tuple[str, str] | None) -> tuple[str, str] | None:
    """Frames as the library takes them, of which none is empty."""
    return frames and (frames[0], frames[1] or TRAINED)


def refuse_stated(name: str) -> OptionError:
    """The error of a model whose file says which way is up, where another one is chosen."""
    return OptionError(
        f"{name} states its frame, so that another way up would contradict it; save it without, or"
        " convert it to .ply first and open that."
    )
