"""Reference versions of a refit's kernels: float64, pixel by pixel, with `reference_raster`."""

import dataclasses
import math

import numpy as np
from scipy.spatial.transform import Rotation

from nanogs.activations import rotations
from nanogs.fit.descent import LIMITS
from nanogs.kernels import chain
from nanogs.kernels.project import guard_bounds
from nanogs.splats import RenderMode
from reference_raster import sh_basis, splat_on_screen


def pixel_weights(splats, camera, cutoff=1 / 255):
    """Compute the blending weights of each visible splat at each pixel.

    Returns:
        (M,) rows, nearest first; (M, H, W) weights, transmittance times alpha; and (M, H, W)
        transmittance behind each splat.
    """
    shape = (camera.height, camera.width)
    columns, rows = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    projected = {i: splat_on_screen(splats, camera, i) for i in range(len(splats))}
    order = sorted(
        (i for i in projected if projected[i] is not None), key=lambda i: (projected[i][0], i)
    )
    transmittance, saturated = np.ones(shape), np.zeros(shape, bool)
    weights, after = [], []
    for i in order:
        _, centre, covariance, opacity, _ = projected[i]
        offsets = np.stack([columns - centre[0], rows - centre[1]], axis=-1)
        power = -0.5 * np.einsum("...i,ij,...j", offsets, np.linalg.inv(covariance), offsets)
        alpha = np.minimum(0.99, opacity * np.exp(power))
        alpha[alpha < cutoff] = 0
        saturated |= transmittance * (1 - alpha) < 1e-4
        weights.append(np.where(saturated, 0, transmittance * alpha))
        transmittance = np.where(saturated, transmittance, transmittance * (1 - alpha))
        after.append(transmittance)
    return np.array(order), np.array(weights), np.array(after)


def blend_reference(splats, camera, features, cutoff=1 / 255):
    """Blend features (N, C) to an image (H, W, C)."""
    order, weights, _ = pixel_weights(splats, camera, cutoff)
    return np.einsum("khw,kc->hwc", weights, features[order])


def gradient_reference(splats, camera, features, residual, precision, cutoff=1 / 255):
    """Sum 25 terms of each splat over all pixels; see `nanogs.kernels.backward.gradient_tiles`."""
    order, weights, after = pixel_weights(splats, camera, cutoff)
    totals = np.zeros((len(splats), 25))
    image = np.einsum("khw,kc->hwc", weights, features[order])
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    for i, weight, after_splat in zip(order, weights, after, strict=True):
        _, (u, v), covariance, _, _ = splat_on_screen(splats, camera, i)
        image -= weight[..., None] * features[i]
        behind = image / after_splat[..., None]
        change = features[i] - behind
        q = (rows - v) / math.sqrt(covariance[1, 1])
        slope = covariance[0, 1] / covariance[1, 1]
        deviation_of_x = math.sqrt(covariance[0, 0] - covariance[0, 1] * slope)
        p = (columns - u - slope * (rows - v)) / deviation_of_x
        unclipped = weight < 98.9 * after_splat
        gradient = unclipped * weight * (change * residual).sum(axis=-1)
        curvature = unclipped * weight * precision * (change**2).sum(axis=-1)
        sums = [(weight * residual[..., c]).sum() for c in range(3)] + [(weight * precision).sum()]
        sums += [(gradient * m).sum() for m in (1, p, q, p * p, p * q, q * q)]
        sums += [(curvature * p**a * q**b).sum() for a in range(5) for b in range(5 - a)]
        totals[i] = sums
    return totals


