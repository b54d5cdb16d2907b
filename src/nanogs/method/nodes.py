"""Nodes of the merge forest: splats, or groups of splats, described by their moments.

The weight of a node says how much its errors matter: its coverage, reduced if it is far from all
viewers (`prominence`), times its visibility. A merge conserves only the coverage
(`store_groups`).
"""

from dataclasses import dataclass, field, replace

import numpy as np

from nanogs import parallel
from nanogs._types import F32, F64, I32, I64, Bool
from nanogs.activations import alphas
from nanogs.averages import cap, capped_mean
from nanogs.kernels.grouping import group_members
from nanogs.kernels.nodes import covariances_of, gather_moments, heaviest_members
from nanogs.method.activation import activated
from nanogs.method.viewers import Dilation, Viewers
from nanogs.slices import SLICE_STEPS, slices
from nanogs.splats import Splats, pick

UNRESOLVED = 1e-15  # sum of minors over the squared trace below which it may be rounding alone
NEARER = 4.0  # factor by which a close view is nearer than a view of the whole model
LIGHTEST = 1e-9  # least weight, over the typical one
_IMMENSE = 1e6  # weight over the median of all, above which a splat counts no more for their mean
_WEIGHED = 2**16  # about how many weights the median is taken of
FLATTEST = 1e-3  # least ratio of a node's axes, shortest to longest: log-determinants stay finite


@dataclass(frozen=True, slots=True, eq=False)
class Nodes:
    """N nodes, in an order that keeps spatial neighbours close together.

    Attributes:
        weights: (N,) float64, above 0; the `typical_weight` of all splats is about 1.
        coverages: (N,) float64, alpha times footprint, square scene units.
        means: (N, 3) float64, scene units, relative to the origin of the run.
        covariances: (N, 6) float64, xx, xy, xz, yy, yz, zz, square scene units.
        features: (F, C) float32, all spherical-harmonic coefficients; those of splats are the
            input's own, in its order, and are not copied.
        rows: (N,) int32, row of the features for each node.
        second_rows: (N,) int32, a second row of the features for each node, whose features are then
            the weighted mean of both; empty, (0,), if each node has one row.
        shares: (N, 2) float64, the weights of that mean, or (0, 2).
    """

    weights: F64
    coverages: F64
    means: F64
    covariances: F64
    features: F32
    rows: I32
    second_rows: I32 = field(default_factory=lambda: np.empty(0, np.int32))
    shares: F64 = field(default_factory=lambda: np.empty((0, 2)))

    def __len__(self) -> int:
        return len(self.means)


def footprints(covariances: F64, pixel: F64 | float) -> F64:
    """Compute (N,) float64 footprints: projected areas, mean over directions, square scene units.

    The determinant of a covariance projected along n is nᵀ adj(Sigma) n, whose mean over directions
    is the sum of the principal 2x2 minors over 3: independent of the rotation of the scene. As in
    the rasteriser, the variance of 0.3 pixels² is added first, so that a splat thinner than a pixel
    covers no less. A pixel is smaller for a nearer viewer, so the mean of two distances is taken:
    that of a view of the whole model, and one `NEARER` times as near.

    Args:
        covariances: (N, 6), square scene units.
        pixel: Standard deviation of the rasteriser's dilation, scene units: (N,), or one for all.
    """
    xx, xy, xz, yy, yz, zz = covariances.T
    trace = xx + yy + zz
    minors = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz
    # For a covariance far longer than wide, rounding errors dominate, and may be negative.
    minors = np.maximum(minors, UNRESOLVED * trace * trace)
    far, near = np.square(pixel), np.square(pixel / NEARER)
    areas: F64 = np.sqrt((minors + far * (2 * trace + 3 * far)) / 3)
    areas += np.sqrt((minors + near * (2 * trace + 3 * near)) / 3)
    areas *= np.pi
    return areas


