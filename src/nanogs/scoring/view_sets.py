"""Sets of views that models are compared on: kinds of cameras, each at several picture sizes."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from nanogs.errors import OptionError, did_you_mean
from nanogs.formatting import counted
from nanogs.protocol import Kind, usual_views
from nanogs.raster.camera import Camera
from nanogs.source import Source
from nanogs.splats import Splats
from nanogs.views.cameras import FOUND, cameras_for

Size: TypeAlias = tuple[int, int]  # width and height, pixels


@dataclass(frozen=True, slots=True, eq=False)
class ViewSet:
    """Views of one kind and one size.

    Attributes:
        cameras: The views.
        kind: Kind of the views.
        notes: Remarks that matter for reading the numbers.
    """

    cameras: Sequence[Camera]
    kind: Kind
    notes: tuple[str, ...] = ()


def parse_sources(text: str) -> list[str]:
    """Split kinds of cameras at commas, such as "auto,roam"; anything else is the path of a file.

    Raises:
        OptionError: Some are kinds and some are not.
    """
    names = [name.strip() for name in text.split(",")]
    others = [name for name in names if name not in FOUND]
    if others and len(others) < len(names) and not Path(text).exists():
        meant = did_you_mean(others[0], FOUND)
        raise OptionError(
            f"{others[0]!r} is not a kind of cameras{meant}; choose from {', '.join(FOUND)}, or"
            " give a camera file alone."
        )
    return [text] if others else names


def found_views(sources: Sequence[str], views: int | None) -> list[int]:
    """Return the number of views requested of each source; 0 for a camera file."""
    return [
        0 if source not in FOUND else usual_views(source) if views is None else views
        for source in sources
    ]


def view_sets(
    model: Splats | Source,
    sources: Sequence[str],
    sizes: Sequence[Size],
    *,
    views: int | None = None,
    up: Sequence[float] | None = None,
) -> list[ViewSet]:
    """Return test views of each source at each size, in that order.

    The views of a source are the same at all sizes of one aspect ratio.

    Args:
        model: The original.
        sources: Names in `nanogs.views.cameras.FOUND`, or one camera file.
        sizes: Sizes of automatic views.
        views: Number of views of each source; None for the usual number.
        up: (3,) up direction of automatic views; by default found from the original.

    Raises:
        NanogsError: A source or a size is given twice, several sizes are given with a camera file,
            or cameras cannot be found or read.
    """
    for what, values in (("kind of cameras", sources), ("size", sizes)):
        if len(set(values)) < len(values):
            raise OptionError(f"A {what} is given twice; name each once.")
    if not sizes or min(map(min, sizes)) < 1:
        shown = " and ".join(f"{width} x {height}" for width, height in sizes) or "none"
        raise OptionError(f"Views need at least one size, of 1 pixel or more, not {shown}.")
    others = [source for source in sources if source not in FOUND]
    if others and len(sizes) > 1:
        raise OptionError(
            f"Several sizes cannot be given for the cameras of {others[0]}, which have sizes of"
            " their own; give one size, or automatic views."
        )
    counts = found_views(sources, views)
    return [
        made
        for source, count in zip(sources, counts, strict=True)
        for made in _of_source(model, source, sizes, count, up)
    ]


def _of_source(
    model: Splats | Source,
    source: str,
    sizes: Sequence[Size],
    count: int,
    up: Sequence[float] | None,
) -> list[ViewSet]:
    """Return the views of one source, at each size."""
    made: list[ViewSet] = []
    shapes: dict[float, list[Camera]] = {}
    for width, height in sizes:
        shape = width / height
        if shape not in shapes:
            shapes[shape] = cameras_for(
                model, source, count=count, width=width, height=height, up=up
            )
        cameras = shapes[shape]
        notes: tuple[str, ...] = ()
        if source in FOUND:
            cameras = [camera.resized(width, height) for camera in cameras]
            notes = _missing(source, len(cameras), count)
        made.append(ViewSet(cameras, FOUND.get(source, "given"), notes))
    return made


def _missing(source: str, found: int, asked: int) -> tuple[str, ...]:
    if found == asked:
        return ()
    return (f"{source}: {counted(found, 'view was', 'views were')} found of {asked} asked for",)