def perturbed(splats, i, parameter, amount):
    """Return the splats in float64 with one of the 10 parameters of shape of splat i changed."""
    columns = {
        name: getattr(splats, name).astype(np.float64)
        for name in ("means", "log_scales", "quats", "opacity_logits", "sh")
    }
    quats = columns["quats"] / np.linalg.norm(columns["quats"], axis=1, keepdims=True)
    columns["quats"] = quats
    kind, k = divmod(parameter, 3)
    if kind == 0:
        axis = rotation_matrix(quats[i])[:, k]
        columns["means"][i] += amount * math.exp(columns["log_scales"][i, k]) * axis
    elif kind == 1:
        columns["log_scales"][i, k] += amount
    elif kind == 2:
        half = np.zeros(4)
        half[0], half[1 + k] = math.cos(amount / 2), math.sin(amount / 2)
        columns["quats"][i] = product(quats[i], half)
    else:
        columns["opacity_logits"][i] += amount
    return DoubleSplats(**columns, render_mode=splats.render_mode, sh_degree=splats.sh_degree)


@dataclasses.dataclass
class DoubleSplats:
    """A model in float64, for the reference versions: finite differences need the precision."""

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
    """Compute the Hamilton product of two quaternions, wxyz."""
    vector = a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
    return np.array([a[0] * b[0] - a[1:] @ b[1:], *vector])


def rotation_matrix(quat):
    """Compute the rotation matrix (3, 3) of a unit quaternion by rotating the three axes."""
    conjugate = quat * (1, -1, -1, -1)
    axes = [product(product(quat, np.array([0, *axis])), conjugate)[1:] for axis in np.eye(3)]
    return np.array(axes).T


def shape_terms(row, sums, point, axes, scales, opacity, camera, mode):
    """Compute gradient (10,) and Hessian (55,) by a splat's parameters of shape, for one view."""
    jacobians, lanes, products = chain.new_chains(chain.SHAPE, chain.SCREEN, 1)
    rotation = np.ascontiguousarray(camera.world_to_camera[:3, :3], np.float64)
    lens = camera.intrinsics
    chain.screen_jacobian(
        row, point, axes, scales, opacity, rotation, lens, guard_bounds(lens),
        mode is RenderMode.MIP, jacobians[:, :, 0],
    )  # fmt: skip
    lanes[:, 0] = sums
    gradients, blocks = np.empty((10, 1)), np.empty((55, 1))
    chain.gradients_and_hessians(jacobians, lanes, products, gradients, blocks)
    return gradients[:, 0], blocks[:, 0]


def resolved_share(row, dilation):
    """Compute how much of a splat's size on screen is its own rather than dilation, 0 to 1.

    This is the mean square of the eigenvalues of its own covariance relative to the dilated one.
    """
    width, slope, height = 1 / row[2], row[3], 1 / np.sqrt(row[4])
    frame = np.array(
        [[width, slope * height], [0, height]]
    )  # its columns are axes in (x, y) on screen
    dilated = frame @ frame.T
    eigenvalues = np.linalg.eigvals(np.linalg.solve(dilated, dilated - dilation * np.eye(2)))
    return (eigenvalues.real**2).mean()


def unoccluded_share(row, weight):
    """Compute the share of a step of a splat of which other splats hide a part, 0 to 1.

    `weight` is compared with the integral of alpha² over half of the plane.
    """
    area = (
        2 * np.pi / (row[2] * np.sqrt(row[4]))
    )  # of exp(-(p² + q²) / 2); that of its square is half
    shown = min(1.0, weight / (0.5 * row[6] ** 2 * area / 2))
    return 1.2 * shown / (shown + 0.2)


