"""The objects of the synthetic scene: a still life on tiles, with a garden and a sky around it.

Up is +y here. Each builder, such as `_vase(n, rng)`, returns one object of n splats, lit by one sun
and the sky.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64
from nanogs.datasets import surfaces
from nanogs.datasets.surfaces import Samples

Rng = np.random.Generator

UP = np.array([0.0, 1.0, 0.0])
SUN = np.array([0.48, 0.74, 0.47]) / np.linalg.norm([0.48, 0.74, 0.47])
SUNLIGHT = np.array([1.0, 0.94, 0.82])
SKYLIGHT = np.array([0.34, 0.40, 0.50])
# (x, y, z, radius) of spheres that approximate the objects for their shadows.
OCCLUDERS = np.array(
    [
        [-1.15, 0.75, 0.25, 0.75],
        [0.75, 0.55, -0.65, 0.5],
        [0.75, 1.2, -0.65, 0.3],
        [0.35, 0.33, 1.05, 0.42],
        [1.75, 0.2, 0.65, 0.5],
    ]
)


@dataclass(frozen=True, slots=True)
class Part:
    """Coloured splats of one object.

    Attributes:
        samples: Their centres, axes and scales.
        colours: (n, 3) float64, linear in the model's colour space, mostly in [0, 1].
        alphas: (n,) float64 in (0, 1).
        gloss: Peak of the sun's highlight, 0 for a matt surface.
    """

    samples: Samples
    colours: F64
    alphas: F64
    gloss: float = 0.0


def _sunlit(points: F64) -> F64:
    """Compute the share (n,) of sunlight that reaches the points, with soft shadow edges."""
    share = np.ones(len(points))
    for *centre, radius in OCCLUDERS:
        to_centre = np.array(centre) - points
        along = to_centre @ SUN
        miss = np.sqrt(np.maximum((to_centre**2).sum(axis=1) - along**2, 0)) / radius
        edge = np.clip((miss - 0.8) / (0.25 + 0.15 * np.maximum(along, 0)), 0, 1)
        share *= np.where(along > 0, edge * edge * (3 - 2 * edge), 1)
    return share


def _lit(albedo: F64, samples: Samples, sun: F64 | float = 1.0) -> F64:
    """Compute the diffuse colour under sun and sky."""
    facing = np.maximum(samples.normals @ SUN, 0) * sun
    open_sky = 0.6 + 0.4 * (samples.normals @ UP)
    lit: F64 = albedo * (facing[:, None] * SUNLIGHT + open_sky[:, None] * SKYLIGHT)
    return lit


def _noise(points: F64, frequency: float, seed: int) -> F64:
    """Compute smooth noise (n,) in about [-1, 1]: four octaves of warped sines."""
    rng = np.random.default_rng(seed)
    value, total = np.zeros(len(points)), 0.0
    for octave in range(4):
        waves = rng.normal(0, frequency * 2**octave, (3, 3))
        phases = points @ waves + rng.uniform(0, 2 * np.pi, 3)
        phases[:, 0] += 1.5 * np.sin(phases[:, 1])
        value += np.sin(phases[:, 0]) * np.cos(phases[:, 2]) * 0.5**octave
        total += 0.5**octave
    noise: F64 = value / total * 1.4
    return noise


def _mix(first: tuple[float, ...], second: tuple[float, ...], share: F64) -> F64:
    """Interpolate (n, 3) from the first colour (share 0) to the second (share 1)."""
    share = np.clip(share, 0, 1)[:, None]
    mixed: F64 = np.array(first) * (1 - share) + np.array(second) * share
    return mixed


def _trained_alphas(n: int, rng: Rng) -> F64:
    """Draw opacities (n,) distributed like those of trained models: most splats nearly opaque."""
    solid = rng.beta(9, 0.9, n)
    faint = rng.beta(1.1, 2.5, n)
    alphas: F64 = np.clip(np.where(rng.random(n) < 0.82, solid, faint), 0.005, 0.9995)
    return alphas


# --- the objects ------------------------------------------------------------------------------


def _floor(n: int, rng: Rng) -> Part:
    ground = surfaces.disc(n, rng, radius=18.0, dense=1.7)
    x, z = ground.points[:, 0] / 0.7, ground.points[:, 2] / 0.7
    tile = (np.floor(x) + np.floor(z)) % 2
    joint = np.minimum.reduce([x % 1, 1 - x % 1, z % 1, 1 - z % 1]) < 0.035
    vein = 0.5 + 0.5 * _noise(ground.points, 2.0, 1)
    albedo = _mix((0.62, 0.56, 0.48), (0.33, 0.37, 0.40), tile) * (0.8 + 0.25 * vein)[:, None]
    albedo[joint] *= 0.45
    lawn = np.clip(np.linalg.norm(ground.points, axis=1) - 4.2, 0, 1)
    green = _mix((0.20, 0.33, 0.10), (0.42, 0.48, 0.20), vein)
    albedo = albedo * (1 - lawn[:, None]) + green * lawn[:, None]
    colours = _lit(albedo, ground, _sunlit(ground.points))
    return Part(ground, colours, _trained_alphas(n, rng), gloss=0.08)


def _marble(n: int, rng: Rng) -> Part:
    def profile(s: F64) -> tuple[F64, F64]:
        return 0.75 * np.sin(np.pi * s), -0.75 * np.cos(np.pi * s)

    ball = surfaces.revolve(n, rng, profile, np.array([-1.15, 0.75, 0.25]))
    bands = np.sin(5.0 * ball.points[:, 1] + 5.0 * _noise(ball.points, 1.6, 2))
    albedo = _mix((0.90, 0.88, 0.84), (0.16, 0.25, 0.36), np.abs(bands) ** 3)
    return Part(ball, _lit(albedo, ball), _trained_alphas(n, rng), gloss=0.85)


def _vase(n: int, rng: Rng) -> Part:
    def profile(s: F64) -> tuple[F64, F64]:
        belly = 0.24 + 0.30 * np.sin(np.pi * s**0.8) ** 2 + 0.12 * s**6
        return belly, 1.55 * s

    pot = surfaces.revolve(n, rng, profile, np.array([0.75, 0.0, -0.65]))
    s, turn = pot.where.T
    zigzag = np.abs((turn * 14) % 1 - 0.5) * 0.16
    painted = ((s + zigzag) * 7.0) % 1
    albedo = _mix((0.72, 0.32, 0.18), (0.93, 0.84, 0.66), (painted < 0.3).astype(np.float64))
    albedo[(painted > 0.72) & (s > 0.15)] = (0.10, 0.22, 0.30)
    return Part(pot, _lit(albedo, pot), _trained_alphas(n, rng), gloss=0.45)


def _ring(n: int, rng: Rng) -> Part:
    def profile(s: F64) -> tuple[F64, F64]:
        return 0.42 + 0.17 * np.sin(2 * np.pi * s), 0.17 - 0.17 * np.cos(2 * np.pi * s)

    ring = surfaces.revolve(n, rng, profile, np.array([1.75, 0.0, 0.65]))
    weave = np.sin(2 * np.pi * (24 * ring.where[:, 1] + 3 * ring.where[:, 0]))
    albedo = _mix((0.45, 0.27, 0.05), (0.86, 0.62, 0.18), 0.5 + 0.9 * weave)
    return Part(ring, _lit(albedo, ring), _trained_alphas(n, rng), gloss=0.95)


def _box(n: int, rng: Rng) -> Part:
    side, turn = 0.66, 0.5
    u = np.array([np.cos(turn), 0, np.sin(turn)]) * side
    w = np.array([-np.sin(turn), 0, np.cos(turn)]) * side
    up = UP * side
    corner = np.array([0.35, 0.0, 1.05]) - (u + w) / 2
    # Each face as (origin, edge, edge) whose cross product points outwards.
    faces = [(corner, up, u), (corner + w, u, up), (corner, w, up), (corner + u, up, w)]
    faces.append((corner + up, w, u))
    numbers = np.bincount(np.arange(n) % len(faces), minlength=len(faces))
    sheets = [surfaces.sheet(k, rng, *face) for k, face in zip(numbers, faces, strict=True)]
    box = surfaces.join(sheets)
    stripes = np.sin(2 * np.pi * 7 * (box.where[:, 0] + box.where[:, 1]))
    albedo = _mix((0.93, 0.91, 0.86), (0.75, 0.12, 0.16), 0.5 + 4 * stripes)
    return Part(box, _lit(albedo, box), _trained_alphas(n, rng), gloss=0.15)


def _grass(n: int, rng: Rng) -> Part:
    blades = max(n // 4, 1)
    angle = rng.uniform(0, 2 * np.pi, blades)
    distance = 4.6 + rng.gamma(1.6, 0.9, blades)
    roots = np.stack([distance * np.cos(angle), np.zeros(blades), distance * np.sin(angle)], axis=1)
    height = rng.uniform(0.15, 0.5, blades)
    lean = rng.normal(0, 0.16, (blades, 3)) * np.array([1.0, 0.0, 1.0])

    def curve(number: F64, s: F64) -> F64:
        k = number.astype(np.int64)
        points: F64 = roots[k] + (height[k] * s)[:, None] * UP + lean[k] * (s**2)[:, None]
        return points

    blade = surfaces.strands(n, rng, blades, curve, np.array([0.006, 0.0015]))
    s = blade.where[:, 0]
    hue = rng.uniform(-0.15, 0.15, blades)[np.arange(n) % blades]
    albedo = _mix((0.10, 0.20, 0.05), (0.62, 0.68, 0.26), s + hue)
    colours = albedo * (0.45 + 0.5 * s)[:, None] * (SUNLIGHT + SKYLIGHT)
    return Part(blade, colours, np.clip(_trained_alphas(n, rng), 0.2, 1), gloss=0.1)


def _fence(n: int, rng: Rng) -> Part:
    pickets, wires = 40, 5

    def curve(number: F64, s: F64) -> F64:
        upright = number < pickets
        angle = np.where(upright, number / (pickets - 1), s) * 3.4 + 2.95
        wire = (number - pickets + 1) / (wires + 1)
        level = 0.95 * np.where(upright, s, wire + 0.015 * np.sin(9 * angle))
        return np.stack([3.6 * np.cos(angle), level, 3.6 * np.sin(angle)], axis=1)

    fence = surfaces.strands(n, rng, pickets + wires, curve, np.array([0.008, 0.008]))
    albedo = _mix((0.20, 0.20, 0.22), (0.55, 0.40, 0.28), 0.5 + 0.5 * _noise(fence.points, 3, 4))
    return Part(fence, _lit(albedo, fence), np.clip(_trained_alphas(n, rng), 0.3, 1), gloss=0.3)


def _spring(n: int, rng: Rng) -> Part:
    def curve(number: F64, s: F64) -> F64:  # noqa: ARG001 - there is one curve
        angle, radius = 2 * np.pi * 9 * s, 0.26 - 0.1 * s
        return np.stack(
            [1.75 + radius * np.cos(angle), 0.36 + 0.9 * s, 0.65 + radius * np.sin(angle)], axis=1
        )

    wire = surfaces.strands(n, rng, 1, curve, np.array([0.008, 0.008]))
    albedo = np.tile([0.42, 0.45, 0.50], (n, 1))
    return Part(wire, _lit(albedo, wire), np.clip(_trained_alphas(n, rng), 0.4, 1), gloss=0.7)


def _pane(n: int, rng: Rng) -> Part:
    corner = np.array([-1.0, 0.05, 1.55])
    pane = surfaces.sheet(n, rng, corner, np.array([0.95, 0.0, 0.35]), 1.15 * UP)
    albedo = np.tile([0.45, 0.72, 0.70], (n, 1)) + rng.normal(0, 0.02, (n, 3))
    rim = np.minimum(pane.where, 1 - pane.where).min(axis=1) < 0.02
    alphas = np.where(rim, 0.3, 0.02 + 0.08 * rng.beta(2, 2, n))
    return Part(pane, albedo * 0.8, alphas, gloss=0.6)


def _smoke(n: int, rng: Rng) -> Part:
    rise = rng.beta(1.2, 1.6, n)
    swirl = 5 * rise + rng.uniform(0, 2 * np.pi)
    axis = np.stack([0.25 * rise * np.cos(swirl), 1.6 * rise, 0.25 * rise * np.sin(swirl)], axis=1)
    puff = rng.normal(0, 1, (n, 3)) * (0.04 + 0.16 * rise)[:, None]
    points = np.array([0.75, 1.5, -0.65]) + axis + puff
    smoke = surfaces.cloud(n, rng, points, 0.06)
    grey = (0.78 - 0.25 * rise + rng.normal(0, 0.02, n))[:, None] * np.array([1.0, 0.99, 0.97])
    return Part(smoke, grey, 0.01 + 0.05 * (1 - rise) * rng.random(n))


def _sky(n: int, rng: Rng) -> Part:
    radius = 30.0

    def profile(s: F64) -> tuple[F64, F64]:
        level = np.clip(-0.16 + 1.16 * s, -1, 1)  # uniform in height is uniform in area
        return radius * np.sqrt(1 - level**2), radius * level

    dome = surfaces.revolve(n, rng, profile, np.zeros(3))
    level = dome.points[:, 1] / radius
    colours = _mix((0.80, 0.86, 0.92), (0.22, 0.42, 0.74), np.maximum(level, 0) ** 0.6)
    clouds = _noise(dome.points / radius * np.array([1.0, 2.5, 1.0]), 2.2, 5) - 0.15
    colours = colours + np.clip(clouds * 1.6, 0, 1)[:, None] * (np.array([0.97] * 3) - colours)
    hills = 0.035 + 0.03 * np.sin(7 * 2 * np.pi * dome.where[:, 1]) > level
    colours[hills] = (0.30, 0.38, 0.33)
    glare = np.maximum(dome.points @ SUN / radius, 0)[:, None] ** 150
    return Part(dome, colours + glare * SUNLIGHT, np.clip(_trained_alphas(n, rng), 0.3, 1))


def _floaters(n: int, rng: Rng) -> Part:
    points = rng.normal(0, 1, (n, 3)) * np.array([3.0, 1.2, 3.0])
    points[:, 1] = np.abs(points[:, 1])
    blobs = surfaces.cloud(n, rng, points, 0.05)
    return Part(blobs, rng.uniform(0.2, 0.7, (n, 3)), rng.beta(1, 12, n) * 0.3 + 0.004)


Builder = Callable[[int, Rng], Part]
PARTS: dict[Builder, float] = {
    _floor: 0.27,
    _marble: 0.13,
    _vase: 0.13,
    _box: 0.11,
    _grass: 0.11,
    _ring: 0.09,
    _sky: 0.05,
    _fence: 0.04,
    _pane: 0.03,
    _smoke: 0.02,
    _spring: 0.01,
    _floaters: 0.01,
}
