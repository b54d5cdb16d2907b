"""Up axes and frames: the frame of a model by its up axis, and the frame of the file to write."""

from collections.abc import Sequence
from pathlib import Path

from nanogs.errors import OptionError
from nanogs.frames import TRAINED, Y_UP
from nanogs.io import registry
from nanogs.io.parts import FileSource

FRAMES = {"-y": "rdf", "+y": "rub", "+z": "rfu", "-z": "rbd", "+x": "ubr", "-x": "dfr"}
"""Frames that are rotations of each other, by the axis that points up."""


def direction_of(up: str) -> tuple[float, float, float]:
    """Return the unit vector of a signed axis, such as "-y"."""
    sign = -1.0 if up[0] == "-" else 1.0
    x, y, z = (sign if axis == up[1] else 0.0 for axis in "xyz")
    return x, y, z


def up_of(direction: Sequence[float]) -> str:
    """Return the signed axis that is nearest to a direction."""
    axis = max(range(3), key=lambda each: abs(direction[each]))
    return ("-" if direction[axis] < 0 else "+") + "xyz"[axis]


def axis_of(direction: Sequence[float]) -> str:
    """Return the signed axis to which a direction is parallel.

    Raises:
        OptionError: It is not parallel to an axis.
    """
    if sum(value != 0 for value in direction) != 1:
        raise OptionError(
            "In the studio, `up` must be an axis, such as 0,0,1; rotate a tilted model first."
        )
    return up_of(direction)


def stated_up(source: FileSource, path: Path) -> str | None:
    """Return the up axis that a file or its format states; None if neither does.

    Args:
        source: The open file.
        path: Its path.
    """
    known = registry.reader(path)
    letters = zip("xyz", known.axes or source.frame, strict=False)  # no letters if none is stated
    return next(
        (("+" if letter == "u" else "-") + axis for axis, letter in letters if letter in "ud"), None
    )


def states_frame(source: FileSource, path: Path) -> bool:
    """Return whether a file itself states its frame, which then cannot be changed."""
    known = registry.reader(path)
    return known.turns or (known.axes is None and bool(source.frame))


def frames_to(up: str, target: Path) -> tuple[str, str]:
    """Return the source and target frame for writing a model whose up axis is given.

    Args:
        up: Up axis of the model.
        target: The output file, or a model file of levels; only its suffix counts.

    Returns:
        Names of the frames; the second is empty if the format has a frame of its own.

    Raises:
        OptionError: The format cannot be written.
    """
    known = registry.writable(target)
    return FRAMES[up], "" if known.turns else known.axes or Y_UP


def turned(frames: tuple[str, str] | None) -> tuple[str, str] | None:
    """Replace an empty target frame by the one that the library expects."""
    return frames and (frames[0], frames[1] or TRAINED)