class ReferenceFit:
    """A state of a fit that takes steps as `nanogs.kernels.advance` does, in float64."""

    def __init__(self, splats, parameters, views):
        self.parameters, self.views, self.mode = parameters, views, splats.render_mode
        self.means, self.log_scales, self.logits, self.sh, self.original_sh = (
            column.astype(np.float64)
            for column in (
                splats.means, splats.log_scales, splats.opacity_logits, splats.sh, splats.sh,
            )
        )  # fmt: skip
        self.quats = splats.unit_quats().astype(np.float64)
        self.initial = [each.copy() for each in self._state()]
        self.seen, self.most_determined = np.zeros(len(splats), int), np.zeros(len(splats))
        self.blocks, self.weights = np.zeros((len(splats), 55)), np.zeros(len(splats))

    def step(self, view, camera, rate):
        for i in view.view.order:
            sums = view.totals[i]
            if sums[3] <= 1e-6:
                continue
            step, block = self._terms(view.view.geometry[i], sums, camera, i)
            self.seen[i] += 1
            share = 1 / min(self.seen[i], self.views)
            self.blocks[i] += share * (block - self.blocks[i])
            self.weights[i] += share * (sums[3] - self.weights[i])
            excess = max(1.0, sums[3] / self.weights[i])
            row = view.view.geometry[i]
            share = resolved_share(row, camera.dilation) * unoccluded_share(row, sums[3])
            self.most_determined[i] = max(self.most_determined[i], share)
            step_rate, return_rate = rate * share, rate * 0.2 * (1 - self.most_determined[i]) ** 2
            old = self.sh[i].copy()
            self._recolour(
                i, sums, view.view.features[i], camera, excess * self.weights[i], step_rate
            )
            self.sh[i] -= return_rate * (old - self.original_sh[i])
            if self._reshape(i, step, excess * self.blocks[i], step_rate):
                for now, initial in zip(self._state(), self.initial, strict=True):
                    now[i] += return_rate * (initial[i] - now[i])
                self.quats[i] /= np.linalg.norm(self.quats[i])

    def _state(self):
        return self.means, self.log_scales, self.quats, self.logits

    def _terms(self, row, sums, camera, i):
        return shape_terms(
            row, sums, self.means[i] - camera.position, rotations(self.quats)[i].astype(np.float32),
            np.exp(self.log_scales[i]).astype(np.float32), 1 / (1 + np.exp(-self.logits[i])),
            camera, self.mode,
        )  # fmt: skip

    def _recolour(self, i, sums, shown, camera, curvature_scale, rate):
        degree = round(math.sqrt(len(self.sh[i]))) - 1
        direction = self.means[i] - camera.position
        basis = sh_basis(direction / np.linalg.norm(direction), degree)
        k = 0
        for band in range(degree + 1):
            share = 0.5 if band == 0 and degree else 1.0 if degree == 0 else 0.5 / degree
            ridge = (self.parameters.band_ridge if band else self.parameters.ridge) / (4 * math.pi)
            curvature = (2 * band + 1) / share / (4 * math.pi)
            for _ in range(2 * band + 1):
                gradient = basis[k] * sums[:3] * ((shown[:3] > 0) | (sums[:3] > 0))
                gradient = gradient - ridge * curvature_scale * (
                    self.sh[i, k] - self.original_sh[i, k]
                )
                self.sh[i, k] += rate * gradient / ((curvature + ridge) * curvature_scale)
                k += 1

    def _reshape(self, i, gradient, block, rate):
        matrix = np.zeros((10, 10))
        matrix[np.tril_indices(10)] = block
        matrix = np.tril(matrix) + np.tril(matrix, -1).T
        diagonal = np.diag(matrix)
        if not diagonal.max() > 0:
            return False
        lift = self.parameters.damping * diagonal + self.parameters.floor * diagonal.max()
        step = np.linalg.solve(matrix + np.diag(lift), gradient)
        step = rate * step / max(1.0, (np.abs(step) / LIMITS).max())
        rotation = rotations(self.quats)[i]
        self.means[i] += rotation @ (np.exp(self.log_scales[i]) * step[:3])
        self.log_scales[i] += step[3:6]
        self.quats[i] = quat_of(
            rotation @ Rotation.from_rotvec(step[6:9]).as_matrix(), self.quats[i]
        )
        self.logits[i] = np.clip(self.logits[i] + step[9], min(-5.0, self.logits[i]), 7.0)
        return True


def quat_of(matrix, like):
    """Return the quaternion (4,), wxyz, of a rotation matrix, with the sign nearest to `like`."""
    quat = np.roll(Rotation.from_matrix(matrix).as_quat(), 1)
    return quat if quat @ like >= 0 else -quat