def activate_nodes(
    splats: Splats,
    rows: I64 | I32,
    origin: F64,
    dilation: Dilation,
    thinnest: float | None = None,
    coverages: F64 | None = None,
    *,
    blurred: bool = False,
) -> Nodes:
    """Make one node for each splat, with full visibility.

    Args:
        splats: The input.
        rows: (M,) rows of it, all finite, in the nodes' order.
        origin: (3,) subtracted from the centres, scene units.
        dilation: The rasteriser's dilation by position, relative to the origin.
        thinnest: Shortest axis of any node, scene units, above 0; by default from `thinnest_axis`.
        coverages: (M,) float64 of the same nodes, if they are known from an earlier call.
        blurred: Whether covariances are blurred (`Dilation.blurs`), as for growing a forest:
            splats that differ only within a pixel then cost little to merge.

    Returns:
        The nodes; their rows are those of the input.
    """
    rows = rows.astype(np.int32, copy=False)
    means, covariances = _shapes(splats, rows, origin, dilation.least, thinnest)
    distances = dilation.distances(means)
    if coverages is None:
        coverages = _coverages(splats, rows, covariances, dilation.added(distances))
    if blurred:
        widen(covariances, squared(dilation.blurs_at(distances)))
    features = np.ascontiguousarray(splats.sh).reshape(len(splats), -1)
    weights = normalised(coverages * dilation.nearness_at(distances))
    return Nodes(weights, coverages, means, covariances, features, rows)


def widen(covariances: F64, variances: F64) -> None:
    """Add a variance in all directions to each covariance, in place.

    Args:
        covariances: (N, 6), square scene units.
        variances: (N,), square scene units.
    """
    for entry in (0, 3, 5):
        covariances[:, entry] += variances


def squared(deviations: F32) -> F64:
    """Return (N,) squares in double precision, whose range holds them."""
    return np.square(deviations, dtype=np.float64)


def prominence(coverages: F64, means: F64, viewers: Dilation | Viewers) -> F64:
    """Compute (N,) float64 prominences: coverages times the relative size on viewers' screens.

    Args:
        coverages: (N,) float64, square scene units.
        means: (N, 3) float64, scene units, relative to the origin of the run.
        viewers: Positions of viewers, estimated from the model or taken from a user's cameras.
    """
    prominences = viewers.nearness(means)
    prominences *= coverages
    return prominences


def _coverages(splats: Splats, rows: I32, covariances: F64, pixels: F64) -> F64:
    """Compute (M,) float64 coverages, alpha times footprint; overwrites and returns `pixels`."""
    coverages = pixels

    def cover(part: slice) -> None:
        opacities = alphas(pick(splats.opacity_logits, rows[part]))
        coverages[part] = opacities * footprints(covariances[part], pixels[part])

    parallel.for_each(slices(len(rows), SLICE_STEPS), cover)
    return coverages


def _shapes(
    splats: Splats, rows: I32, origin: F64, pixel: float, thinnest: float | None
) -> tuple[F64, F64]:
    """Compute the means and covariances for `activate_nodes`."""
    # Allocated before the temporaries below, so that freeing them leaves no hole in the heap.
    covariances = np.empty((len(rows), 6))
    means, scales, quats = activated(splats, rows, origin)
    least = thinnest_axis(scales, means, pixel) if thinnest is None else thinnest
    covariances_of(scales, quats, FLATTEST, least, covariances)
    return means, covariances


def without_coverages(nodes: Nodes) -> Nodes:
    """Drop the coverages, which growing a forest does not need; they share the weights' memory."""
    return replace(nodes, coverages=nodes.weights)


def without_features(nodes: Nodes, chosen: Bool | I64 | slice) -> Nodes:
    """Return some of the nodes without features, for uses that need no colours.

    Args:
        nodes: N nodes, each with one row of features.
        chosen: (N,) mask, indices or a slice of the nodes.
    """
    return replace(
        nodes, weights=nodes.weights[chosen], coverages=nodes.coverages[chosen],
        means=nodes.means[chosen], covariances=nodes.covariances[chosen],
        features=np.empty((0, 0), np.float32), rows=np.empty(0, np.int32),
    )  # fmt: skip


def thinnest_axis(scales: F32, means: F64, pixel: float) -> float:
    """Return the least length of a node's axes, scene units, for points too; always above 0.

    Args:
        scales: (N, 3) the nodes' axes, scene units.
        means: (N, 3) their centres, scene units.
        pixel: The least size of a pixel in the scene, scene units; 0 without dilation.
    """
    if pixel > 0:
        return 1e-3 * pixel
    extended = scales[scales > 0]
    # The median, because a few splats, as of a sky, may be many times as large as all others; the
    # lower of two, because their sum can overflow in float32.
    typical = float(np.quantile(extended, 0.5, method="lower")) if len(extended) else 0.0
    return 1e-6 * typical or 1e-6 * float(np.ptp(means, axis=0).max()) or 1.0


def normalised(weights: F64) -> F64:
    """Divide weights by `typical_weight`, and raise them to `LIGHTEST` at least."""
    unit = typical_weight(weights)
    return np.maximum(weights / unit, LIGHTEST) if unit > 0 else np.ones(len(weights))


