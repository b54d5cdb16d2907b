"""Reference versions of the kernels in plain float64, as simple as possible."""

import itertools
import math

import numpy as np


def rotation_matrix(quat):
    """Quaternion product q (0, v) q* on the three unit vectors, column by column."""

    def product(a, b):
        w = a[0] * b[0] - a[1:] @ b[1:]
        return np.array([w, *(a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))])

    quat = np.asarray(quat, dtype=np.float64)
    conjugate = quat * (1, -1, -1, -1)
    columns = [product(product(quat, np.array([0.0, *v])), conjugate)[1:] for v in np.eye(3)]
    return np.stack(columns, axis=1)


def covariance(scales, quat, jitter=0.0):
    rotation = rotation_matrix(quat)
    return rotation @ np.diag(np.asarray(scales, dtype=np.float64) ** 2 + jitter) @ rotation.T


def mass(splat):
    return (2 * math.pi) ** 1.5 * splat["opacity"] * np.prod(splat["scales"].astype(np.float64))


def fraction(a, b):
    total = mass(a) + mass(b)
    return 0.5 if total == 0 else mass(a) / total


def moments(a, b, jitter=0.0):
    """Mean and covariance of the two-part mixture, from their definition."""
    pi = fraction(a, b)
    mean = pi * a["mean"] + (1 - pi) * b["mean"]
    total = np.zeros((3, 3))
    for share, part in ((pi, a), (1 - pi, b)):
        offset = part["mean"] - mean
        part_covariance = covariance(part["scales"], part["quat"], jitter)
        total += share * (part_covariance + np.outer(offset, offset))
    return mean, total


def merged(a, b):
    pi = fraction(a, b)
    mean, sigma = moments(a, b)
    return {
        "mean": mean,
        "covariance": sigma,
        "opacity": 1 - (1 - a["opacity"]) * (1 - b["opacity"]),
        "features": pi * a["features"].astype(np.float64) + (1 - pi) * b["features"],
    }


def log_normal_density(x, mean, sigma):
    offset = x - mean
    _, log_det = np.linalg.slogdet(sigma)
    return -0.5 * (3 * math.log(2 * math.pi) + log_det + offset @ np.linalg.solve(sigma, offset))


def divergence(a, b, normals, jitter):
    """KL of the mixture from the moment-matched normal, by the same draws as the kernel."""
    shares = (fraction(a, b), 1 - fraction(a, b))
    sigmas = [covariance(part["scales"], part["quat"], jitter) for part in (a, b)]
    _, sigma_m = moments(a, b, jitter)
    expected_log_p = 0.0
    for share, part in zip(shares, (a, b), strict=True):
        if share == 0:
            continue
        root = rotation_matrix(part["quat"]) @ np.diag(
            np.sqrt(part["scales"].astype(np.float64) ** 2 + jitter)
        )
        logs = []
        for z in normals:
            x = part["mean"] + root @ z
            terms = [
                math.log(s) + log_normal_density(x, p["mean"], sigma)
                for s, p, sigma in zip(shares, (a, b), sigmas, strict=True)
                if s > 0
            ]
            logs.append(np.logaddexp.reduce(terms))
        expected_log_p += share * np.mean(logs)
    sigma_m += jitter * np.eye(3)
    cross_entropy = 0.5 * (3 * math.log(2 * math.pi) + np.linalg.slogdet(sigma_m)[1] + 3)
    return expected_log_p + cross_entropy


def cost(a, b, normals, jitter, lambda_geo=1.0, lambda_app=1.0):
    colour = np.sum((a["features"].astype(np.float64) - b["features"]) ** 2)
    return lambda_geo * divergence(a, b, normals, jitter) + lambda_app * colour


