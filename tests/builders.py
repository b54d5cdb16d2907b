"""Small scenes for tests."""

import dataclasses

import numpy as np

from nanogs.method.paper.gaussians import Gaussians
from nanogs.method.viewers import Dilation
from nanogs.splats import Splats


def random_splats(count, *, degree=1, seed=0, spread=1.0, extras=None):
    """Make random splats of mixed sizes, shapes and opacities in a cube."""
    rng = np.random.default_rng(seed)
    return Splats(
        means=(rng.uniform(-1, 1, (count, 3)) * spread).astype(np.float32),
        log_scales=rng.normal(np.log(0.1 * spread), 0.7, (count, 3)).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        opacity_logits=rng.normal(0.5, 2, count).astype(np.float32),
        sh=(rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.5).astype(np.float32),
        extras=extras or {},
    )


def linear_scales(splats):
    """Return the standard deviations, computed in double precision and rounded once."""
    return np.exp(splats.log_scales.astype(np.float64)).astype(np.float32)


def solid(color, *, count=300):
    """Make an ellipsoid of one colour with three different axes, so that rotations are visible."""
    splats = random_splats(count, degree=0)
    ball = splats.means / np.maximum(1, np.linalg.norm(splats.means, axis=1, keepdims=True))
    sh = np.tile(((np.array(color) - 0.5) / 0.2820948).astype(np.float32), (count, 1, 1))
    return dataclasses.replace(
        splats,
        means=(ball * (1, 0.6, 0.4)).astype(np.float32),
        log_scales=np.full((count, 3), np.log(0.08), np.float32),
        sh=sh,
        opacity_logits=np.full(count, 6, np.float32),
    )


def gaussians_of(splats):
    """Make the working set of all rows, in their order and with unchanged centres."""
    count = len(splats)
    return Gaussians(
        means=splats.means.astype(np.float64),
        scales=splats.scales(),
        quats=splats.unit_quats(),
        opacities=splats.opacities(),
        features=splats.sh.reshape(count, -1),
        rows=np.arange(count, dtype=np.int32),
        sources=np.arange(count, dtype=np.int32),
        merged=np.zeros(count, dtype=bool),
    )


def same_pixel(deviation):
    """Make a dilation that is the same everywhere within 1e9 units of the origin."""
    far = 1e9
    return Dilation(np.zeros((1, 3)), np.array([far]), deviation / far)


def row(gaussians, index):
    """Return one splat in the form that `reference_kernels` takes."""
    return {
        "mean": gaussians.means[index],
        "scales": gaussians.scales[index],
        "quat": gaussians.quats[index],
        "opacity": gaussians.opacities[index],
        "features": gaussians.colours()[index],
    }


def model_bytes(splats):
    """Return the bytes of all columns, for comparing results bit by bit."""
    columns = (splats.means, splats.log_scales, splats.quats, splats.opacity_logits, splats.sh)
    return b"".join(column.tobytes() for column in (*columns, *splats.extras.values()))


def cloud_pair(n=400, seed=1, scale=1.0, degree=1):
    """Make a cloud of coloured splats, and a small model: every fourth of these, enlarged."""
    rng = np.random.default_rng(seed)
    means = rng.normal(0, 0.4, (n, 3))
    sh = np.zeros((n, (degree + 1) ** 2, 3))
    sh[:, 0] = 1.2 * np.sin(3 * means)
    arrays = {
        "means": scale * means,
        "log_scales": np.log(scale) + rng.normal(-2, 0.2, (n, 3)),
        "quats": rng.normal(size=(n, 4)),
        "opacity_logits": rng.normal(2, 0.5, n),
        "sh": sh,
    }
    arrays = {name: array.astype(np.float32) for name, array in arrays.items()}
    original = Splats(**arrays, extras={"label": np.arange(n, dtype=np.int32)})
    small = original.take(np.arange(0, n, 4))
    small = dataclasses.replace(small, log_scales=small.log_scales + np.float32(0.3))
    return original, small
