"""The kernels of a refit once more: float64, pixel by pixel, from the renderer's twin."""

import dataclasses
import math

import numpy as np

from raster_twin import splat_on_screen


def pixel_weights(splats, camera, cutoff=1 / 255):
    """(M,) rows nearest first, (M, H, W) weights T alpha and (M, H, W) T after each."""
    shape = (camera.height, camera.width)
    columns, rows = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    seen = {i: splat_on_screen(splats, camera, i) for i in range(len(splats))}
    order = sorted((i for i in seen if seen[i] is not None), key=lambda i: (seen[i][0], i))
    left, full = np.ones(shape), np.zeros(shape, bool)
    weights, after = [], []
    for i in order:
        _, centre, covariance, opacity, _ = seen[i]
        offsets = np.stack([columns - centre[0], rows - centre[1]], axis=-1)
        power = -0.5 * np.einsum("...i,ij,...j", offsets, np.linalg.inv(covariance), offsets)
        alpha = np.minimum(0.99, opacity * np.exp(power))
        alpha[alpha < cutoff] = 0
        full |= left * (1 - alpha) < 1e-4
        weights.append(np.where(full, 0, left * alpha))
        left = np.where(full, left, left * (1 - alpha))
        after.append(left)
    return np.array(order), np.array(weights), np.array(after)


def blend_twin(splats, camera, features, cutoff=1 / 255):
    """(H, W, C) image of features (N, C)."""
    order, weights, _ = pixel_weights(splats, camera, cutoff)
    return np.einsum("khw,kc->hwc", weights, features[order])


def pull_twin(splats, camera, features, residual, precision, cutoff=1 / 255):
    """(N, 25) sums of each splat over all pixels, see `nanogs.kernels.backward.pull_tiles`."""
    order, weights, after = pixel_weights(splats, camera, cutoff)
    totals = np.zeros((len(splats), 25))
    image = np.einsum("khw,kc->hwc", weights, features[order])
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    for i, w, t in zip(order, weights, after, strict=True):
        _, (u, v), covariance, _, _ = splat_on_screen(splats, camera, i)
        image -= w[..., None] * features[i]
        behind = image / t[..., None]
        change = features[i] - behind
        q = (rows - v) / math.sqrt(covariance[1, 1])
        slope = covariance[0, 1] / covariance[1, 1]
        given = math.sqrt(covariance[0, 0] - covariance[0, 1] * slope)
        p = (columns - u - slope * (rows - v)) / given
        free = w < 98.9 * t
        pull = free * w * (change * residual).sum(axis=-1)
        bend = free * w * precision * (change**2).sum(axis=-1)
        sums = [(w * residual[..., c]).sum() for c in range(3)] + [(w * precision).sum()]
        sums += [(pull * m).sum() for m in (1, p, q, p * p, p * q, q * q)]
        sums += [(bend * p**a * q**b).sum() for a in range(5) for b in range(5 - a)]
        totals[i] = sums
    return totals


def moved(splats, i, parameter, amount):
    """Splats in float64 with one parameter of shape of splat i changed."""
    columns = {
        name: getattr(splats, name).astype(np.float64)
        for name in ("means", "log_scales", "quats", "opacity_logits", "sh")
    }
    quats = columns["quats"] / np.linalg.norm(columns["quats"], axis=1, keepdims=True)
    columns["quats"] = quats
    kind, k = divmod(parameter, 3)
    if kind == 0:
        axis = turn_matrix(quats[i])[:, k]
        columns["means"][i] += amount * math.exp(columns["log_scales"][i, k]) * axis
    elif kind == 1:
        columns["log_scales"][i, k] += amount
    elif kind == 2:
        half = np.zeros(4)
        half[0], half[1 + k] = math.cos(amount / 2), math.sin(amount / 2)
        columns["quats"][i] = product(quats[i], half)
    else:
        columns["opacity_logits"][i] += amount
    return Wide(**columns, render_mode=splats.render_mode, sh_degree=splats.sh_degree)


@dataclasses.dataclass
class Wide:
    """What the twins read of a model, in float64: differences need the digits."""

    means: np.ndarray
    log_scales: np.ndarray
    quats: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    render_mode: object
    sh_degree: int

    def __len__(self):
        return len(self.means)


def product(a, b):
    """Hamilton's product of two quaternions, wxyz."""
    vector = a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
    return np.array([a[0] * b[0] - a[1:] @ b[1:], *vector])


def turn_matrix(quat):
    """(3, 3) rotation matrix of a unit quaternion, by turning the three axes."""
    conjugate = quat * (1, -1, -1, -1)
    axes = [product(product(quat, np.array([0, *axis])), conjugate)[1:] for axis in np.eye(3)]
    return np.array(axes).T