def nearest_neighbours(means, k):
    """The k nearest rows by (squared distance, row); of more than k equal means, the next k."""
    k, found = min(k, len(means) - 1), []
    for i, mean in enumerate(means):
        x, y, z = (means - mean).T
        squares = x * x + y * y + z * z
        group = [j for j in range(len(means)) if (means[j] == mean).all()]
        if len(group) > k:
            position = group.index(i)
            found.append([group[(position + step) % len(group)] for step in range(1, k + 1)])
        else:
            others = (j for j in range(len(means)) if j != i)
            found.append(sorted(others, key=lambda j: (squares[j], j))[:k])
    return found


def neighbour_distances(means, k):
    """(N, k) distances to the nearest other rows, by comparing all with all."""
    distances = np.linalg.norm(means[:, None] - means[None], axis=2)
    np.fill_diagonal(distances, np.inf)
    return np.sort(distances, axis=1)[:, : min(k, len(means) - 1)]


def pairs_of(neighbours):
    return sorted({tuple(sorted((i, int(j)))) for i, row in enumerate(neighbours) for j in row})


def greedy(pairs, costs, limit):
    """Choose pairs, cheapest first, ties by pair, whose two rows are both still free."""
    taken, chosen = set(), []
    candidates = zip(costs, map(tuple, pairs), strict=True)
    for _, pair in sorted(entry for entry in candidates if not math.isnan(entry[0])):
        if len(chosen) < limit and not taken & set(pair):
            chosen.append(pair)
            taken |= set(pair)
    return chosen


def morton_code(cell):
    """Interleave the bits of three cell numbers, x lowest."""
    bits = itertools.product(range(21), range(3))
    return sum(((int(cell[axis]) >> bit) & 1) << (3 * bit + axis) for bit, axis in bits)


# The merge forest


def unpack(six):
    xx, xy, xz, yy, yz, zz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def pack(matrix):
    return matrix[np.triu_indices(3)]


def floored_covariance(scales, quat, flattest, least):
    scales = np.asarray(scales, dtype=np.float64)
    return covariance(np.maximum(scales, max(flattest * scales.max(), least)), quat)


def group_moments(weights, coverages, means, sigmas, features):
    """One group's total weight and coverage, mean, covariance (3, 3) and features."""
    shares = weights / weights.sum()
    mean = shares @ means
    offsets = means - mean
    sigma = np.einsum("n,nij->ij", shares, sigmas) + (offsets.T * shares) @ offsets
    return weights.sum(), coverages.sum(), mean, sigma, shares @ features.astype(np.float64)


def merge_increment(weights, means, sigmas, features):
    """Colour and geometry that the merge of two nodes adds; each argument has two rows."""
    total, _, _, merged_sigma, _ = group_moments(weights, weights, means, sigmas, features)
    centre = (weights @ features.astype(np.float64)) / total
    colour = sum(w * np.sum((f - centre) ** 2) for w, f in zip(weights, features, strict=True))
    before = sum(w * np.linalg.slogdet(s)[1] for w, s in zip(weights, sigmas, strict=True))
    return colour, 0.5 * (total * np.linalg.slogdet(merged_sigma)[1] - before)


def divergence_from_merged(weights, means, sigmas, samples, seed):
    """Monte Carlo KL of a two-part mixture from the normal of its moments, nats."""
    shares = weights / weights.sum()
    _, _, mean, sigma, _ = group_moments(weights, weights, means, sigmas, np.zeros((2, 1)))
    rng = np.random.default_rng(seed)
    parts = rng.choice(2, samples, p=shares)
    roots = np.linalg.cholesky(sigmas)
    x = means[parts] + np.einsum("nij,nj->ni", roots[parts], rng.normal(size=(samples, 3)))

    def log_density(mean, sigma):
        offsets = x - mean
        squares = np.einsum("ni,ij,nj->n", offsets, np.linalg.inv(sigma), offsets)
        return -0.5 * (3 * math.log(2 * math.pi) + np.linalg.slogdet(sigma)[1] + squares)

    logs = [math.log(p) + log_density(m, s) for p, m, s in zip(shares, means, sigmas, strict=True)]
    return np.mean(np.logaddexp(*logs) - log_density(mean, sigma))


