"""Real spherical harmonics, in the order and with the signs that 3DGS files use.

Within a band the order is m = -l .. l; odd m carries the Condon-Shortley phase (-1)^m. Polynomial
forms: Sloan, "Stupid Spherical Harmonics (SH) Tricks", 2008, appendix A2.
"""

from nanogs._types import F
from nanogs.kernels.policy import inline

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)
C4 = (
    2.5033429417967046,
    1.7701307697799304,
    0.9461746957575601,
    0.6690465435572892,
    0.10578554691520431,
    0.47308734787878004,
    0.6258357354491761,
)


@inline
def sh_basis(x: float, y: float, z: float, degree: int, basis: F) -> None:
    """Write Y_lm(x, y, z) for l = 0 .. degree into basis, of at least (degree + 1)² entries.

    (x, y, z) is a unit vector; in 3DGS it points from the camera to the splat.
    """
    basis[0] = C0
    if degree >= 1:
        basis[1] = -C1 * y
        basis[2] = C1 * z
        basis[3] = -C1 * x
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        basis[4] = C2[0] * x * y
        basis[5] = -C2[0] * y * z
        basis[6] = C2[1] * (2.0 * zz - xx - yy)
        basis[7] = -C2[0] * x * z
        basis[8] = C2[2] * (xx - yy)
        if degree >= 3:
            basis[9] = -C3[0] * y * (3.0 * xx - yy)
            basis[10] = C3[1] * x * y * z
            basis[11] = -C3[2] * y * (4.0 * zz - xx - yy)
            basis[12] = C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
            basis[13] = -C3[2] * x * (4.0 * zz - xx - yy)
            basis[14] = C3[4] * z * (xx - yy)
            basis[15] = -C3[0] * x * (xx - 3.0 * yy)
        if degree >= 4:
            basis[16] = C4[0] * x * y * (xx - yy)
            basis[17] = -C4[1] * y * z * (3.0 * xx - yy)
            basis[18] = C4[2] * x * y * (7.0 * zz - 1.0)
            basis[19] = -C4[3] * y * z * (7.0 * zz - 3.0)
            basis[20] = C4[4] * (zz * (35.0 * zz - 30.0) + 3.0)
            basis[21] = -C4[3] * x * z * (7.0 * zz - 3.0)
            basis[22] = C4[5] * (xx - yy) * (7.0 * zz - 1.0)
            basis[23] = -C4[1] * x * z * (xx - 3.0 * yy)
            basis[24] = C4[6] * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy))