def typical_weight(weights: F64) -> float:
    """Return the mean of (N,) weights, of which each counts as 10^6 medians at most; 0 if all are.

    So one immense splat does not make all others equal, at `LIGHTEST`.
    """
    return capped_mean(weights, _some(weights), _IMMENSE)


def immense_weight(weights: F64) -> float:
    """Return the weight that one of (N,) counts as at most for `typical_weight`."""
    return cap(_some(weights), _IMMENSE)


def _some(weights: F64) -> F64:
    return weights[:: len(weights) // _WEIGHED + 1]


def gather(nodes: Nodes, labels: I32, groups: int) -> Nodes:
    """Merge each group into one node: moments are matched, weights and coverages summed.

    Args:
        nodes: N nodes.
        labels: (N,) int32, each node's group in [0, groups); no group is empty.
        groups: Number of groups.
    """
    return gather_groups(nodes, *member_lists(labels, groups))


def gather_groups(nodes: Nodes, starts: I64, members: I32) -> Nodes:
    """Merge groups, given as by `member_lists`, into one node each; see `gather`."""
    rows = np.arange(len(starts) - 1, dtype=np.int32)
    return _gathered(nodes, starts, members, nodes.features, rows)


def gather_pairs(leaves: Nodes, starts: I64, members: I32) -> Nodes:
    """Merge groups of one or two splats; features are not averaged but refer to the splats' rows.

    Args:
        leaves: N nodes, one for each splat.
        starts: (G + 1,) start of each group; see `member_lists`.
        members: (N,) members of the groups; see `member_lists`.
    """
    merged = _gathered(leaves, starts, members, np.empty((0, 0), np.float32), leaves.rows[:0])
    groups = len(starts) - 1
    rows, shares = np.empty((2, groups), np.int32), np.empty((groups, 2))

    def share(part: slice) -> None:
        first = members.take(starts[part])
        last = members.take(starts[part.start + 1 : part.stop + 1] - 1)
        rows[0, part], rows[1, part] = leaves.rows.take(first), leaves.rows.take(last)
        weights = merged.weights[part]
        shares[part, 0] = leaves.weights.take(first) / weights
        shares[part, 1] = np.where(first == last, 0.0, leaves.weights.take(last) / weights)

    parallel.for_each(slices(groups, SLICE_STEPS), share)
    return replace(
        merged, features=leaves.features, rows=rows[0], second_rows=rows[1], shares=shares
    )  # fmt: skip


def _gathered(nodes: Nodes, starts: I64, members: I32, features: F32, rows: I32) -> Nodes:
    """Compute the nodes of `gather`, with averaged `features` and the given rows of them."""
    groups = len(starts) - 1
    weights = np.empty(groups)
    result = Nodes(
        weights,
        weights if nodes.coverages is nodes.weights else np.empty(groups),
        np.empty((groups, 3)),
        np.empty((groups, 6)),
        np.empty((groups, features.shape[1]), np.float32),
        rows,
    )
    gather_moments(
        starts,
        members,
        nodes.weights,
        nodes.coverages,
        nodes.means,
        nodes.covariances,
        features,
        nodes.rows,
        nodes.second_rows,
        nodes.shares,
        result.weights,
        result.coverages,
        result.means,
        result.covariances,
        result.features,
    )
    return result


def member_lists(labels: I32, groups: int) -> tuple[I64, I32]:
    """Sort nodes by group: return the start of each group, (groups + 1,), and the members, (N,)."""
    starts = np.zeros(groups + 1, dtype=np.int64)
    members = np.empty(len(labels), dtype=np.int32)
    group_members(labels, starts, members)
    return starts, members


def dominant_members(nodes: Nodes, labels: I32, groups: int) -> I64:
    """Return the (groups,) int64 members of largest weight, the first of equal ones."""
    dominant = np.full(groups, -1, dtype=np.int64)
    heaviest_members(labels, nodes.weights, dominant)
    return dominant


def stored_order(leaves: Nodes, labels: I32, groups: int) -> tuple[I64, I64, Bool]:
    """Sort groups by the rows of their dominant members in the input, the order of the output.

    Returns:
        Three (groups,) arrays in this order: row in the input of the dominant member, group, and
        whether the group has several members.
    """
    sources = leaves.rows[dominant_members(leaves, labels, groups)].astype(np.int64)
    order = np.argsort(sources)
    merged = np.bincount(labels, minlength=groups) > 1
    return sources[order], order, merged[order]
