"""Streamed rendering of models larger than memory, with the same bits as for a model in memory.

The rows of a source are read block by block and projected as usual. Projected splats that an image
draws are kept, in the order of the source, so that ties in depth are broken in the same way. As
many images as fit into the budget share a pass over the source. If the splats of a single image do
not fit, its tiles are divided into parts, each of which is gathered on its own; splats are still
projected onto the whole image, so that no pixel differs.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import groupby

import numpy as np

from nanogs._types import F32, F64, I64
from nanogs.card.device import engine_in_use
from nanogs.errors import NotEnoughMemoryError, OptionError
from nanogs.formatting import bytes_text
from nanogs.kernels.blocks import TILE
from nanogs.kernels.listing import cut_boxes, extent_of
from nanogs.progress import PartProgress, each, ignore_progress
from nanogs.protocol import BLACK
from nanogs.raster.camera import Camera
from nanogs.raster.checks import background_of, check_camera
from nanogs.raster.rendering import (
    PreparedSplats,
    Rendering,
    blend,
    prepare,
    project_rows,
    render,
    rendering_of,
)
from nanogs.source import Source, source_of
from nanogs.splats import RenderMode, Splats
from nanogs.views.arena import Arena

DRAWN_ROWS = 1 << 15  # rows that are drawn at a time


@dataclass(frozen=True, slots=True, eq=False)
class Streamed:
    """A model that is rendered from its source in blocks of rows.

    Attributes:
        source: The model.
        budget: Bytes for the splats that images draw; blocks of rows and images come on top.
    """

    source: Source
    budget: int

    def __len__(self) -> int:
        return self.source.count


def drawable(model: Splats | Source, budget: int | None) -> PreparedSplats | Streamed:
    """Prepare a model for `renderings`.

    Args:
        model: The model.
        budget: Bytes for the splats of images, to stream the model; None to hold it in memory.

    Raises:
        OptionError: It is to be streamed, and the device in use is not the CPU.
    """
    if budget is not None:
        if engine_in_use() is not None:
            raise OptionError(
                "A model that does not fit into memory can only be rendered on the CPU; use"
                ' `device="cpu"`, or allow more memory with `max_memory`.'
            )
        return Streamed(source_of(model), budget)
    return prepare(model.load() if isinstance(model, Source) else model)


def renderings(
    model: PreparedSplats | Streamed,
    cameras: Sequence[Camera],
    *,
    background: tuple[float, float, float] = BLACK,
    depth: bool = False,
    on_progress: PartProgress = ignore_progress,
) -> Iterator[Rendering]:
    """Render a model from each camera, in their order; the same bytes for both kinds of model.

    Args:
        model: The model in memory, or streamed in as many passes as needed.
        cameras: The cameras.
        background: RGB behind the splats.
        depth: Also return the expected depth.
        on_progress: Progress callback for the views.

    Yields:
        The images; see `Rendering`.

    Raises:
        FormatError: The source cannot be read.
        NotEnoughMemoryError: The splats of a single tile of a view are too many.
        OptionError: A camera or the background is invalid.
    """
    if isinstance(model, PreparedSplats):
        for camera in each(cameras, on_progress):
            yield render(model, camera, background=background, depth=depth)
    else:
        behind = background_of(background, depth=depth)
        for camera in cameras:
            check_camera(camera)
        if cameras:
            yield from _Drawing(model, cameras, behind, on_progress).renderings()


@dataclass(frozen=True, slots=True)
class Part:
    """A rectangle of tiles of a view: columns [left, right) and rows [top, bottom).

    Attributes:
        view: Number of the view.
        left: The first column of tiles.
        top: The first row of tiles.
        right: The column after the last.
        bottom: The row after the last.
    """

    view: int
    left: int
    top: int
    right: int
    bottom: int

    def divided(self, pieces: int) -> "list[Part]":
        """Divide it into about `pieces` parts; a single tile is returned unchanged."""
        across, down = self.right - self.left, self.bottom - self.top
        if pieces <= 1 or across * down <= 1:
            return [self]
        if across >= down:
            middle = self.left + across // 2
            halves = [
                Part(self.view, self.left, self.top, middle, self.bottom),
                Part(self.view, middle, self.top, self.right, self.bottom),
            ]
        else:
            middle = self.top + down // 2
            halves = [
                Part(self.view, self.left, self.top, self.right, middle),
                Part(self.view, self.left, middle, self.right, self.bottom),
            ]
        return [piece for half in halves for piece in half.divided(-(-pieces // 2))]


def _whole(view: int, camera: Camera) -> Part:
    return Part(view, 0, 0, -(-camera.width // TILE), -(-camera.height // TILE))


@dataclass(slots=True, eq=False)
class _Gathered:
    """The splats gathered so far for a part of a view.

    Attributes:
        part: The part.
        pages: Pages of the arena that hold them.
        count: Number of splats.
        tiles: Number of tiles of all their boxes.
        corners: Number of splats whose box has its corner in this part, and in no other.
        over: They do not fit into the arena, and are only counted.
    """

    part: Part
    pages: list[int] = field(default_factory=list)
    count: int = 0
    tiles: int = 0
    corners: int = 0
    over: bool = False


class _Pass:
    """One pass over the source, for as many parts as fit into the arena.

    Attributes:
        gathering: The parts being gathered; if the arena is full, the last ones are left for a
            later pass.
    """

    def __init__(self, arena: Arena, parts: Sequence[Part], extents: "_Extents") -> None:
        self._arena, self._extents = arena, extents
        self.gathering = [_Gathered(part) for part in parts]

    def wants(self, number: int) -> bool:
        """Return whether any part may draw splats of a block."""
        return any(self._extents.meets(number, gathered.part) for gathered in self.gathering)

    def add(self, number: int, block: PreparedSplats, cameras: Sequence[Camera]) -> None:
        """Project a block onto each view that may show it, and keep the splats that parts draw."""
        wanted = [one for one in self.gathering if self._extents.meets(number, one.part)]
        for view, group in groupby(wanted, lambda gathered: gathered.part.view):
            if self.gathering[-1].part.view >= view:  # some of its parts are still being gathered
                projected = project_rows(block, cameras[view])
                self._extents.note(number, view, projected[2])
                for gathered in group:
                    self._keep(gathered, *projected)

    def _keep(self, gathered: _Gathered, geometry: F64, features: F32, boxes: I64) -> None:
        if gathered not in self.gathering:  # another part took its pages
            return
        part = gathered.part
        rows, cut = np.empty_like(boxes), np.empty_like(boxes)
        count, tiles, corners = cut_boxes(
            boxes, part.left, part.top, part.right, part.bottom, rows, cut
        )
        start, rows, cut = gathered.count, rows[:count], cut[:count]
        gathered.corners += corners
        gathered.count += count
        gathered.tiles += tiles
        if not gathered.over and self._arena.needed_share(gathered.count, gathered.tiles) > 1:
            self._only_count(gathered)
        if self._room_for(gathered):
            places = self._arena.places(gathered.pages, start, gathered.count)
            self._arena.put(places, geometry[rows], features[rows], cut)

    def _room_for(self, gathered: _Gathered) -> bool:
        """Allocate the missing pages of a part, if necessary by dropping the last parts.

        Returns False if the part itself was dropped.
        """
        lacking = -(-gathered.count // self._arena.page) - len(gathered.pages)
        while gathered in self.gathering and not gathered.over:
            pages = self._arena.take(max(lacking, 0))
            if pages is not None:
                gathered.pages += pages
                return True
            self._arena.give(self.gathering.pop().pages)
        return False

    def _only_count(self, gathered: _Gathered) -> None:
        """Only count a part's splats from now on, and drop the parts after it.

        Images are made in the order of the cameras.
        """
        gathered.over = True
        self._arena.give(gathered.pages)
        while self.gathering[-1] is not gathered:
            self._arena.give(self.gathering.pop().pages)


class _Extents:
    """The bounds, in tiles, of each block in each view, so that later passes can skip blocks."""

    def __init__(self) -> None:
        self._known: dict[tuple[int, int], tuple[int, int, int, int]] = {}

    def note(self, number: int, view: int, boxes: I64) -> None:
        """Record where a block's splats are drawn, from its (N,) boxes in the view."""
        if (number, view) not in self._known:
            self._known[number, view] = extent_of(boxes)

    def meets(self, number: int, part: Part) -> bool:
        """Return whether a block may draw in a part of a view."""
        if (number, part.view) not in self._known:
            return True
        left, top, right, bottom = self._known[number, part.view]
        across = max(left, part.left) < min(right, part.right)
        return across and max(top, part.top) < min(bottom, part.bottom)


