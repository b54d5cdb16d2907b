"""Nodes: splats, or groups of splats, by their moments; what the merge forest is made of.

The weight of a node says how much its errors matter: its coverage, less where it is far from all
viewers (`prominence`), times the share that is seen. A merge must conserve the coverage alone
(`store_groups`).
"""

from dataclasses import dataclass, field, replace

import numpy as np

from nanogs import spread
from nanogs._types import F32, F64, I32, I64, Bool
from nanogs.kernels.nodes import (
    covariances_of,
    gather_moments,
    group_members,
    heaviest_members,
)
from nanogs.method.activation import activated
from nanogs.method.extent import Dilation, Viewers
from nanogs.slices import SLICE_STEPS, slices
from nanogs.splats import Splats, pick
from nanogs.stored import alphas

UNRESOLVED = 1e-15  # of the squared trace: smaller minors may be rounding alone
NEARER = 4.0  # times as near as for a view of the whole model, to look at a part
LIGHTEST = 1e-9  # weight, over the mean of all, of what covers nothing or nearly so
FLATTEST = 1e-3  # thinnest axis of a node over its longest: log-determinants stay finite


@dataclass(frozen=True, slots=True, eq=False)
class Nodes:
    """N nodes, in an order in which neighbours in space are near.

    Attributes:
        weights: (N,) float64, above 0; 1 on the mean of all splats.
        coverages: (N,) float64, alpha times footprint, square scene units.
        means: (N, 3) float64, scene units, relative to the origin of the run.
        covariances: (N, 6) float64, xx, xy, xz, yy, yz, zz, square scene units.
        features: (F, C) float32, all spherical-harmonic coefficients; those of splats are the
            input's own, in its order, and are not copied.
        rows: (N,) int32, which row of the features is each node's.
        seconds: (N,) int32, another row of each node, whose features are then the mean of both;
            none, (0,), where each has its own.
        shares: (N, 2) float64, the weights of that mean, or (0, 2).
    """

    weights: F64
    coverages: F64
    means: F64
    covariances: F64
    features: F32
    rows: I32
    seconds: I32 = field(default_factory=lambda: np.empty(0, np.int32))
    shares: F64 = field(default_factory=lambda: np.empty((0, 2)))

    def __len__(self) -> int:
        return len(self.means)


def footprints(covariances: F64, pixel: F64 | float) -> F64:
    """(N,) float64: what covers the screen, averaged over directions, square scene units.

    The determinant of a covariance seen along n is nᵀ adj(Sigma) n, whose mean over directions is
    the sum of the principal 2x2 minors over 3: the same however the scene is turned. As the
    rasteriser does, the variance of 0.3 pixels² is added first: what is thinner than a pixel
    covers no less. A pixel is smaller where one stands nearer, so this is the mean of two places:
    where the model is seen as a whole, and `NEARER` times as near.

    Args:
        covariances: (N, 6), square scene units.
        pixel: Standard deviation of the rasteriser's dilation, scene units: (N,), or for all.
    """
    xx, xy, xz, yy, yz, zz = covariances.T
    trace = xx + yy + zz
    minors = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz
    # Of a covariance far longer than wide, rounding leaves anything, zero and below among it.
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
) -> Nodes:
    """One node for each splat, all of the splat's footprint visible.

    Args:
        splats: The input.
        rows: (M,) rows of it, all finite, in the nodes' order.
        origin: (3,) taken off the centres, scene units.
        dilation: What rasterisers add, by where splats are from the origin.
        thinnest: Axis of any node, scene units, above 0; by default what `thinnest_axis` says.
        coverages: (M,) float64 of the same nodes, where they are known from a call before.

    Returns:
        The nodes; their rows are those of the input.
    """
    rows = rows.astype(np.int32, copy=False)
    means, covariances = _shapes(splats, rows, origin, dilation.least, thinnest)
    distances = dilation.distances(means)
    if coverages is None:
        coverages = _coverages(splats, rows, covariances, dilation.added(distances))
    features = np.ascontiguousarray(splats.sh).reshape(len(splats), -1)
    weights = normalised(coverages * dilation.nearness_at(distances))
    return Nodes(weights, coverages, means, covariances, features, rows)


def prominence(coverages: F64, means: F64, viewers: Dilation | Viewers) -> F64:
    """(N,) float64: coverages as screens show them, less where splats are far from all viewers.

    Args:
        coverages: (N,) float64, square scene units.
        means: (N, 3) float64, scene units, relative to the origin of the run.
        viewers: Where they stand, as the model or a user's cameras tell.
    """
    prominences = viewers.nearness(means)
    prominences *= coverages
    return prominences


