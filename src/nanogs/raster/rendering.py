"""Render splats on the device in use; on the CPU by a tile rasteriser with the conventions of 3DGS.

A splat contributes to a pixel if and only if its alpha there is at least 1/255, in whatever tile
the pixel is (the reference also stops at a square of three standard deviations, rounded up to its
tiles, which cuts off at most alpha 0.011 of an opaque splat). All else is as in the reference:
Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from nanogs import parallel
from nanogs._types import F32, F64, I32, I64, Bool, F
from nanogs.card.device import engine_in_use
from nanogs.kernels import listing, raster
from nanogs.kernels import project as projection
from nanogs.kernels.blocks import ALL_BLOCKS
from nanogs.kernels.factors import factor_rows
from nanogs.kernels.radix import sorted_rows
from nanogs.raster.camera import Camera
from nanogs.raster.checks import background_of, check_camera, evaluated_degree
from nanogs.slices import SLICE_STEPS, slices
from nanogs.splats import RenderMode, Splats, padded, refuse_other

if TYPE_CHECKING:
    from nanogs.card.engine import DeviceSplats, Engine, View

BLACK = (0.0, 0.0, 0.0)
_RUNS = 2  # runs of entries that are summed separately; fixed, so that threads do not matter
SURFEL_NOTE = "a 2dgs model is drawn as flat 3D Gaussians, not by intersecting rays with surfels"


@dataclass(frozen=True, slots=True, eq=False)
class ProjectionBuffers:
    """Preallocated arrays for the projected splats of a view, N rows each; see `Projection`."""

    geometry: F64
    features: F32
    boxes: I64


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class PreparedSplats:
    """A model with activated parameters, to be rendered from many cameras.

    Attributes:
        means: (N, 3) float32 or float64, scene units; as stored.
        factors: (N, 3, 3) float32, R diag(s), scene units: the covariance is factor factorᵀ.
        opacities: (N,) float32 in [0, 1].
        reaches: (N,) float32, squared radii at which alpha falls to 1/255; see `reaches_of`.
        sh: (N, K, 3) float32; as stored.
        keep: (N,) bool, false where the alpha is below 1/255 or a value is not finite.
        sh_degree: 0 to 4.
        render_mode: The rasteriser the model was trained for.
        skipped: Number of rows with NaN, or with an infinity other than in the opacity's logit.
        buffers: Arrays that every view's projection is written to, in place of the one before; None
            if each view gets new memory, which the system has to clear first.
    """

    means: F
    factors: F32
    opacities: F32
    reaches: F32
    sh: F32
    keep: Bool
    sh_degree: int
    render_mode: RenderMode
    skipped: int
    buffers: ProjectionBuffers | None = None

    def __len__(self) -> int:
        return len(self.means)

    def with_buffers(self) -> "PreparedSplats":
        """Return the same splats with `buffers`: each view overwrites the projection before it."""
        return replace(self, buffers=_buffers(len(self)))


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """A model projected to one camera, sorted by depth and listed by tile.

    Attributes:
        geometry: (N, 8) float64, see `nanogs.kernels.project`; undefined for rows not in `order`.
        boxes: (N,) int64, packed box of tiles of each splat; see `nanogs.kernels.project`.
        features: (N, 4) float32: red, green, blue and depth; `blend` can take others instead.
        order: (M,) int64, the splats that can reach a pixel, nearest first.
        starts: (T + 1,) int64, where each tile of 16 x 16 pixels begins in `entries`, row by row.
        entries: (E,) int32, splats of each tile, nearest first.
    """

    geometry: F64
    boxes: I64
    features: F32
    order: I64
    starts: I64
    entries: I32


@dataclass(frozen=True, slots=True, eq=False)
class Rendering:
    """A picture of a model, with depth and contributions of splats if asked for.

    Attributes:
        color: (H, W, 3) float32, over the background; not clipped at 1.
        alpha: (H, W) float32, 1 - transmittance.
        depth: (H, W) float32, expected depth along the viewing axis in scene units, normalised by
            alpha; +inf where no splat was hit. None unless asked for.
        contributions: (N,) float64, sum of transmittance x alpha over the pixels. None unless asked
            for.
        unoccluded: (N,) float64, an estimate of `contributions` if nothing were in front of the
            splat; 0 if its centre is outside the image. None unless asked for.
        drawn: Number of splats that can reach a pixel of this view.
        skipped: Number of rows left out because of a NaN or an infinity.
        notes: Differences from the model's own rasteriser, for the user.
    """

    color: F32
    alpha: F32
    depth: F32 | None
    contributions: F64 | None
    unoccluded: F64 | None
    drawn: int
    skipped: int
    notes: tuple[str, ...]

    def shown(self) -> F32:
        """Return (H, W, 3) float32: the colours as on a screen; see `clipped`."""
        return clipped(self.color)


def clipped(values: F32) -> F32:
    """Clip to [0, 1]; NaN, as of colours beyond single precision, becomes 0."""
    inside: F32 = np.fmax(values, 0.0)
    return np.fmin(inside, 1.0, out=inside)


def prepare(splats: Splats) -> PreparedSplats:
    """Activate the parameters of a model once for many views.

    Args:
        splats: The model; infinite logits of the opacity become alpha 1 and 0.

    Returns:
        Arrays that `render` and `project` read; means and sh are shared, not copied.

    Raises:
        ModelError: It is no `Splats`.
    """
    refuse_other(splats)
    n = len(splats)
    scales, factors = np.empty((n, 3), np.float32), np.empty((n, 3, 3), np.float32)
    opacities, reaches = np.empty(n, np.float32), np.empty(n, np.float32)

    def activate(rows: slice) -> None:
        some = splats.span(rows.start, rows.stop)
        scales[rows] = some.scales()
        opacities[rows] = some.opacities()
        reaches[rows] = projection.reaches_of(opacities[rows])

    parallel.for_each(slices(n, SLICE_STEPS), activate)
    factor_rows(np.ascontiguousarray(splats.quats), scales, factors)
    finite = splats.finite()
    return PreparedSplats(
        means=splats.means,
        factors=factors,
        opacities=opacities,
        reaches=reaches,
        sh=np.ascontiguousarray(splats.sh),
        keep=finite & (opacities >= projection.MIN_ALPHA),
        sh_degree=splats.sh_degree,
        render_mode=splats.render_mode,
        skipped=n - int(np.count_nonzero(finite)),
    )


def concatenated(first: PreparedSplats, second: PreparedSplats | None) -> PreparedSplats:
    """Concatenate two models to be drawn as one: rows of the first, then those of the second.

    Args:
        first: The first model; its harmonic degree and render mode are those of the result.
        second: The second model; None returns the first.
    """
    if second is None:
        return first
    most = max(first.sh.shape[1], second.sh.shape[1])
    return PreparedSplats(
        means=np.concatenate([first.means, second.means.astype(first.means.dtype, copy=False)]),
        factors=np.concatenate([first.factors, second.factors]),
        opacities=np.concatenate([first.opacities, second.opacities]),
        reaches=np.concatenate([first.reaches, second.reaches]),
        sh=np.concatenate([padded(first.sh, most), padded(second.sh, most)]),
        keep=np.concatenate([first.keep, second.keep]),
        sh_degree=first.sh_degree,
        render_mode=first.render_mode,
        skipped=first.skipped + second.skipped,
    )


def render(
    splats: Splats | PreparedSplats,
    camera: Camera,
    *,
    background: tuple[float, float, float] = BLACK,
    depth: bool = False,
    contributions: bool = False,
    sh_degree: int | None = None,
    wanted: int = ALL_BLOCKS,
) -> Rendering:
    """Render a model from one camera, on the device in use.

    The result is the same to the byte for any number of threads. For the device see
    `nanogs.card.device.use_device`.

    Args:
        splats: The model, or `prepare(model)` if several views of it are rendered.
        camera: The camera.
        background: RGB behind the splats.
        depth: Also return the expected depth.
        contributions: Also return each splat's contribution to the image.
        sh_degree: Highest spherical-harmonic degree to evaluate; the model's own by default.
        wanted: Bit mask of the blocks of each tile to draw; the others show the background.

    Returns:
        The images; see `Rendering`.

    Raises:
        ModelError: `splats` is no model.
        OptionError: The camera, the background or the degree is invalid.
    """
    prepared = splats if isinstance(splats, PreparedSplats) else prepare(splats)
    behind = background_of(background, depth=depth)
    engine = engine_in_use()
    if engine is not None:
        on_card = view_on(engine, prepared, camera, sh_degree=sh_degree)
        rendering = picture_of(on_card, prepared, behind, wanted)
        if not contributions:
            return rendering
        shares, unoccluded = on_card.contributions(wanted), on_card.unoccluded()
    else:
        view = project(prepared, camera, sh_degree=sh_degree)
        probes = np.ones((1 if contributions else 0, camera.height, camera.width), np.float32)
        image, transmittance, totals = blend(view, camera, view.features, behind, probes, wanted)
        rendering = rendering_of(
            image, transmittance, len(view.order), prepared.skipped, prepared.render_mode
        )
        if not contributions:
            return rendering
        shares, unoccluded = totals[:, 0].copy(), _unoccluded(view, camera)
    return replace(rendering, contributions=shares, unoccluded=unoccluded)


def picture_of(
    view: "View", prepared: PreparedSplats, background: F32, wanted: int = ALL_BLOCKS
) -> Rendering:
    """Make the picture of a view that was projected on a device.

    Args:
        view: The view.
        prepared: Its model.
        background: (C,) float32, with four channels if depth is asked for, or else three.
        wanted: Bit mask of the blocks of each tile to draw.
    """
    image, transmittance = view.blend(view.features, background, wanted)
    colours, left = view.to_host(image, len(background)), transmittance.numpy()
    return rendering_of(colours, left, view.drawn, prepared.skipped, prepared.render_mode)


def view_on(
    engine: "Engine", prepared: PreparedSplats, camera: Camera, *, sh_degree: int | None = None
) -> "View":
    """Project a model on a device, which keeps the model for as long as `prepared` exists.

    Except for the engine, arguments and errors are those of `project`.
    """
    check_camera(camera)
    degree = evaluated_degree(prepared.sh_degree, sh_degree)
    model = engine.held(prepared, lambda: uploaded(engine, prepared))
    return model.view(*camera_arrays(camera), degree)


def camera_arrays(camera: Camera) -> tuple[F64, F64, F64]:
    """Return (3, 3) rotation, (3,) position, (12,) intrinsics of a camera, as kernels take them."""
    rotation = np.ascontiguousarray(camera.world_to_camera[:3, :3], np.float64)
    return rotation, camera.position, camera.intrinsics


def uploaded(engine: "Engine", prepared: PreparedSplats) -> "DeviceSplats":
    """Copy a model to a device."""
    from nanogs.card.engine import DeviceSplats

    return DeviceSplats(
        engine,
        prepared.means,
        prepared.factors,
        prepared.opacities,
        prepared.reaches,
        prepared.keep,
        prepared.sh,
        mip=prepared.render_mode is RenderMode.MIP,
    )


def rendering_of(
    image: F32, transmittance: F32, drawn: int, skipped: int, mode: RenderMode
) -> Rendering:
    """Create a rendering from the results of `blend`.

    Args:
        image: (H, W, 3) or, with depth, (H, W, 4), over the background.
        transmittance: (H, W), from which alpha is computed.
        drawn: Number of splats that can reach a pixel.
        skipped: Number of rows that are not finite.
        mode: The rasteriser that the model was trained for.
    """
    alpha = 1 - transmittance
    return Rendering(
        color=np.ascontiguousarray(image[..., :3]),
        alpha=alpha,
        depth=_expected_depth(image[..., 3], alpha) if image.shape[2] > 3 else None,
        contributions=None,
        unoccluded=None,
        drawn=drawn,
        skipped=skipped,
        notes=(SURFEL_NOTE,) if mode is RenderMode.SURFEL else (),
    )


def project(
    prepared: PreparedSplats, camera: Camera, *, sh_degree: int | None = None
) -> Projection:
    """Project the splats to one camera, sort them by depth and list them by tile.

    Splats are ordered by their depth along the viewing axis as float32, ties by index.

    Args:
        prepared: The model.
        camera: The camera.
        sh_degree: Highest degree to evaluate; the model's own by default.

    Returns:
        The arrays that the blending kernels read.

    Raises:
        OptionError: The camera or the degree is invalid.
    """
    geometry, features, boxes = project_rows(prepared, camera, sh_degree=sh_degree)
    order = _depth_order(features, boxes)
    starts, entries = listing.list_tiles(geometry, boxes, order, camera.width, camera.height)
    return Projection(geometry, boxes, features, order, starts, entries)


def project_rows(
    prepared: PreparedSplats, camera: Camera, *, sh_degree: int | None = None
) -> tuple[F64, F32, I64]:
    """Project splats without sorting: return `geometry`, `features` and `boxes` of `Projection`.

    Arguments and errors are those of `project`.
    """
    check_camera(camera)
    degree = evaluated_degree(prepared.sh_degree, sh_degree)
    buffers = prepared.buffers or _buffers(len(prepared))
    projection.project_splats(
        prepared.means,
        prepared.factors,
        prepared.opacities,
        prepared.reaches,
        prepared.keep,
        prepared.sh,
        *camera_arrays(camera),
        prepared.render_mode is RenderMode.MIP,
        degree,
        buffers.geometry,
        buffers.features,
        buffers.boxes,
    )
    return buffers.geometry, buffers.features, buffers.boxes


def blend(
    view: Projection,
    camera: Camera,
    features: F32,
    background: F32,
    probes: F32 | None = None,
    wanted: int = ALL_BLOCKS,
) -> tuple[F32, F32, F64]:
    """Blend features of the splats front to back.

    Args:
        view: From `project`, of this camera.
        camera: The camera.
        features: (N, C or more) float32; rows that are not drawn may be undefined.
        background: (C,) float32, added with the final transmittance.
        probes: (P, H, W) float32, images that the weights T alpha are multiplied by; None for none.
        wanted: Bit mask of the blocks of each tile to blend; others show the background.

    Returns:
        The image (H, W, C), the transmittance (H, W), and for every splat (N, P) float64 the sums
        over the pixels of its weight T alpha times the probes, 0 for one that is not drawn.
    """
    if probes is None:
        probes = np.empty((0, camera.height, camera.width), np.float32)
    probes = np.ascontiguousarray(probes)  # a kernel would be compiled for each layout
    assert features.shape[1] >= len(background)  # noqa: S101 - kernels do not check
    image = np.empty((camera.height, camera.width, len(background)), np.float32)
    transmittance = np.empty(image.shape[:2], np.float32)
    partial = np.empty((len(view.entries), len(probes)), np.float32)
    raster.blend_tiles(
        view.geometry,
        features,
        view.starts,
        view.entries,
        wanted,
        background,
        image,
        transmittance,
        probes,
        partial,
    )
    return image, transmittance, _sums(view.entries, partial, len(features))


def _sums(entries: I32, partial: F32, count: int) -> F64:
    """Sum the entries of each splat, (E, P) float32, to (N, P) float64."""
    columns = partial.shape[1]
    if not columns:
        return np.zeros((count, 0))
    totals: F64 = np.zeros((_RUNS, count, columns))
    whole: F64 = totals[0]
    raster.sum_entries(entries, partial, len(entries) * np.arange(_RUNS + 1) // _RUNS, totals)

    def add(rows: slice) -> None:
        for run in range(1, _RUNS):
            whole[rows] += totals[run, rows]

    parallel.for_each(slices(count, SLICE_STEPS), add)
    return whole


def _buffers(n: int) -> ProjectionBuffers:
    return ProjectionBuffers(
        _rows_of_a_line(n), np.empty((n, 4), np.float32), np.empty(n, np.int64)
    )


def _rows_of_a_line(n: int) -> F64:
    """Return (n, 8) float64, uninitialised, each row aligned to one cache line of 64 bytes."""
    flat = np.empty(8 * n + 7, np.float64)
    return flat[-flat.ctypes.data % 64 // 8 :][: 8 * n].reshape(n, 8)


def _depth_order(features: F32, boxes: I64) -> I64:
    """Return the indices of the drawn splats, nearest first, ties by index."""
    runs = list(slices(len(boxes), SLICE_STEPS))
    counts = parallel.map_ordered(runs, lambda rows: np.count_nonzero(boxes[rows]))  # HIDDEN is 0
    ends = np.cumsum([0, *counts])
    bounds = np.array([0, *(rows.stop for rows in runs)])
    keys = np.empty(ends[-1], np.uint64)
    listing.depth_keys(features, boxes, bounds, ends[:-1], keys)
    return sorted_rows(keys)


def _unoccluded(view: Projection, camera: Camera) -> F64:
    totals = np.zeros(len(view.geometry))
    raster.add_unoccluded(view.geometry, view.boxes, camera.width, camera.height, totals)
    return totals


def _expected_depth(weighted: F32, alpha: F32) -> F32:
    depth = np.full(alpha.shape, np.inf, np.float32)
    np.divide(weighted, alpha, out=depth, where=alpha > 0)
    return depth