@dataclass(slots=True)
class _Sheet:
    """An image of which some parts are drawn."""

    image: F32
    transmittance: F32
    drawn: int = 0


class _Drawing:
    """The rendering of all requested views of a streamed model."""

    def __init__(
        self, model: Streamed, cameras: Sequence[Camera], behind: F32, on_progress: PartProgress
    ) -> None:
        self._source, self._cameras, self._behind = model.source, cameras, behind
        self._arena = Arena(model.budget, model.source.count, len(cameras))
        self._sheets: dict[int, _Sheet] = {}
        self._extents = _Extents()
        self._skipped: dict[int, int] = {}  # rows of each block that are not finite
        self._on_progress, self._done = on_progress, 0

    def renderings(self) -> Iterator[Rendering]:
        """Iterate over the images, in the order of the cameras."""
        waiting = [_whole(view, camera) for view, camera in enumerate(self._cameras)]
        most = len(waiting)
        while waiting:
            passed = self._gather(waiting[:most])
            # The next pass starts at most twice as many parts as fitted into this one.
            waiting, most = self._left(passed, waiting), 2 * len(passed.gathering)
            for view, group in groupby(passed.gathering, lambda gathered: gathered.part.view):
                for gathered in group:
                    self._draw(gathered)
                if not any(part.view == view for part in waiting):
                    yield self._finished(view)
        self._on_progress(self._done, len(self._cameras))

    def _gather(self, parts: Sequence[Part]) -> _Pass:
        """Read the source once, and gather some parts, or as many of the first as fit."""
        passed, count = _Pass(self._arena, parts, self._extents), self._source.count
        for number, start in enumerate(range(0, count, DRAWN_ROWS)):
            coming = passed.gathering[-1].part.view - self._done
            self._on_progress(self._done + coming * start / count, len(self._cameras))
            if passed.wants(number):
                block = prepare(self._source.read(start, min(start + DRAWN_ROWS, count)))
                self._skipped[number] = block.skipped
                passed.add(number, block, self._cameras)
        return passed

    def _left(self, passed: _Pass, waiting: Sequence[Part]) -> list[Part]:
        """Return the remaining parts; those that were too large are divided."""
        known = {gathered.part: gathered for gathered in passed.gathering}
        left: list[Part] = []
        for part in waiting:
            if part not in known:
                left.append(part)
            elif known[part].over:
                left += self._divided(known[part])
        return left

    def _divided(self, gathered: _Gathered) -> list[Part]:
        needed_share = self._arena.needed_share(gathered.count, gathered.tiles)
        pieces = gathered.part.divided(max(int(np.ceil(needed_share)), 2))
        if len(pieces) == 1:
            camera = self._cameras[gathered.part.view]
            raise NotEnoughMemoryError(
                f"A single tile of {TILE} x {TILE} pixels of view {camera.name!r} draws"
                f" {gathered.count:,} splats, too many for the {bytes_text(self._arena.bytes)} of"
                " memory available for them; allow more (`max_memory`), or move the camera."
            )
        return pieces

    def _draw(self, gathered: _Gathered) -> None:
        """Draw a part into the image of its view, if it fitted into the arena."""
        if gathered.over:
            return
        part, camera = gathered.part, self._cameras[gathered.part.view]
        view = self._arena.projection(gathered.pages, gathered.count, camera)
        self._arena.give(gathered.pages)  # nothing is written to them before the next pass
        image, transmittance, _ = blend(view, camera, view.features, self._behind)
        sheet = self._sheets.setdefault(part.view, _Sheet(image, transmittance))
        if sheet.image is not image:
            rows = slice(part.top * TILE, part.bottom * TILE)
            columns = slice(part.left * TILE, part.right * TILE)
            sheet.image[rows, columns] = image[rows, columns]
            sheet.transmittance[rows, columns] = transmittance[rows, columns]
        sheet.drawn += gathered.corners

    def _finished(self, view: int) -> Rendering:
        self._done += 1
        sheet = self._sheets.pop(view)
        mode = RenderMode(self._source.columns.render_mode)
        skipped = sum(self._skipped.values())
        return rendering_of(sheet.image, sheet.transmittance, sheet.drawn, skipped, mode)
