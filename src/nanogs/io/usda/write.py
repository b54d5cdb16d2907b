"""Writing OpenUSD text files, `.usda`: one ParticleField3DGaussianSplat, as of OpenUSD 26.03.

Schema: https://openusd.org/release/user_guides/schemas/usdVol/ParticleField.html, and
generatedSchema.usda of usdVol for each attribute. Scales and opacities are linear, quaternions have
their real part first, and the SH coefficients of a splat are contiguous, by band and then by index,
RGB each. The stage has y up; the numbers stay in the frame of the model, and the prim's transform,
half a turn about z, leads to that of the stage. Nine digits reproduce every float32 exactly.
"""

from collections.abc import Callable
from typing import BinaryIO

import numpy as np

from nanogs._types import F32, Array
from nanogs._version import __version__
from nanogs.io import activated, limits
from nanogs.slices import BLOCK_ROWS
from nanogs.source import InMemory
from nanogs.splats import Splats

SUFFIX = ".usda"
_REACH = 3.0  # standard deviations around each centre that the extent includes
# Type and name of each array, and the function that encodes a block of splats as (R, width).
_ATTRIBUTES: dict[str, Callable[[Splats], Array]] = {
    "point3f[] positions": lambda block: block.means,
    "quatf[] orientations": activated.unit_quats,
    "float3[] scales": activated.scales,
    "float[] opacities": lambda block: block.opacities()[:, None],
    "float3[] radiance:sphericalHarmonicsCoefficients": lambda block: block.sh.reshape(-1, 3),
}
_HEADER = """#usda 1.0
(
    customLayerData = {{
        string creator = "nanogs {version}"
    }}
    defaultPrim = "Splats"
    metersPerUnit = 1
    upAxis = "Y"
)

def ParticleField3DGaussianSplat "Splats"
{{
    float3[] extent = [{low}, {high}]
    uniform token projectionModeHint = "perspective"
    uniform token sortingModeHint = "zDepth"
    uniform int radiance:sphericalHarmonicsDegree = {degree}
    double xformOp:rotateZ = 180
    uniform token[] xformOpOrder = ["xformOp:rotateZ"]
"""


def write(splats: Splats, file: BinaryIO) -> None:
    """Write a model; rotations are normalised.

    Raises:
        OutputError: A value is NaN or infinite; nothing has been written then.
        OSError: The system refuses to write.
    """
    limits.refuse_unstorable(splats, SUFFIX)
    low, high = (_rows(corner[None]).rstrip(",") for corner in _extent(splats))
    text = _HEADER.format(version=__version__, low=low, high=high, degree=splats.sh_degree)
    file.write(text.encode())
    for name, encode in _ATTRIBUTES.items():
        file.write(f"    {name} = [".encode())
        lines = (_rows(encode(block)) for block in InMemory(splats).blocks(BLOCK_ROWS))
        last = next(lines)
        for line in lines:
            file.write(f"{last}\n".encode())
            last = line
        file.write(f"{last[:-1]}]\n".encode())
    file.write(b"}\n")


def losses(splats: Splats) -> tuple[str, ...]:
    """Name what the file leaves out, one sentence each."""
    out = limits.left_out(splats, SUFFIX)
    out += limits.rounded(splats, SUFFIX)
    return (*out, *limits.lost_mode(splats, SUFFIX))


def _extent(splats: Splats) -> tuple[F32, F32]:
    """Return the lowest and the highest corner of a box around all splats."""
    with np.errstate(over="ignore", invalid="ignore"):
        reach = _REACH * activated.scales(splats).max(axis=1, keepdims=True)
        means = splats.means.astype(np.float32)  # as written
        low, high = (means - reach).min(axis=0), (means + reach).max(axis=0)
    limit = np.finfo(np.float32).max
    return np.clip(low, -limit, limit), np.clip(high, -limit, limit)


def _rows(values: Array) -> str:
    """Format rows for USD: tuples, or plain numbers for a width of 1; a comma after each."""
    width = values.shape[1]
    numbers = ",".join(["%.9g"] * width)
    row = f"({numbers})," if width > 1 else f"{numbers},"
    return (row * len(values)) % tuple(values.astype(np.float32).ravel().tolist())
