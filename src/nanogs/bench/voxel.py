"""Voxel merging: all splats whose centres share a cell of a cubic grid are merged into one.

The exact count is reached in two steps. Bisection on the cell size finds the grid with most
occupied cells that has no more than the count. Then, until the count is reached, the cell with most
members (ties by cell) is split at the median member along its widest axis. The split is by rank, so
that coincident centres can be separated too.
"""

import heapq
from dataclasses import replace

import numpy as np

from nanogs._types import F64, I64, F
from nanogs.activations import quaternions, rotations
from nanogs.method.activation import scene_origin
from nanogs.method.paper.cost import log_masses
from nanogs.method.paper.gaussians import Gaussians, activate, store
from nanogs.splats import Splats

_BISECTIONS = 40
# Cells along the widest axis; three indices of at most 21 bits are packed into an int64 key.
_FEWEST_CELLS, _MOST_CELLS = 0.5, 2.0**20


def merge_voxels(splats: Splats, rows: I64, count: int) -> Splats:
    """Return a model of exactly `count` splats, one for each group of splats.

    Args:
        splats: The input.
        rows: (M,) rows of it to use, all finite, at least `count`.
        count: Splats to deliver.
    """
    origin = scene_origin(splats.means[rows])
    gaussians = activate(splats, rows, origin)
    labels = voxel_labels(gaussians.means, count)
    return store(merge_groups(gaussians, labels), splats, origin)


def voxel_labels(means: F64, count: int) -> I64:
    """Assign centres to exactly `count` groups: the cells of a grid, some of them split.

    Args:
        means: (N, 3) finite, scene units.
        count: Groups, at most N.

    Returns:
        (N,) int64 from 0 to count - 1; no group is empty.
    """
    labels = _finest_grid(means, count)
    groups = _members(labels)
    heap = [(-len(group), index) for index, group in enumerate(groups)]
    heapq.heapify(heap)
    while len(groups) < count:
        _, index = heapq.heappop(heap)
        lower, upper = _halves(means, groups[index])
        groups[index] = lower
        groups.append(upper)
        heapq.heappush(heap, (-len(lower), index))
        heapq.heappush(heap, (-len(upper), len(groups) - 1))
        labels[upper] = len(groups) - 1
    return labels


def _finest_grid(means: F64, count: int) -> I64:
    """Return (N,) int64: cells of the finest grid found with at most `count` occupied cells."""
    low = means.min(axis=0)
    width = float((means.max(axis=0) - low).max())
    best = np.zeros(len(means), dtype=np.int64)
    if width == 0:
        return best
    coarse, fine = np.log(_FEWEST_CELLS), np.log(_MOST_CELLS)
    most = 1
    for _ in range(_BISECTIONS):
        middle = (coarse + fine) / 2
        labels, cells = _grid(means - low, float(np.exp(middle)) / width)
        if cells > count:
            fine = middle
            continue
        coarse = middle
        if cells >= most:  # a finer grid does not always have more occupied cells
            best, most = labels, cells
        if cells == count:
            break
    return best


def _grid(offsets: F64, cells_per_unit: float) -> tuple[I64, int]:
    """Return the consecutive labels of the offsets' (N, 3) cells, and the number of cells."""
    cells = np.floor(offsets * cells_per_unit).astype(np.int64)
    keys = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
    unique, labels = np.unique(keys, return_inverse=True)
    return labels.astype(np.int64), len(unique)


def _members(labels: I64) -> list[I64]:
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)


def _halves(means: F64, group: I64) -> tuple[I64, I64]:
    """Split a group of two or more into a lower and an upper half by rank along its widest axis."""
    centres = means[group]
    axis = int(np.argmax(np.ptp(centres, axis=0)))
    order = group[np.argsort(centres[:, axis], kind="stable")]
    middle = len(order) // 2
    return order[:middle], order[middle:]


def merge_groups(gaussians: Gaussians, labels: I64) -> Gaussians:
    """Replace each group by one splat with the same mass-weighted moments.

    With w = alpha s1 s2 s3, W its sum over the members and d_i = mu_i - mu: mu = Σ w mu_i / W,
    Sigma = Σ w (Sigma_i + d_i d_iᵀ) / W, and likewise for the SH coefficients. The opacity is the
    weighted mean too: the union of dozens of members would be nearly 1 almost everywhere. If no
    member of a group has mass, all have the same weight.

    Args:
        gaussians: N splats.
        labels: (N,) groups from 0 to G - 1, each with a member.

    Returns:
        G splats in the order of the groups; the splat of a group of one is unchanged.
    """
    order = np.argsort(labels, kind="stable")
    ordered, groups = gaussians.take(order), labels[order]
    starts = np.flatnonzero(np.diff(groups, prepend=-1))
    sizes = np.diff(starts, append=len(groups))
    log_weights = log_masses(ordered)
    shares = _shares(log_weights, starts, sizes)
    means = _mean(ordered.means, shares, starts)
    covariances = _covariances(ordered, ordered.means - np.repeat(means, sizes, axis=0))
    scales, quats = _axes(_mean(covariances, shares, starts))
    dominant = _dominant(shares, starts, sizes)
    result = ordered.take(dominant)
    many = sizes > 1
    result.means[many] = means[many]
    result.scales[many] = scales[many]
    result.quats[many] = quats[many]
    result.opacities[many] = np.minimum(_mean(ordered.opacities, shares, starts), 1.0)[many]
    features = ordered.colours()
    colours = features[dominant]
    for column in range(features.shape[1]):
        colours[many, column] = _mean(features[:, column], shares, starts)[many]
    result.merged[many] = True
    return replace(result, features=colours, rows=np.arange(len(colours), dtype=np.int32))


def _shares(log_weights: F64, starts: I64, sizes: I64) -> F64:
    """Return each member's share (N,) of its group's mass; a softmax, so that none underflows."""
    largest = np.maximum.reduceat(log_weights, starts)
    massless = np.repeat(largest == -np.inf, sizes)
    relative = np.where(massless, 0.0, log_weights)
    largest = np.where(largest == -np.inf, 0.0, largest)
    weights = np.exp(relative - np.repeat(largest, sizes))
    shares: F64 = weights / np.repeat(np.add.reduceat(weights, starts), sizes)
    return shares


def _mean(values: F, shares: F64, starts: I64) -> F64:
    weighted = values * shares.reshape(-1, *[1] * (values.ndim - 1))
    mean: F64 = np.add.reduceat(weighted, starts, axis=0)
    return mean


def _dominant(shares: F64, starts: I64, sizes: I64) -> I64:
    """Return the position (G,) of each group's member with the largest share, the first of ties."""
    groups = np.repeat(np.arange(len(starts)), sizes)
    order = np.lexsort((-shares, groups))
    return order[starts]


def _covariances(gaussians: Gaussians, offsets: F64) -> F64:
    """Compute R diag(s²) Rᵀ + d dᵀ, (N, 3, 3) float64, with d the offsets from the group's mean."""
    quats = gaussians.quats.astype(np.float64)
    axes = rotations(quats / np.linalg.norm(quats, axis=1, keepdims=True))
    factors = axes * gaussians.scales.astype(np.float64)[:, None, :]
    own: F64 = factors @ factors.transpose(0, 2, 1)
    return own + offsets[:, :, None] * offsets[:, None, :]


def _axes(covariances: F64) -> tuple[F64, F64]:
    """Decompose covariances (G, 3, 3) into scales (G, 3) and unit quaternions (G, 4), wxyz."""
    variances, axes = np.linalg.eigh(covariances)
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    return np.sqrt(np.maximum(variances, 0.0)), quaternions(axes)
