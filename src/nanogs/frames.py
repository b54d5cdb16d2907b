"""Coordinate frames: the half turn between y down, as 3DGS trains, and y up, as glTF wants it.

Both frames are right-handed with x to the right; turning by 180 degrees about x takes one to the
other, and the other back. A real spherical harmonic keeps its value or changes its sign with it:
it is odd where y and z stand in its polynomial an odd number of times together.
"""

from dataclasses import replace

import numpy as np

from nanogs.splats import Splats

# Signs of the basis functions of `kernels.harmonics` under (x, y, z) -> (x, -y, -z), by band.
_SIGNS = (
    (1,),
    (-1, -1, 1),
    (-1, 1, 1, -1, 1),
    (-1, 1, -1, -1, 1, -1, 1),
    (-1, 1, -1, 1, 1, -1, 1, -1, 1),
)


def half_turn(splats: Splats) -> Splats:
    """The model turned by 180 degrees about x; turned twice it is the same, bit for bit.

    Args:
        splats: N splats; extra columns stay as they are.
    """
    means, quats = splats.means.copy(), splats.quats.copy()
    means[:, 1:] *= -1
    quats[:, 2:] *= -1  # i q i⁻¹: the axes of the rotation are turned too
    signs = np.concatenate(_SIGNS[: splats.sh_degree + 1]).astype(np.float32)
    return replace(splats, means=means, quats=quats, sh=splats.sh * signs[:, None])