def _coverages(splats: Splats, rows: I32, covariances: F64, pixels: F64) -> F64:
    """(M,) float64: alpha times footprint, in the memory of the pixels."""
    coverages = pixels

    def cover(part: slice) -> None:
        opacities = alphas(pick(splats.opacity_logits, rows[part]))
        coverages[part] = opacities * footprints(covariances[part], pixels[part])

    spread.each(slices(len(rows), SLICE_STEPS), cover)
    return coverages


def _shapes(
    splats: Splats, rows: I32, origin: F64, pixel: float, thinnest: float | None
) -> tuple[F64, F64]:
    """The means and covariances of `activate_nodes`."""
    covariances = np.empty((len(rows), 6))  # before temporaries, whose freeing leaves no hole
    means, scales, quats = activated(splats, rows, origin)
    least = thinnest_axis(scales, means, pixel) if thinnest is None else thinnest
    covariances_of(scales, quats, FLATTEST, least, covariances)
    return means, covariances


def without_coverages(nodes: Nodes) -> Nodes:
    """The nodes for growing, which has no use for coverages: they take no memory of their own."""
    return replace(nodes, coverages=nodes.weights)


def without_features(nodes: Nodes, chosen: Bool | I64 | slice) -> Nodes:
    """Some of the nodes, for what has no use for colours; they have no rows of them either.

    Args:
        nodes: N nodes, each of one row.
        chosen: (N,) which, or the numbers of these.
    """
    return replace(
        nodes, weights=nodes.weights[chosen], coverages=nodes.coverages[chosen],
        means=nodes.means[chosen], covariances=nodes.covariances[chosen],
        features=np.empty((0, 0), np.float32), rows=np.empty(0, np.int32),
    )  # fmt: skip


def thinnest_axis(scales: F32, means: F64, pixel: float) -> float:
    """Thinnest axis of any node, scene units: points have one too; above 0 for every scene."""
    if pixel > 0:
        return 1e-3 * pixel
    return 1e-6 * float(scales.max()) or 1e-6 * float(np.ptp(means, axis=0).max()) or 1.0


def normalised(weights: F64) -> F64:
    """(N,) float64: weights over their mean, `LIGHTEST` or more."""
    mean = float(weights.mean())
    return np.maximum(weights / mean, LIGHTEST) if mean > 0 else np.ones(len(weights))


def gather(nodes: Nodes, labels: I32, groups: int) -> Nodes:
    """One node for each group: moments matched, weights and coverages added up.

    Args:
        nodes: N nodes.
        labels: (N,) int32, each node's group in [0, groups); no group is empty.
        groups: Their number.
    """
    return gather_groups(nodes, *member_lists(labels, groups))


def gather_groups(nodes: Nodes, starts: I64, members: I32) -> Nodes:
    """As `gather`, of groups as `member_lists` lists them."""
    rows = np.arange(len(starts) - 1, dtype=np.int32)
    return _gathered(nodes, starts, members, nodes.features, rows)


def gather_pairs(leaves: Nodes, starts: I64, members: I32) -> Nodes:
    """Gather groups of one or two splats; their features stay those of the splats.

    Args:
        leaves: N nodes, one a splat.
        starts: (G + 1,) as `member_lists` lists them.
        members: (N,) likewise.
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

    spread.each(slices(groups, SLICE_STEPS), share)
    return replace(
        merged, features=leaves.features, rows=rows[0], seconds=rows[1], shares=shares
    )  # fmt: skip


def _gathered(nodes: Nodes, starts: I64, members: I32, features: F32, rows: I32) -> Nodes:
    """The nodes of `gather`, with the means of these features and these rows of them."""
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
        nodes.seconds,
        nodes.shares,
        result.weights,
        result.coverages,
        result.means,
        result.covariances,
        result.features,
    )
    return result


def member_lists(labels: I32, groups: int) -> tuple[I64, I32]:
    """List where each group starts (groups + 1,), and the members (N,), group after group."""
    starts = np.zeros(groups + 1, dtype=np.int64)
    members = np.empty(len(labels), dtype=np.int32)
    group_members(labels, starts, members)
    return starts, members


def dominant_members(nodes: Nodes, labels: I32, groups: int) -> I64:
    """(groups,) int64: the member of largest weight of each group, the first of equal ones."""
    dominant = np.full(groups, -1, dtype=np.int64)
    heaviest_members(labels, nodes.weights, dominant)
    return dominant


def stored_order(leaves: Nodes, labels: I32, groups: int) -> tuple[I64, I64, Bool]:
    """How groups are stored: in the order of their dominant members in the input.

    Returns:
        Each (groups,), in this order: the row in the input of the dominant member, the group, and
        whether it has several members.
    """
    sources = leaves.rows[dominant_members(leaves, labels, groups)].astype(np.int64)
    order = np.argsort(sources)
    merged = np.bincount(labels, minlength=groups) > 1
    return sources[order], order, merged[order]
