"""A sample of a model's splats, and a coarse occupancy grid for casting rays.

Only used to place cameras; nothing is rendered here.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64, I64
from nanogs.activations import rotations
from nanogs.errors import ModelError
from nanogs.source import Source, joined_rows, source_of
from nanogs.splats import Splats

MAX_SAMPLE = 30_000  # most splats in the sample; larger models are sampled by a stride
FAINTEST = 1 / 255  # alpha that rasterisers skip
MEDIAN_SAMPLE = 10_000  # most of these used to find the core's centre and radius
CELLS = 64  # number of cells of the grid along each axis
TRIM_ROUNDS = 4  # iterations for centre and radius of the core
TRIM = 4.0  # radius of the core in median distances; beyond are surroundings, skies and strays
# Cells around one, up to two away.
_AROUND = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 3), axis=-1).reshape(-1, 3)
OPAQUE_DEPTH = 1.0  # optical depth at which a ray is stopped


@dataclass(frozen=True, slots=True)
class SplatSample:
    """A sample of the visible splats of a model.

    Attributes:
        points: (n, 3) float64, centres in scene units.
        alphas: (n,) float64 in (1/255, 1].
        arms: (n, 2, 3) float64, the two longest axes times their standard deviations, longer first.
        thicknesses: (n,) float64, standard deviation along the third axis, scene units.
        stride: Every `stride`-th splat was taken.
    """

    points: F64
    alphas: F64
    arms: F64
    thicknesses: F64
    stride: int

    @property
    def areas(self) -> F64:
        """(n,) float64, alpha times the largest cross-section, square scene units."""
        lengths = np.linalg.norm(self.arms, axis=2)
        areas: F64 = self.alphas * 2 * np.pi * lengths.prod(axis=1)
        return areas


@dataclass(frozen=True, slots=True)
class Core:
    """The dense part of a model, without surroundings, skies and strays.

    Attributes:
        centre: (3,) float64, scene units.
        radius: Distance from the centre that holds 95 % of the core, more than 0.
        rows: (m,) int64, rows of the sample that belong to it.
    """

    centre: F64
    radius: float
    rows: I64


def quantiles(values: F64, weights: F64, *shares: float) -> list[float]:
    """Return weighted quantiles: the values below which the given shares of the weight are."""
    order = np.argsort(values)
    summed = np.cumsum(weights[order])
    places = np.searchsorted(summed, np.array(shares) * summed[-1])
    return [float(value) for value in values[order[np.minimum(places, len(order) - 1)]]]


def capped(areas: F64) -> F64:
    """Limit areas to their 99th percentile: a few huge ones would outweigh all others."""
    return np.minimum(areas, np.quantile(areas, 0.99))


def sample(model: Splats | Source) -> SplatSample:
    """Sample the finite and visible splats.

    A source, which is read twice, gives the same sample as the model in memory.

    Raises:
        FormatError: The source cannot be read.
        ModelError: No splat is visible, so every view would be empty.
    """
    kept, stride = _thinned(model)
    scales = kept.scales().astype(np.float64)
    axes = rotations(kept.unit_quats().astype(np.float64)) * scales[:, None, :]
    longest = np.argsort(-scales, axis=1, kind="stable")[:, :2]
    arms = np.take_along_axis(axes.transpose(0, 2, 1), longest[:, :, None], axis=1)
    means = kept.means.astype(np.float64)
    return SplatSample(means, kept.opacities(), arms, scales.min(axis=1), stride)


def _visible(splats: Splats) -> I64:
    """Return the rows that are finite and not transparent."""
    return np.flatnonzero(splats.finite() & (splats.opacities() > FAINTEST))


def _thinned(model: Splats | Source) -> tuple[Splats, int]:
    """Return every n-th of the visible splats, and n."""
    # For a model in memory visible rows are found once. A source is read twice, and nothing is kept
    # between the passes.
    whole = [(model, _visible(model))] if isinstance(model, Splats) else None

    def blocks() -> Iterable[tuple[Splats, I64]]:
        return whole or ((block, _visible(block)) for block in source_of(model).blocks())

    total = sum(len(visible) for _, visible in blocks())
    if not total:
        raise ModelError(
            "The model shows nothing: each of its splats is transparent or not finite;"
            " check the file it came from."
        )
    stride, passed, kept = -(-total // MAX_SAMPLE), 0, []
    for block, visible in blocks():
        kept.append(block.take(visible[-passed % stride :: stride]))
        passed += len(visible)
    return joined_rows(kept), stride


def find_core(sampled: SplatSample) -> Core:
    """Find the dense part of a model, robust to splats far outside of it.

    Medians are weighted by alpha, and not by area, so that a sky of few huge splats does not count.
    Each round keeps the splats within four times the median distance from the median: a compact
    object keeps all of its splats, a scene loses its surroundings.
    """
    some = np.arange(0, len(sampled.points), -(-len(sampled.points) // MEDIAN_SAMPLE))
    for _ in range(TRIM_ROUNDS):
        points, alphas = sampled.points[some], sampled.alphas[some]
        centre = np.array([quantiles(column, alphas, 0.5)[0] for column in points.T])
        distance = np.linalg.norm(points - centre, axis=1)
        farthest = TRIM * quantiles(distance, alphas, 0.5)[0]
        some = some[distance <= farthest]
    points, alphas = sampled.points[some], sampled.alphas[some]
    rows = np.flatnonzero(np.linalg.norm(sampled.points - centre, axis=1) <= farthest)
    # The centre is that of the extent and not the median, so that the core fills a view.
    ends = [quantiles(column, alphas, 0.02, 0.98) for column in points.T]
    centre = np.array(ends).mean(axis=1)
    extent = np.linalg.norm(sampled.arms[some, 0], axis=1)
    radius = quantiles(np.linalg.norm(points - centre, axis=1) + extent, alphas, 0.95)[0]
    return Core(centre, radius if radius > 0 else 1.0, rows)


@dataclass(frozen=True, slots=True)
class Grid:
    """An occupancy grid over a cube around the core.

    Attributes:
        depth: (CELLS + 2, CELLS + 2, CELLS + 2) float64, optical depth of one cell's width of a
            ray, with a border of empty cells.
        corner: (3,) float64, scene units.
        cell: Width of a cell, scene units.
    """

    depth: F64
    corner: F64
    cell: float

    def first_hits(self, origins: F64, directions: F64, reach: float) -> F64:
        """Return the (n,) distances at which rays are stopped, inf if not within `reach`.

        Args:
            origins: (n, 3) float64, scene units.
            directions: (n, 3) float64, unit.
            reach: Length of the rays, scene units.
        """
        steps = max(int(reach / (0.7 * self.cell)), 1)
        along = (np.arange(steps) + 0.5) * (reach / steps)
        columns = [origins[:, k, None] + along * directions[:, k, None] for k in range(3)]
        depth = np.cumsum(self._at(columns) * (reach / steps / self.cell), axis=1)
        first = (depth <= OPAQUE_DEPTH).sum(axis=1)  # depth only grows along a ray
        hits: F64 = np.append(along, np.inf)[first]
        return hits

    def free(self, position: F64) -> bool:
        """Return whether nothing opaque is within two cells of a point (3,)."""
        points = position + _AROUND * self.cell
        return bool((self._at([*points.T]) <= OPAQUE_DEPTH / 2).all())

    def _at(self, columns: Sequence[F64]) -> F64:
        """Return the optical depths of the cells that hold some points; 0 outside.

        The points are given by three arrays of coordinates of one shape, which the result has too.
        """
        cells = np.zeros(columns[0].shape, np.int64)
        for column, corner in zip(columns, self.corner, strict=True):
            place = column - corner
            place /= self.cell
            place += 1
            np.fmin(np.fmax(place, 0, out=place), CELLS + 1, out=place)  # NaN counts as outside
            cells *= CELLS + 2
            cells += place.astype(np.int64)
        depths: F64 = self.depth.ravel().take(cells)
        return depths


def build_grid(sampled: SplatSample, centre: F64, half: float) -> Grid:
    """Build the occupancy grid of a cube of half-width `half` around `centre`."""
    cell = 2 * half / CELLS
    corner = centre - half
    depth = np.zeros(CELLS**3)
    # A splat is spread over five points of its ellipse, so that one of a cell's size leaves no
    # holes.
    share = sampled.areas * sampled.stride / cell**2 / 5
    for first, second in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
        points = sampled.points + first * sampled.arms[:, 0] + second * sampled.arms[:, 1]
        place = (points - corner) / cell
        inside = ((place >= 0) & (place < CELLS)).all(axis=1)
        flat = np.ravel_multi_index(tuple(place[inside].astype(np.int64).T), (CELLS,) * 3)
        depth += np.bincount(flat, share[inside], minlength=CELLS**3)
    smooth = depth.reshape(CELLS, CELLS, CELLS)
    for axis in range(3):  # mean with the cell before, so that no layer is thinner than a cell
        before = np.zeros_like(smooth)
        np.moveaxis(before, axis, 0)[1:] = np.moveaxis(smooth, axis, 0)[:-1]
        smooth = (smooth + before) / 2
    return Grid(np.pad(smooth, 1), corner, cell)
