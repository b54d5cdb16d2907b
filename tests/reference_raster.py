"""A plain reimplementation of the rasteriser: float64, pixel by pixel, without tiles or tricks."""

import math

import numpy as np
from scipy.special import lpmv

from nanogs.splats import RenderMode

ROUNDING_MARGIN = 1e-4  # relative distance to a threshold at which float32 may decide otherwise


def sh_basis(direction, degree):
    """Compute real harmonics from Legendre functions, whose Condon-Shortley phase is 3DGS's."""
    x, y, z = direction
    phi, values = math.atan2(y, x), []
    for band in range(degree + 1):
        for m in range(-band, band + 1):
            k = abs(m)
            norm = (2 * band + 1) / (4 * math.pi) * math.factorial(band - k)
            norm = math.sqrt(norm / math.factorial(band + k)) * lpmv(k, band, z)
            angle = math.cos(k * phi) if m >= 0 else math.sin(k * phi)
            values.append(norm * (angle * math.sqrt(2) if m else 1))
    return np.array(values)


def splat_on_screen(splats, camera, i):
    """Compute (depth, centre, covariance, opacity, colour) of a splat; None if it is culled."""
    rotation = camera.world_to_camera[:3, :3]
    offset = splats.means[i].astype(np.float64) - np.linalg.inv(camera.world_to_camera)[:3, 3]
    x, y, z = rotation @ offset
    if not z > camera.near:
        return None
    qw, qx, qy, qz = splats.quats[i].astype(np.float64) / np.linalg.norm(splats.quats[i])
    cross = np.array([[0, -qz, qy], [qz, 0, -qx], [-qy, qx, 0]])
    rotation_of_splat = np.eye(3) + 2 * qw * cross + 2 * cross @ cross
    sigma = (
        rotation_of_splat
        @ np.diag(np.exp(2 * splats.log_scales[i].astype(np.float64)))
        @ rotation_of_splat.T
    )
    guard_x, guard_y = 0.15 * camera.width / camera.fx, 0.15 * camera.height / camera.fy
    tx = np.clip(
        x / z, -camera.cx / camera.fx - guard_x, (camera.width - camera.cx) / camera.fx + guard_x
    )
    ty = np.clip(
        y / z, -camera.cy / camera.fy - guard_y, (camera.height - camera.cy) / camera.fy + guard_y
    )
    jacobian = [[camera.fx / z, 0, -camera.fx * tx / z], [0, camera.fy / z, -camera.fy * ty / z]]
    to_screen = np.array(jacobian) @ rotation
    before = to_screen @ sigma @ to_screen.T
    after = before + camera.dilation * np.eye(2)
    with np.errstate(over="ignore"):
        opacity = 1 / (1 + np.exp(-np.float64(splats.opacity_logits[i])))
    if splats.render_mode is RenderMode.MIP:
        opacity *= math.sqrt(max(0.0, np.linalg.det(before) / np.linalg.det(after)))
    basis = sh_basis(offset / np.linalg.norm(offset), splats.sh_degree)
    colour = np.maximum(basis @ splats.sh[i].astype(np.float64) + 0.5, 0)
    centre = np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
    return np.float32(z), centre, after, opacity, colour


def render_reference(splats, camera, background=(0.0, 0.0, 0.0), probes=None):
    """Render; return color, alpha, depth, contributions, and the mask of pixels near no threshold.

    With probes (P, H, W) the contributions are (N, P): sums over pixels of weight times probe.

    Near a threshold (alpha 1/255, transmittance 1e-4) rounding decides whether a splat is blended.
    No tolerance is right there, so the mask `sure` is false for such a pixel.
    """
    shape = (camera.height, camera.width)
    columns, rows = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    transmittance, saturated, sure = np.ones(shape), np.zeros(shape, bool), np.ones(shape, bool)
    color, depth = np.zeros((*shape, 3)), np.zeros(shape)
    probes = np.ones((1, *shape)) if probes is None else probes
    contributions = np.zeros((len(splats), len(probes)))
    projected = {i: splat_on_screen(splats, camera, i) for i in np.flatnonzero(splats.finite())}
    for i in sorted(
        (i for i in projected if projected[i] is not None), key=lambda i: (projected[i][0], i)
    ):
        z, centre, covariance, opacity, colour = projected[i]
        offsets = np.stack([columns - centre[0], rows - centre[1]], axis=-1)
        power = -0.5 * np.einsum("...i,ij,...j", offsets, np.linalg.inv(covariance), offsets)
        alpha = np.minimum(0.99, opacity * np.exp(np.minimum(power, 0)))
        sure &= saturated | (np.abs(alpha * 255 - 1) > ROUNDING_MARGIN)
        alpha[alpha < 1 / 255] = 0
        after = transmittance * (1 - alpha)
        sure &= saturated | (np.abs(after / 1e-4 - 1) > ROUNDING_MARGIN) | (alpha == 0)
        saturated |= after < 1e-4
        weights = np.where(saturated, 0, transmittance * alpha)
        color += weights[..., None] * colour
        depth += weights * z
        contributions[i] = np.einsum("hw,phw->p", weights, probes)
        transmittance = np.where(saturated, transmittance, after)
    color += transmittance[..., None] * np.array(background)
    return color, 1 - transmittance, depth, contributions, sure
