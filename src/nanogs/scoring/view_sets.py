"""Sets of views that models are compared on: kinds of cameras, each at several picture sizes."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from os import PathLike, fspath
from pathlib import Path
from typing import NamedTuple, TypeAlias

from nanogs.errors import OptionError, did_you_mean
from nanogs.formatting import counted
from nanogs.paths import exists
from nanogs.protocol import Kind, usual_views
from nanogs.ranges import one_or_several
from nanogs.raster.camera import Camera
from nanogs.source import Source
from nanogs.splats import Splats
from nanogs.views.cameras import (
    FOUND,
    Cameras,
    cameras_for,
    cameras_from,
    given_cameras,
    picture_size,
    refuse_beside_given,
    view_count,
)
from nanogs.views.plan import FEWER_CAMERAS

Size: TypeAlias = tuple[int, int]  # width and height, pixels
Pixels: TypeAlias = int | tuple[int, int] | list[int] | list[tuple[int, int]]


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


class Photographs(NamedTuple):
    """Photographs that models are compared with; see `scoring.photos.photographs`.

    Attributes:
        folder: Folder of the data set.
        images: Folder of the photographs in a COLMAP data set, or None.
        split: "test" or "train".
    """

    folder: Path
    images: str | None = None
    split: str = "test"


@dataclass(frozen=True, slots=True)
class ComparedViews:
    """Views before any is computed: cameras, or else kinds and sizes of automatic views.

    Attributes:
        cameras: The views themselves; empty if there are kinds of automatic views.
        kinds: Kinds of automatic views.
        sizes: Sizes of automatic views.
        count: Number of automatic views of each kind; None for the usual number.
        up: (3,) up direction of automatic views; None to find it from the original.
    """

    cameras: Sequence[Camera]
    kinds: Sequence[str] = ()
    sizes: Sequence[Size] = ()
    count: int | None = None
    up: Sequence[float] | None = field(default=None, compare=False)

    @property
    def counts(self) -> list[int]:
        """Number of views of each set of one size."""
        return [len(self.cameras)] if self.cameras else found_views(self.kinds, self.count)

    @property
    def pixels(self) -> list[int]:
        """Pixels of a view of each size; of given cameras, those of the largest."""
        sizes = [(camera.width, camera.height) for camera in self.cameras]
        if sizes:
            return [max(width * height for width, height in sizes)]
        return [width * height for width, height in self.sizes]

    @property
    def sets_count(self) -> int:
        """Number of sets of views."""
        return len(self.counts) * len(self.pixels)

    @property
    def pictures(self) -> tuple[int, int]:
        """Pixels of the largest view, and number of views of the largest set."""
        return max(self.pixels, default=0), max(self.counts, default=0)

    @property
    def remedy(self) -> str:
        """Advice if these views take too much memory, as the end of a message."""
        if self.cameras:
            return f"{FEWER_CAMERAS}, or compare smaller models"
        return "compare fewer or smaller views (`views`, `pixels`) or smaller models"

    def sets(self, model: Splats | Source) -> list[ViewSet]:
        """Return the sets of views; automatic ones are computed from the model."""
        if self.cameras:
            return [ViewSet(self.cameras, "given")]
        return view_sets(model, self.kinds, self.sizes, views=self.count, up=self.up)


def compared_views(
    cameras: Cameras | Sequence[str],
    pixels: Pixels,
    views: int | None = None,
    up: Sequence[float] | None = None,
) -> ComparedViews:
    """Parse the views that are requested; arguments and errors are those of `nanogs.compare`."""
    names, count = one_or_several(cameras), None if views is None else view_count(views)
    kinds = [fspath(name) for name in names if isinstance(name, str | PathLike)]
    several = pixels if isinstance(pixels, list) else [pixels]
    if not kinds or len(kinds) < len(names):
        found = ComparedViews(given_cameras(names))
    else:
        found = views_from(kinds, [picture_size(size) for size in several], count, up)
    if found.cameras:
        refuse_beside_given(up, count, several)
    return found


def views_from(
    kinds: Sequence[str],
    sizes: Sequence[Size],
    count: int | None = None,
    up: Sequence[float] | None = None,
) -> ComparedViews:
    """Return automatic views of some kinds, or cameras of a file, read now as they take memory.

    Args:
        kinds: Kinds of automatic views, or one text as for `parse_kinds`.
        sizes: Sizes of automatic views.
        count: Number of automatic views of each kind; None for the usual number.
        up: (3,) up direction of automatic views, or None.

    Raises:
        NanogsError: As for `view_sets`, or a camera file cannot be read.
    """
    names = parse_kinds(kinds[0]) if len(kinds) == 1 else list(kinds)
    _refuse(names, sizes)
    if len(names) == 1 and names[0] not in FOUND:
        return ComparedViews(cameras_from(names[0]))
    return ComparedViews([], names, sizes, count, up)


def refuse_beside_views(photos: str | PathLike[str] | None, images: str | None, split: str) -> None:
    """Refuse options of photographs if there are none.

    Args:
        photos: Folder of the data set, or None.
        images: Folder of the photographs in it, or None.
        split: "test", the default, or another one.

    Raises:
        OptionError: One of these is given without `photos`.
    """
    if photos is None and (images is not None or split != "test"):
        raise OptionError(
            "`images` and `split` work only with photographs; name their data set with `photos`."
        )


def refuse_beside_photos(photos: str | PathLike[str] | None, *, views: bool) -> None:
    """Refuse options for views beside photographs, which would have no effect.

    Args:
        photos: Folder of the data set, or None.
        views: Whether views other than the usual automatic ones are asked for.

    Raises:
        OptionError: Both are given.
    """
    if photos is not None and views:
        raise OptionError(
            "`photos` cannot be combined with options for views, because photographs have views of"
            " their own; leave these options out."
        )


def parse_kinds(text: str) -> list[str]:
    """Split kinds of cameras at commas, such as "auto,roam"; anything else is the path of a file.

    Raises:
        OptionError: Some are kinds and some are not.
    """
    names = [name.strip() for name in text.split(",")]
    others = [name for name in names if name not in FOUND]
    if others and len(others) < len(names) and not exists(text):
        meant = did_you_mean(others[0], FOUND)
        raise OptionError(
            f"{others[0]!r} is not a kind of cameras{meant}; choose from {', '.join(FOUND)}, or"
            " give a camera file alone."
        )
    return [text] if others else names


def found_views(kinds: Sequence[str], views: int | None) -> list[int]:
    """Return the number of views requested of each kind; 0 for a camera file in its place."""
    return [
        0 if kind not in FOUND else usual_views(kind) if views is None else views for kind in kinds
    ]


def view_sets(
    model: Splats | Source,
    kinds: Sequence[str],
    sizes: Sequence[Size],
    *,
    views: int | None = None,
    up: Sequence[float] | None = None,
) -> list[ViewSet]:
    """Return test views of each kind at each size, in that order.

    The views of a kind are the same at all sizes of one aspect ratio.

    Args:
        model: The original.
        kinds: Names in `nanogs.views.cameras.FOUND`, or in their place one camera file.
        sizes: Sizes of automatic views.
        views: Number of views of each kind; None for the usual number.
        up: (3,) up direction of automatic views; by default found from the original.

    Raises:
        NanogsError: A kind or a size is given twice, several sizes are given with a camera file,
            or cameras cannot be found or read.
    """
    _refuse(kinds, sizes)
    counts = found_views(kinds, views)
    return [
        made
        for kind, count in zip(kinds, counts, strict=True)
        for made in _of_kind(model, kind, sizes, count, up)
    ]


def _refuse(kinds: Sequence[str], sizes: Sequence[Size]) -> None:
    """Refuse repeated kinds and sizes, sizes below 1, and several sizes of a file's cameras."""
    for what, values in (("kind of cameras", kinds), ("size", sizes)):
        if len(set(values)) < len(values):
            raise OptionError(f"A {what} is given twice; name each once.")
    if not sizes or min(map(min, sizes)) < 1:
        shown = " and ".join(f"{width} x {height}" for width, height in sizes) or "none"
        raise OptionError(f"Views need at least one size, of 1 pixel or more, not {shown}.")
    others = [kind for kind in kinds if kind not in FOUND]
    if others and len(sizes) > 1:
        raise OptionError(
            f"Several sizes cannot be given for the cameras of {others[0]}, which have sizes of"
            " their own; give one size, or automatic views."
        )


def _of_kind(
    model: Splats | Source,
    kind: str,
    sizes: Sequence[Size],
    count: int,
    up: Sequence[float] | None,
) -> list[ViewSet]:
    """Return the views of one kind, or of a camera file, at each size."""
    made: list[ViewSet] = []
    shapes: dict[float, list[Camera]] = {}
    for width, height in sizes:
        shape = width / height
        if shape not in shapes:
            shapes[shape] = cameras_for(model, kind, count=count, width=width, height=height, up=up)
        cameras = shapes[shape]
        notes: tuple[str, ...] = ()
        if kind in FOUND:
            cameras = [camera.resized(width, height) for camera in cameras]
            notes = _missing(kind, len(cameras), count)
        made.append(ViewSet(cameras, FOUND.get(kind, "given"), notes))
    return made


def _missing(kind: str, found: int, asked: int) -> tuple[str, ...]:
    if found == asked:
        return ()
    return (f"{kind}: {counted(found, 'view was', 'views were')} found of {asked} asked for",)
