"""Mass-preserving moment matching of pairs (arXiv 2603.16103)."""

from nanogs._types import F32, F64, I32, I64
from nanogs.kernels.mass import mass_fraction
from nanogs.kernels.policy import parallel_kernel
from nanogs.kernels.quaternion import rotation_matrix, row3, unit_quaternion
from nanogs.kernels.symmetric3 import covariance, deviation, eigen, mix, shortest_last


@parallel_kernel("pairs")
def merge_pairs(
    start: int, stop: int,
    pairs: I32, rows: I64, log_masses: F64,
    means: F64, scales: F32, quats: F32, opacities: F64,
    new_means: F64, new_scales: F32, new_quats: F32, new_opacities: F64, shares: F64,
) -> None:  # fmt: skip
    """Write the merge of each pair into its row of the new arrays.

    pairs: (P, 2) disjoint rows of the old arrays; rows: (P,) rows of the new arrays; log_masses:
    (N,); means, scales: (N, 3); quats: (N, 4) wxyz unit; opacities: (N,); shares: (M, 2), filled
    at `rows`: the weights of both in the mean of their features.
    """
    for p in range(start, stop):
        i, j, row = pairs[p, 0], pairs[p, 1], rows[p]
        wi = mass_fraction(log_masses[i], log_masses[j])
        wj = 1.0 - wi
        ri = rotation_matrix(quats[i])
        rj = rotation_matrix(quats[j])
        six, siy, siz = row3(scales, i)
        sjx, sjy, sjz = row3(scales, j)
        x = means[i, 0] - means[j, 0]
        y = means[i, 1] - means[j, 1]
        z = means[i, 2] - means[j, 2]
        # w_i d_i d_i^T + w_j d_j d_j^T about the common mean is w_i w_j d d^T, d = mu_i - mu_j.
        merged = mix(
            wi, covariance(ri, six * six, siy * siy, siz * siz),
            wj, covariance(rj, sjx * sjx, sjy * sjy, sjz * sjz), wi * wj, (x, y, z),
        )  # fmt: skip
        variances, axes = eigen(merged)
        variances, axes = shortest_last(variances, axes)
        q = unit_quaternion(axes)
        longest = max(variances[0], variances[1], variances[2])
        for axis in range(3):
            new_scales[row, axis] = deviation(variances[axis], longest)
            # From i by a fraction of the difference, so that the mean is between the two.
            new_means[row, axis] = means[i, axis] - wj * (means[i, axis] - means[j, axis])
        for part in range(4):
            new_quats[row, part] = q[part]
        new_opacities[row] = 1.0 - (1.0 - opacities[i]) * (1.0 - opacities[j])
        shares[row, 0], shares[row, 1] = wi, wj
