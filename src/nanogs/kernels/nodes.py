"""Moments of groups of splats: covariances, their means, and conversion to scales and rotations.

A covariance is a row of six float64 in the order xx, xy, xz, yy, yz, zz.
"""

import numpy as np

from nanogs._types import F32, F64, I32, I64
from nanogs.kernels.blocks import prefetch_row
from nanogs.kernels.lazy_features import mean_feature
from nanogs.kernels.policy import inline, kernel, parallel_kernel
from nanogs.kernels.quaternion import rotation_matrix, row3, unit_quaternion
from nanogs.kernels.symmetric3 import Symmetric3, covariance, deviation, eigen, shortest_last


@inline
def symmetric(covariances: F64, row: int) -> Symmetric3:
    """Return a row of an (N, 6) array of covariances as a tuple."""
    return (
        covariances[row, 0], covariances[row, 1], covariances[row, 2],
        covariances[row, 3], covariances[row, 4], covariances[row, 5],
    )  # fmt: skip


@parallel_kernel("scales")
def covariances_of(
    start: int, stop: int, scales: F32, quats: F32, flattest: float, least: float, out: F64
) -> None:
    """Compute R diag(s²) Rᵀ, no axis thinner than `flattest` times the longest, nor than `least`.

    scales: (N, 3) and least: scene units; quats: (N, 4) wxyz unit; out: (N, 6).
    """
    for i in range(start, stop):
        x, y, z = row3(scales, i)
        floor = max(flattest * max(x, y, z), least)
        x, y, z = max(x, floor), max(y, floor), max(z, floor)
        matrix = covariance(rotation_matrix(quats[i]), x * x, y * y, z * z)
        for entry in range(6):
            out[i, entry] = matrix[entry]


@kernel
def join_pairs_of_nodes(
    pairs: I32, made: int, ids: I32, merges: I32, children: I32, starts: I64, members: I32
) -> None:  # fmt: skip
    """Replace every pair of rows by one row, at the smaller one, and list the new rows' members.

    pairs: (P, 2) rows, i < j, none twice; made: number of the node that the first pair makes; ids:
    (N,) node numbers of the rows; out, those of the N - P new rows in the first places; merges:
    (N,) all -1, changed; children: (P, 2) out, numbers of the two nodes that each pair joins;
    starts: (N - P + 1,) and members: (N,) filled, as `group_members` does.
    """
    for merge in range(len(pairs)):
        i, j = pairs[merge, 0], pairs[merge, 1]
        children[merge, 0], children[merge, 1] = ids[i], ids[j]
        merges[i], merges[j] = merge, -2
    row = place = 0
    for old in range(len(ids)):
        merge = merges[old]
        if merge != -2:
            starts[row] = place
            members[place] = old
            place += 1
            if merge >= 0:
                members[place] = pairs[merge, 1]
                place += 1
                ids[row] = made + merge
            else:
                ids[row] = ids[old]
            row += 1
    starts[row] = place


@kernel
def heaviest_members(labels: I32, weights: F64, members: I64) -> None:
    """Find the first member of largest weight of every group.

    labels: (N,) in [0, G); weights: (N,); members: (G,) all -1, filled.
    """
    for row in range(len(labels)):
        leader = members[labels[row]]
        if leader < 0 or weights[row] > weights[leader]:
            members[labels[row]] = row


@parallel_kernel("new_weights", each=32)
def gather_moments(
    start: int, stop: int,
    starts: I64, members: I32,
    weights: F64, coverages: F64, means: F64, covariances: F64,
    features: F32, rows: I32, second_rows: I32, shares: F64,
    new_weights: F64, new_coverages: F64, new_means: F64, new_covariances: F64, new_features: F32,
) -> None:  # fmt: skip
    """Compute weighted mean, covariance and features of every group; sum weights and coverages.

    mu_m = sum w mu / W, Sigma_m = sum w (Sigma + (mu - mu_m)(mu - mu_m)^T) / W, f_m = sum w f / W.
    starts (G + 1,) and members (N,): from `group_members`; weights: (N,), all above 0; coverages:
    (N,); means: (N, 3); covariances: (N, 6); features, rows, second_rows and shares: see
    `lazy_features.py`; the new ones have G rows.
    """
    channels = features.shape[1]
    colour = np.empty(channels)
    for group in range(start, stop):
        first, end = starts[group], starts[group + 1]
        anchor = members[first]
        total = covered = x = y = z = 0.0
        for place in range(first, end):
            row = members[place]
            w = weights[row]
            total += w
            covered += coverages[row]
            # Relative to the first member: the mean keeps its precision far from the origin.
            x += w * (means[row, 0] - means[anchor, 0])
            y += w * (means[row, 1] - means[anchor, 1])
            z += w * (means[row, 2] - means[anchor, 2])
            if channels > 0:  # without features there are no rows of them either
                prefetch_row(features, rows[row])
        x = means[anchor, 0] + x / total
        y = means[anchor, 1] + y / total
        z = means[anchor, 2] + z / total
        xx = xy = xz = yy = yz = zz = 0.0
        for place in range(first, end):
            row = members[place]
            share = weights[row] / total
            dx, dy, dz = means[row, 0] - x, means[row, 1] - y, means[row, 2] - z
            xx += share * (covariances[row, 0] + dx * dx)
            xy += share * (covariances[row, 1] + dx * dy)
            xz += share * (covariances[row, 2] + dx * dz)
            yy += share * (covariances[row, 3] + dy * dy)
            yz += share * (covariances[row, 4] + dy * dz)
            zz += share * (covariances[row, 5] + dz * dz)
        new_weights[group], new_coverages[group] = total, covered
        new_means[group, 0], new_means[group, 1], new_means[group, 2] = x, y, z
        new_covariances[group, 0], new_covariances[group, 1] = xx, xy
        new_covariances[group, 2], new_covariances[group, 3] = xz, yy
        new_covariances[group, 4], new_covariances[group, 5] = yz, zz
        if channels == 0:
            continue
        # Compiled as vectors, because rows are found before the loops over channels.
        for c in range(channels):
            colour[c] = 0.0
        for place in range(first, end):
            row = members[place]
            share, one = weights[row] / total, rows[row]
            if len(second_rows) == 0:
                for c in range(channels):
                    colour[c] += share * features[one, c]
            else:
                other, p, q = second_rows[row], shares[row, 0], shares[row, 1]
                for c in range(channels):
                    colour[c] += share * mean_feature(features, one, other, p, q, c)
        for c in range(channels):
            new_features[group, c] = colour[c]


@parallel_kernel("covariances")
def principal_axes(start: int, stop: int, covariances: F64, scales: F32, quats: F32) -> None:
    """Compute standard deviations and rotation of every covariance; the shortest axis is the third.

    covariances: (N, 6); scales: (N, 3) out, scene units; quats: (N, 4) out, wxyz unit.
    """
    for i in range(start, stop):
        variances, axes = eigen(symmetric(covariances, i))
        variances, axes = shortest_last(variances, axes)
        q = unit_quaternion(axes)
        longest = max(variances[0], variances[1], variances[2])
        for axis in range(3):
            scales[i, axis] = deviation(variances[axis], longest)
        for part in range(4):
            quats[i, part] = q[part]
