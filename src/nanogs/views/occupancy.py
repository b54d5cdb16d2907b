"""A model's matter: a weighted sample of it, and a coarse grid to look along rays.

Only for choosing where cameras stand; nothing here renders.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64, I64
from nanogs.errors import ModelError
from nanogs.source import Source, joined_rows, source_of
from nanogs.splats import Splats
from nanogs.stored import rotations

MAX_SAMPLE = 30_000  # splats looked at; a stride thins larger models
FAINTEST = 1 / 255  # what the rasterisers skip
MEDIAN_SAMPLE = 10_000  # of these, to find the middle and the reach of most
CELLS = 64  # of the grid, along each axis
TRIM_ROUNDS = 4  # of centre and radius
TRIM = 4.0  # median distances from the centre; beyond lie surroundings, skies and strays
OPAQUE_DEPTH = 1.0  # optical depth at which a ray counts as stopped


@dataclass(frozen=True, slots=True)
class Matter:
    """A sample of the visible splats.

    Attributes:
        points: (n, 3) float64, centres in scene units.
        alphas: (n,) float64 in (1/255, 1].
        arms: (n, 2, 3) float64, the two longest axes times their standard deviations, longer first.
        thicknesses: (n,) float64, standard deviation along the third axis, scene units.
        stride: One in this many splats was taken.
    """

    points: F64
    alphas: F64
    arms: F64
    thicknesses: F64
    stride: int

    @property
    def areas(self) -> F64:
        """(n,) float64: alpha times the largest cross-section, square scene units."""
        lengths = np.linalg.norm(self.arms, axis=2)
        areas: F64 = self.alphas * 2 * np.pi * lengths.prod(axis=1)
        return areas


@dataclass(frozen=True, slots=True)
class Core:
    """The part of a model that views are about.

    Attributes:
        centre: (3,) float64, scene units.
        radius: Distance from the centre that holds 95 % of the core, more than 0.
        rows: (m,) int64, which samples belong to it.
    """

    centre: F64
    radius: float
    rows: I64


def quantiles(values: F64, weights: F64, *shares: float) -> list[float]:
    """The values below which the given shares of the weight lie."""
    order = np.argsort(values)
    summed = np.cumsum(weights[order])
    places = np.searchsorted(summed, np.array(shares) * summed[-1])
    return [float(value) for value in values[order[np.minimum(places, len(order) - 1)]]]


def capped(areas: F64) -> F64:
    """Areas, none above their 99th percentile: a few huge ones would outvote all others."""
    return np.minimum(areas, np.quantile(areas, 0.99))


def sample(model: Splats | Source) -> Matter:
    """Sample finite and visible splats: the same ones of a source, which is read twice.

    Raises:
        FormatError: The source cannot be read.
        ModelError: There is none, so every view would be empty.
    """
    kept, stride = _thinned(model)
    scales = kept.scales().astype(np.float64)
    axes = rotations(kept.unit_quats().astype(np.float64)) * scales[:, None, :]
    longest = np.argsort(-scales, axis=1, kind="stable")[:, :2]
    arms = np.take_along_axis(axes.transpose(0, 2, 1), longest[:, :, None], axis=1)
    means = kept.means.astype(np.float64)
    return Matter(means, kept.opacities(), arms, scales.min(axis=1), stride)


def _visible(splats: Splats) -> I64:
    """The rows that are neither transparent nor broken."""
    return np.flatnonzero(splats.finite() & (splats.opacities() > FAINTEST))


def _thinned(model: Splats | Source) -> tuple[Splats, int]:
    """Every n-th of the visible splats, and n."""
    # Visible rows of a model in memory are found once. A source is read twice, and nothing is kept
    # in between.
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


def find_core(matter: Matter) -> Core:
    """Centre and radius of the dense part, whatever flies or shines far outside of it.

    Medians weighted by alpha, and not by area: a sky of few huge splats must not count. Each round
    keeps what lies within four times the median distance of the median: a compact object keeps
    all of itself, a scene with surroundings loses them.
    """
    some = np.arange(0, len(matter.points), -(-len(matter.points) // MEDIAN_SAMPLE))
    for _ in range(TRIM_ROUNDS):
        points, alphas = matter.points[some], matter.alphas[some]
        centre = np.array([quantiles(column, alphas, 0.5)[0] for column in points.T])
        distance = np.linalg.norm(points - centre, axis=1)
        reach = TRIM * quantiles(distance, alphas, 0.5)[0]
        some = some[distance <= reach]
    points, alphas = matter.points[some], matter.alphas[some]
    rows = np.flatnonzero(np.linalg.norm(matter.points - centre, axis=1) <= reach)
    # The middle of its extent, so that it fills a view: the median is where most splats are.
    ends = [quantiles(column, alphas, 0.02, 0.98) for column in points.T]
    centre = np.array(ends).mean(axis=1)
    extent = np.linalg.norm(matter.arms[some, 0], axis=1)
    radius = quantiles(np.linalg.norm(points - centre, axis=1) + extent, alphas, 0.95)[0]
    return Core(centre, radius if radius > 0 else 1.0, rows)


@dataclass(frozen=True, slots=True)
class Grid:
    """Optical depth of a cube around the core, for one cell's width of a ray.

    Attributes:
        depth: (CELLS + 2, CELLS + 2, CELLS + 2) float64, with an empty cell around all.
        corner: (3,) float64, scene units.
        cell: Width of a cell, scene units.
    """

    depth: F64
    corner: F64
    cell: float

    def first_hits(self, origins: F64, directions: F64, reach: float) -> F64:
        """(n,) distances to where rays are stopped, inf where nothing stops them within `reach`.

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
        """Whether nothing opaque is within two cells of a point (3,)."""
        around = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 3), axis=-1).reshape(-1, 3)
        return bool((self.at(position + around * self.cell) <= OPAQUE_DEPTH / 2).all())

    def at(self, points: F64) -> F64:
        """(...) optical depths of the cells that hold the points (..., 3); 0 outside."""
        return self._at([points[..., k] for k in range(3)])

    def _at(self, columns: Sequence[F64]) -> F64:
        """As `at`, of points given by their coordinates."""
        cells = np.zeros(columns[0].shape, np.int64)
        for column, corner in zip(columns, self.corner, strict=True):
            place = column - corner
            place /= self.cell
            place += 1
            np.fmin(np.fmax(place, 0, out=place), CELLS + 1, out=place)  # NaN lies outside
            cells *= CELLS + 2
            cells += place.astype(np.int64)
        depths: F64 = self.depth.ravel().take(cells)
        return depths


def build_grid(matter: Matter, centre: F64, half: float) -> Grid:
    """Matter spread into a cube of half-width `half` around `centre`."""
    cell = 2 * half / CELLS
    corner = centre - half
    depth = np.zeros(CELLS**3)
    # A cell-sized splat must not leave holes: its matter lies at five places of its ellipse.
    share = matter.areas * matter.stride / cell**2 / 5
    for first, second in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
        points = matter.points + first * matter.arms[:, 0] + second * matter.arms[:, 1]
        place = (points - corner) / cell
        inside = ((place >= 0) & (place < CELLS)).all(axis=1)
        flat = np.ravel_multi_index(tuple(place[inside].astype(np.int64).T), (CELLS,) * 3)
        depth += np.bincount(flat, share[inside], minlength=CELLS**3)
    smooth = depth.reshape(CELLS, CELLS, CELLS)
    for axis in range(3):  # with the cell before, so that no seam is thinner than a cell
        before = np.zeros_like(smooth)
        np.moveaxis(before, axis, 0)[1:] = np.moveaxis(smooth, axis, 0)[:-1]
        smooth = (smooth + before) / 2
    return Grid(np.pad(smooth, 1), corner, cell)
