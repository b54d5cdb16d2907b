"""The targets of a refit: renders of the original, and a model's error and gradient on them."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from nanogs._types import F32, F64, I64, U8, Bool
from nanogs.card.device import engine_in_use
from nanogs.kernels import backward, gradients
from nanogs.kernels.blocks import ALL_BLOCKS, SIDE, TILE
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import (
    PreparedSplats,
    Projection,
    Rendering,
    blend,
    project,
    render,
    view_on,
)

if TYPE_CHECKING:
    import warp as wp

    from nanogs.card.engine import Engine

# Viewers show a model over any background, so errors are means over a black and a white one. For a
# pixel with errors dc in its colour over black and da in its alpha this is, for each channel,
# (dc² + (dc - da)²) / 2 = (dc - da / 2)² + (da / 2)².
WHITE = 0.5  # weight of the white background; subtracted from colours before they are blended
ALPHA = math.sqrt(3 * WHITE * (1 - WHITE))  # the fourth channel is alpha times this
ENTRIES = 1 << 20  # splats of tiles, each counted, whose gradients are held at a time: 100 MB


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Target:
    """A rendered view of the original.

    Attributes:
        camera: The camera.
        image: (H, W, 4) uint8, the colours over black, clipped as on a screen, and alpha; 255 is 1.
            This takes a quarter of the memory of float32.
        footprint: Width of a pixel at the median depth of the visible splats, scene units; infinite
            if nothing is visible, or if it was not asked for.
        blocks: Bit mask of the blocks of each tile that are drawn; the others are empty.
    """

    camera: Camera
    image: U8
    footprint: float
    blocks: int = ALL_BLOCKS

    @property
    def shows(self) -> bool:
        """Whether anything is drawn in it."""
        return bool(self.image[..., 3].any())


@dataclass(frozen=True, slots=True, eq=False)
class Fitting:
    """The views to fit to: some are kept in memory, the others are rendered each time.

    Attributes:
        kept: Views that are rendered already.
        original: The model that the other views are rendered from; None if there are none.
        further: Cameras of the other views.
        surroundings: Splats that are drawn together with the model but not changed; the views show
            them, too.
    """

    kept: Sequence[Target]
    original: PreparedSplats | None = None
    further: Sequence[Camera] = ()
    surroundings: PreparedSplats | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all cameras, in their order."""
        cameras = [*(target.camera for target in self.kept), *self.further]
        return tuple(camera.name for camera in cameras)

    def __len__(self) -> int:
        return len(self.kept) + len(self.further)

    def take(self, index: int, wanted: int = ALL_BLOCKS) -> Target:
        """Return a view; one that is not kept is rendered now, and only in the wanted blocks."""
        found = self.to_render(index)
        if found is None:
            return self.kept[index]
        return make_target(*found, depth=False, wanted=wanted)

    def to_render(self, index: int) -> tuple[PreparedSplats, Camera] | None:
        """Return the model and the camera that a view is rendered from; None for a kept one."""
        if index < len(self.kept):
            return None
        assert self.original is not None  # noqa: S101 - given with the further cameras
        return self.original, self.further[index - len(self.kept)]


@dataclass(frozen=True, slots=True, eq=False)
class Gradients:
    """Gradient and curvature of a view's squared error, summed over the pixels for each splat.

    Attributes:
        view: The projection.
        totals: (N, 25) float32, see `nanogs.kernels.backward.gradient_tiles`; 0 for a splat that is
            not drawn.
        error: Mean squared error of the pixels that count, as in `squared_error`.
    """

    view: Projection
    totals: F32
    error: float


def make_target(
    original: PreparedSplats, camera: Camera, *, depth: bool = True, wanted: int = ALL_BLOCKS
) -> Target:
    """Render the original from a camera as a target.

    Args:
        original: The model.
        camera: The camera.
        depth: Whether to compute the footprint, which is infinite otherwise.
        wanted: Bit mask of the blocks of each tile to draw; the others stay empty.
    """
    drawn = render(original, camera, depth=depth, wanted=wanted)
    return replace(as_target(drawn, camera), blocks=wanted)


def as_target(rendering: Rendering, camera: Camera) -> Target:
    """Convert a rendering of the original over black to a target; the footprint needs its depth."""
    fixed = np.empty((*rendering.alpha.shape, 4), np.uint8)
    backward.write_bytes(rendering.color, rendering.alpha, fixed)
    if rendering.depth is None:
        return Target(camera, fixed, math.inf)
    seen = rendering.depth[rendering.alpha > 0.5 * rendering.alpha.max()]
    depth = float(np.median(seen.astype(np.float64))) if seen.size else math.inf
    return Target(camera, fixed, depth / max(camera.fx, camera.fy))


def _blend(view: Projection, camera: Camera, wanted: int = ALL_BLOCKS) -> tuple[F32, F32]:
    """Blend the channels that are compared: colours less `WHITE`, and alpha times `ALPHA`.

    Returns:
        The features that are blended, (N, 4), and the image, (H, W, 4), both float32.
    """
    with np.errstate(invalid="ignore"):  # rows that are not drawn are not initialised
        features = view.features - np.array([WHITE, WHITE, WHITE, 0], np.float32)
    features[:, 3] = ALPHA
    image, _, _ = blend(view, camera, features, np.zeros(4, np.float32), wanted=wanted)
    return features, image


def _weigh(target: Target, image: F32, wanted: int = ALL_BLOCKS) -> tuple[F32, F32, float]:
    """Compare an image from `_blend` with a target.

    Returns:
        The residual, (H, W, 4); the image's alpha, (H, W), by which curvatures are weighted; and
        the mean squared error. Arrays are float32, and not initialised in blocks not `wanted`.
    """
    residual = np.empty_like(image)
    curvature_weights = np.empty(image.shape[:2], np.float32)
    errors = np.empty((len(image), 2))
    backward.weigh_pixels(
        image, target.image, WHITE, ALPHA, wanted, residual, curvature_weights, errors
    )
    error, pixels = errors.sum(axis=0)
    return residual, curvature_weights, float(error) / (3 * max(float(pixels), 1))


