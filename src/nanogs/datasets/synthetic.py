"""A generated scene with the look and the statistics of a trained 3DGS model.

It has the features that are hard to simplify: fine texture, view-dependent colour, thin and
semi-transparent parts, floaters, a sky shell, and scales over three orders of magnitude. It is
built with +y up; the last step rotates it to the y-down convention of trained models.
"""

import numpy as np

from nanogs._types import F32, F64
from nanogs.activations import base_colour, quaternions
from nanogs.datasets.still_life import PARTS, SKYLIGHT, SUN, SUNLIGHT, UP, Builder, Part, Rng
from nanogs.errors import OptionError
from nanogs.ranges import is_number
from nanogs.sh import lobe
from nanogs.splats import MAX_SH_DEGREE, Splats, concatenate

MOST = 2**31 - 1  # splats of a scene
TO_Y_DOWN = np.array([1.0, -1.0, -1.0])


def make_scene(count: int = 200_000, *, sh_degree: int = 3, seed: int = 0) -> Splats:
    """Generate a scene: a still life on tiles under a sky, y-down (up is 0, -1, 0).

    The same arguments give the same splats, byte for byte, on one machine.

    Args:
        count: Number of splats, 1 or more.
        sh_degree: Spherical-harmonic degree of the colours, 0 to 4.
        seed: Seed of the random numbers; any non-negative integer.

    Returns:
        A model of exactly `count` splats, in random order, about 30 scene units in radius.

    Raises:
        OptionError: `count`, `sh_degree` or `seed` is no whole number, or out of range.
    """
    if not (is_number(count, whole=True) and 1 <= count <= MOST):
        raise OptionError(f"A made-up scene has 1 to {MOST:,} splats, not {count!r}.")
    if not (is_number(sh_degree, whole=True) and 0 <= sh_degree <= MAX_SH_DEGREE):
        raise OptionError(f"The SH degree must be 0 to {MAX_SH_DEGREE}, not {sh_degree!r}.")
    if not (is_number(seed, whole=True) and seed >= 0):
        raise OptionError(f"The seed must be a whole number, 0 or more, not {seed!r}.")
    rng = np.random.default_rng(seed)
    shares = _allot(count)
    parts = [build(n, rng) for build, n in shares.items() if n]
    models = [_splats(part, sh_degree, rng) for part in parts]
    return concatenate(models).take(rng.permutation(count))


def _allot(count: int) -> dict[Builder, int]:
    """Split `count` by the shares of `PARTS`, rounded by largest remainders, ties to the first."""
    weights = np.array(list(PARTS.values()))
    exact = count * weights / weights.sum()
    whole = np.floor(exact).astype(np.int64)
    order = np.argsort(-(exact - whole), kind="stable")
    whole[order[: count - whole.sum()]] += 1
    return dict(zip(PARTS, whole.tolist(), strict=True))


def _splats(part: Part, sh_degree: int, rng: Rng) -> Splats:
    """Return a part as stored values, rotated to y-down."""
    samples = part.samples
    normals, tangents = samples.normals * TO_Y_DOWN, samples.tangents * TO_Y_DOWN
    axes = np.stack([tangents, np.cross(normals, tangents), normals], axis=2)
    alphas = part.alphas.clip(1e-4, 1 - 1e-4)
    return Splats(
        means=(samples.points * TO_Y_DOWN).astype(np.float32),
        log_scales=np.log(samples.sizes).astype(np.float32),
        quats=quaternions(axes).astype(np.float32),
        opacity_logits=np.log(alphas / (1 - alphas)).astype(np.float32),
        sh=_harmonics(part, normals, sh_degree, rng),
    )


def _harmonics(part: Part, normals: F64, degree: int, rng: Rng) -> F32:
    """Compute SH (n, (degree + 1)², 3) of diffuse colour, highlight, sky reflection and noise."""
    n = len(normals)
    sh = rng.normal(0, 0.012, (n, (degree + 1) ** 2, 3))
    sh[:, 0] = base_colour(part.colours)
    if part.gloss:
        for source, colour, width in (
            (SUN * TO_Y_DOWN, SUNLIGHT * part.gloss, 0.16),
            (UP * TO_Y_DOWN, SKYLIGHT * part.gloss * 0.45, 0.7),
        ):
            facing = normals @ source
            mirrored = 2 * facing[:, None] * normals - source
            highlight = lobe(mirrored, degree, width) * np.clip(facing * 3, 0, 1)[:, None]
            sh += highlight[:, :, None] * colour
    return sh.astype(np.float32)