def leaves_below(children, node, count):
    """Return the splats below a node of a forest over `count` splats."""
    if node < count:
        return [int(node)]
    first, second = children[node - count]
    return leaves_below(children, first, count) + leaves_below(children, second, count)


def merges_below(children, node, count):
    """Return the merges of a node's subtree, its own included."""
    if node < count:
        return []
    first, second = children[node - count]
    below = merges_below(children, first, count) + merges_below(children, second, count)
    return [*below, int(node - count)]


def misfit(mean, sigma, features, centre, cluster_sigma, colour, lambda_app):
    """Kullback-Leibler divergence of a splat from a cluster, plus that of the colours."""
    inverse, offset = np.linalg.inv(cluster_sigma), mean - centre
    fit = offset @ inverse @ offset + np.trace(inverse @ sigma)
    geometry = 0.5 * (fit - 3 - np.linalg.slogdet(inverse @ sigma)[1])
    return geometry + lambda_app * np.sum((features.astype(np.float64) - colour) ** 2)


def projected_area(covariance, direction):
    """Standard deviations' product of a Gaussian seen along a unit vector: that of its shadow."""
    first = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    plane = np.stack([first / np.linalg.norm(first), np.cross(direction, first)])
    plane[1] /= np.linalg.norm(plane[1])
    return math.sqrt(np.linalg.det(plane @ covariance @ plane.T))


def directional_colours(weights, covariances, features, colour, directions, basis, fitted, steps):
    """Fit a group's coefficients, (C, 3), to its members', (M, C, 3), in each direction."""
    areas = np.array([[projected_area(s, d) for d in directions] for s in covariances])
    areas *= (weights / weights.sum() / areas.mean(axis=1))[:, None]
    shown = np.maximum(0, 0.5 + np.einsum("dc,mcr->mdr", basis, features))
    light, colour = np.einsum("md,mdr->dr", areas, shown), colour.copy()
    for step in steps:
        residual = light - areas.sum(axis=0)[:, None] * np.maximum(0, 0.5 + basis @ colour)
        gradient = basis[:, :fitted].T @ residual * 4 * math.pi / len(directions)
        colour[:fitted] += step * gradient
    return colour


def rotation_between(quat, other):
    """The vector of the rotation from one unit quaternion to another one near it."""
    (w, x, y, z), (a, b, c, d) = quat, other
    matrix = np.array([[w, x, y, z], [-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]])
    return 2 * (matrix @ [a, b, c, d])[1:]


def cheapest_level(value, curvature, levels, lengths, price, most):
    """The level of least cost, of those that change the value by at most that, or the nearest."""
    changes = np.asarray(levels) - value
    costs = curvature * changes**2 + price * np.asarray(lengths)
    allowed = np.abs(changes) <= most
    allowed[np.abs(changes).argmin()] = True
    return int(np.where(allowed, costs, np.inf).argmin())


def cheapest_rotation(quat, curvatures, levels, lengths, price, most, codes):
    """The codes of x, y and z of least cost, found one after the other, twice."""
    codes = list(codes)

    def error(tried):
        x, y, z = (levels[code] for code in tried)
        square = 1 - x * x - y * y - z * z
        if square < (max(abs(x), abs(y), abs(z)) + 1e-3) ** 2:
            return np.inf
        turn = rotation_between(quat, [math.sqrt(square), x, y, z])
        return np.inf if turn @ turn > most**2 else curvatures @ turn**2

    def reached(k, way):
        """The codes up to the first that is not allowed."""
        found = []
        code = codes[k] + way
        while 0 <= code < len(levels) and error([*codes[:k], code, *codes[k + 1 :]]) < np.inf:
            found.append(code)
            code += way
        return found

    for _ in range(2):
        for k in range(3):
            tried = [codes[k], *reached(k, -1), *reached(k, 1)]
            costs = [
                error([*codes[:k], code, *codes[k + 1 :]]) + price * lengths[k][code]
                for code in tried
            ]
            codes[k] = tried[int(np.argmin(costs))]
    return codes