def squared_error(model: PreparedSplats, target: Target) -> float:
    """Return the mean squared error per channel of a view, over black and white backgrounds."""
    engine = engine_in_use()
    if engine is not None:
        view = view_on(engine, model, target.camera)
        image, _ = view.blend(view.tinted(WHITE, ALPHA), np.zeros(4, np.float32))
        return view.weigh(image, picture_on(engine, target), WHITE, ALPHA, ALL_BLOCKS)[2]
    return _weigh(target, _blend(project(model, target.camera), target.camera)[1])[2]


def errors_of_splats(model: PreparedSplats, target: Target, *, halved: bool) -> F64:
    """Compute how large the squared error is where each splat of a model shows in a view.

    Args:
        model: N splats.
        target: The view of the original.
        halved: Whether it is measured at half of the view's size.

    Returns:
        (N, 2) float64, for each splat the sums over the pixels of T alpha times the squared
        residual (see `WHITE`), and of T alpha; zeros for a view of one row or column.
    """
    if min(target.camera.width, target.camera.height) < 2:
        return np.zeros((len(model), 2))
    side, wanted = SIDE, target.blocks
    if halved:
        side, wanted, target = SIDE // 2, ALL_BLOCKS, _halved(target)
    camera = target.camera
    counted = np.ones((camera.height, camera.width), np.float32)
    if target.blocks != ALL_BLOCKS:
        counted[~_in_blocks(target.blocks, camera, side)] = 0
    engine = engine_in_use()
    if engine is not None:
        return view_on(engine, model, camera).errors(target.image, WHITE, ALPHA, counted, wanted)
    view = project(model, camera)
    features, image = _blend(view, camera, wanted)
    residual, _, _ = _weigh(target, image, wanted)
    probes = np.stack([np.einsum("hwc,hwc->hw", residual, residual), counted])
    probes[0, counted == 0] = 0  # not initialised in blocks that are not wanted
    colours = np.ascontiguousarray(features[:, :1])  # one channel: the image is not needed again
    return blend(view, camera, colours, np.zeros(1, np.float32), probes, wanted)[2]


def _halved(target: Target) -> Target:
    """Reduce a view to half of its size, without its last row and column if these are odd."""
    width, height = target.camera.width // 2, target.camera.height // 2
    camera = target.camera.cropped(0, 0, 2 * width, 2 * height).resized(width, height)
    whole = np.ascontiguousarray(target.image[: 2 * height, : 2 * width])
    # Four channels without a meaning: Pillow would weight the colours of RGBA by alpha.
    image = Image.frombuffer("CMYK", (2 * width, 2 * height), whole, "raw", "CMYK", 0, 1)
    return replace(target, camera=camera, image=np.array(image.reduce(2)))


def _in_blocks(wanted: int, camera: Camera, side: int) -> Bool:
    """Return (H, W) bool, the pixels of a view in wanted blocks of `side` x `side` pixels."""
    across = TILE // SIDE
    rows, columns = np.ogrid[: camera.height, : camera.width]
    block = rows // side % across * across + columns // side % across
    inside: Bool = np.asarray(wanted >> block & 1, bool)
    return inside


def picture_on(engine: "Engine", target: Target) -> "wp.array":
    """Return a target's image on a device, which keeps it for as long as the target exists."""
    return engine.held(target, lambda: engine.put(target.image))


def compute_gradients(model: PreparedSplats, target: Target, wanted: int = ALL_BLOCKS) -> Gradients:
    """Render a view, and sum gradient and curvature of its squared error for each splat.

    Args:
        model: The splats.
        target: The view.
        wanted: Bit mask of the blocks of each tile whose pixels count.
    """
    view = project(model, target.camera)
    features, image = _blend(view, target.camera, wanted)
    residual, curvature_weights, error = _weigh(target, image, wanted)
    return Gradients(
        view, sum_gradients(view, features, image, residual, curvature_weights, wanted), error
    )


def sum_gradients(
    view: Projection, features: F32, image: F32, residual: F32, curvature_weights: F32, wanted: int
) -> F32:
    """Return the (N, 25) float32 sums of `nanogs.kernels.backward.gradient_tiles` for each splat.

    The arguments are those of that kernel. Entries take 25 numbers each, which would be much memory
    if most splats are as large as the view, so runs of tiles are summed one after another.
    """
    totals = np.zeros((len(features), gradients.SUMS), np.float32)
    for tiles in _runs_of_tiles(view.starts, ENTRIES):
        starts = view.starts[tiles.start : tiles.stop + 1]
        partial = np.empty((starts[-1] - starts[0], gradients.SUMS), np.float32)
        backward.gradient_tiles(
            view.geometry,
            features,
            starts,
            tiles.start,
            view.entries,
            wanted,
            image,
            residual,
            curvature_weights,
            partial,
        )
        backward.gather_entries(view.entries[starts[0] : starts[-1]], partial, totals)
    return totals


def _runs_of_tiles(starts: I64, most: int) -> Iterator[range]:
    """Split the tiles of an image into runs of at most `most` entries, or of one tile with more.

    Args:
        starts: (T + 1,) from `nanogs.kernels.listing.list_tiles`.
        most: Number of entries, 1 or more.
    """
    first, tiles = 0, len(starts) - 1
    while first < tiles:
        end = int(np.searchsorted(starts, starts[first] + most, side="right")) - 1
        last = max(end, first + 1)
        yield range(first, last)
        first = last
