"""Samplers that cover surfaces, strands and volumes with splats like a trained model does.

Scales are log-normal around the local spacing of the samples; splats are flat along their surface.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64

OVERLAP = 0.72  # ratio of scale to sample spacing: closes a surface, and keeps its texture
FLATNESS = 0.07  # ratio of thickness to extent
PROFILE_STEPS = 512  # samples of the numerical integration along a profile


@dataclass(frozen=True, slots=True)
class Samples:
    """The geometry of n splats: centres, axes and scales.

    Attributes:
        points: (n, 3) float64, scene units.
        normals: (n, 3) float64, unit.
        tangents: (n, 3) float64, unit, orthogonal to the normals.
        sizes: (n, 3) float64, standard deviations along tangent, bitangent and normal.
        where: (n, 2) float64, parameters of the surface in [0, 1], for textures.
    """

    points: F64
    normals: F64
    tangents: F64
    sizes: F64
    where: F64

    def __len__(self) -> int:
        return len(self.points)


def unit(vectors: F64) -> F64:
    """Normalise vectors (n, 3) to length 1; zeros stay zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    scaled: F64 = vectors / np.where(length == 0, 1, length)
    return scaled


def r2_points(n: int, rng: np.random.Generator) -> F64:
    """Return points (n, 2) in [0, 1)² of the R2 low-discrepancy sequence, slightly jittered."""
    steps = 0.7548776662466927 ** np.array([1, 2])  # powers of 1 / plastic number
    points = rng.random(2) + np.arange(n)[:, None] * steps
    points += rng.normal(0, 0.2 / np.sqrt(max(n, 1)), (n, 2))
    wrapped: F64 = points % 1.0
    return wrapped


def _flat(
    points: F64, normals: F64, tangents: F64, spacing: F64, where: F64, rng: np.random.Generator
) -> Samples:
    """Return flat splats of log-normal size and elongation, rotated at random in their plane."""
    n = len(points)
    extent = OVERLAP * spacing * rng.lognormal(0, 0.3, n)
    stretch = rng.lognormal(0, 0.3, n)
    thin = extent * FLATNESS * rng.lognormal(0, 0.5, n)
    angle = rng.uniform(0, np.pi, (n, 1))
    turned = np.cos(angle) * tangents + np.sin(angle) * np.cross(normals, tangents)
    lifted = points + normals * rng.normal(0, 0.03, (n, 1)) * spacing[:, None]
    sizes = np.stack([extent * stretch, extent / stretch, thin], axis=1)
    return Samples(lifted, normals, turned, sizes, where)


def sheet(n: int, rng: np.random.Generator, origin: F64, edge_u: F64, edge_v: F64) -> Samples:
    """Sample a rectangle from `origin` along two orthogonal edges; its normal is u x v."""
    where = r2_points(n, rng)
    points = origin + where[:, :1] * edge_u + where[:, 1:] * edge_v
    across = np.cross(edge_u, edge_v)
    spacing = np.full(n, np.sqrt(np.linalg.norm(across) / max(n, 1)))
    normals = np.tile(unit(across), (n, 1))
    return _flat(points, normals, np.tile(unit(edge_u), (n, 1)), spacing, where, rng)


def disc(n: int, rng: np.random.Generator, radius: float, dense: float) -> Samples:
    """Sample a horizontal disc around the origin, most densely within a radius of `dense`."""
    where = r2_points(n, rng)
    span = np.log1p((radius / dense) ** 2)
    squared = dense**2 * np.expm1(where[:, 0] * span)
    angle = 2 * np.pi * where[:, 1]
    ring = np.stack([np.cos(angle), np.zeros(n), np.sin(angle)], axis=1)
    spacing = np.sqrt(np.pi * span * (squared + dense**2) / max(n, 1))
    normals = np.tile(np.array([0.0, 1.0, 0.0]), (n, 1))
    points = ring * np.sqrt(squared)[:, None]
    return _flat(points, normals, np.cross(normals, ring), spacing, where, rng)


def revolve(
    n: int, rng: np.random.Generator, profile: Callable[[F64], tuple[F64, F64]], centre: F64
) -> Samples:
    """Sample a surface of revolution about the vertical through `centre`, uniformly by area.

    Args:
        n: Number of samples.
        rng: Source of the jitter.
        profile: Maps s in [0, 1] to (radius, height); the outside is on the right of its direction.
        centre: (3,) float64.
    """
    grid = np.linspace(0, 1, PROFILE_STEPS)
    radius, height = profile(grid)
    slope_r, slope_h = np.gradient(radius, grid), np.gradient(height, grid)
    area = np.concatenate([[0], np.cumsum((radius * np.hypot(slope_r, slope_h))[:-1])])
    uv = r2_points(n, rng)
    s = np.interp(uv[:, 0] * area[-1], area, grid)
    angle = 2 * np.pi * uv[:, 1]
    rho, level = profile(s)
    d_rho, d_level = np.interp(s, grid, slope_r), np.interp(s, grid, slope_h)
    cosine, sine = np.cos(angle), np.sin(angle)
    points = centre + np.stack([rho * cosine, level, rho * sine], axis=1)
    normals = unit(np.stack([d_level * cosine, -d_rho, d_level * sine], axis=1))
    around = np.stack([-sine, np.zeros(n), cosine], axis=1)
    total = 2 * np.pi * area[-1] / (PROFILE_STEPS - 1)
    where = np.stack([s, uv[:, 1]], axis=1)
    return _flat(points, normals, around, np.full(n, np.sqrt(total / max(n, 1))), where, rng)


def strands(
    n: int, rng: np.random.Generator, count: int, curve: Callable[[F64, F64], F64], thickness: F64
) -> Samples:
    """Sample long thin splats along `count` curves.

    Args:
        n: Number of samples.
        rng: Source of the jitter.
        count: Number of curves, 1 or more.
        curve: Maps curve indices (n,) and curve parameters s in [0, 1] (n,) to points (n, 3).
        thickness: (2,) float64, standard deviations across the curve: width, depth.
    """
    which = np.arange(n) % count
    share = np.maximum((n - which + count - 1) // count, 1)
    s = (np.arange(n) // count + 0.5) / share
    number, step = which.astype(np.float64), 0.5 / share
    ahead, behind = curve(number, s + step), curve(number, s - step)
    along = ahead - behind
    tangents = unit(along)
    side = np.where(np.abs(tangents[:, 1:2]) > 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    normals = unit(np.cross(tangents, np.cross(side, tangents)))
    length = np.linalg.norm(along, axis=1) * 0.55
    across = thickness * rng.lognormal(0, 0.1, (n, 2))
    sizes = np.column_stack([length, across])
    return Samples(
        curve(number, s), normals, tangents, sizes, np.stack([s, number / count], axis=1)
    )


def cloud(n: int, rng: np.random.Generator, points: F64, extent: float) -> Samples:
    """Return round blobs at the given points (n, 3), of log-normal size around `extent`."""
    frame = np.tile(np.eye(3)[[1, 0]], (n, 1, 1))
    sizes = extent * rng.lognormal(0, 0.4, (n, 1)) * rng.lognormal(0, 0.25, (n, 3))
    return Samples(points, frame[:, 0], frame[:, 1], sizes, np.zeros((n, 2)))


def join(pieces: list[Samples]) -> Samples:
    """Concatenate the pieces in order."""
    names = ("points", "normals", "tangents", "sizes", "where")
    return Samples(*(np.concatenate([getattr(piece, name) for piece in pieces]) for name in names))
