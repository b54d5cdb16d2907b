"""Bjontegaard deltas: the mean difference of two rate-distortion curves, as one number.

G. Bjontegaard, "Calculation of average PSNR differences between RD-curves", ITU-T SG16/Q6 document
VCEG-M33, Austin, April 2001. The paper fits one cubic polynomial through four points. This module
follows later practice (VCEG-AE07, JCTVC-B055, the spreadsheets of HEVC's and VVC's common test
conditions): piecewise cubic Hermite interpolation (PCHIP) through any number of points, which does
not overshoot. With r = log10(bytes) and D the quality, over the interval that both curves cover:

    BD-quality = 1/(r2 - r1) * integral of D_test(r) - D_anchor(r) dr
    BD-rate    = 10 ** (1/(D2 - D1) * integral of r_test(D) - r_anchor(D) dD) - 1
"""

import math
from collections.abc import Sequence
from itertools import pairwise

from nanogs.errors import OptionError

Curve = Sequence[tuple[float, float]]
"""Points (bytes, quality) of one method; bytes above 0, both finite."""


def bd_quality(anchor: Curve, test: Curve) -> float | None:
    """Compute the mean gain of `test` over `anchor` at equal bytes, in the unit of the quality.

    Args:
        anchor: Points in any order.
        test: Points in any order.

    Returns:
        The mean difference; None if a curve has fewer than two sizes or two qualities at one size,
        or if the curves share no interval of sizes.

    Raises:
        OptionError: SciPy is not installed.
    """
    return _mean_difference(*([(math.log10(r), d) for r, d in curve] for curve in (anchor, test)))


def bd_rate(anchor: Curve, test: Curve) -> float | None:
    """Compute the mean relative increase in bytes of `test` over `anchor` at equal quality.

    Args:
        anchor: Points in any order.
        test: Points in any order.

    Returns:
        The increase as a share: -0.5 means half the bytes. None if a curve has fewer than two
        qualities or does not rise with its bytes, or if the curves share no interval of qualities.

    Raises:
        OptionError: SciPy is not installed.
    """
    if not (rises(anchor) and rises(test)):
        return None
    swapped = ([(d, math.log10(r)) for r, d in curve] for curve in (anchor, test))
    mean = _mean_difference(*swapped)
    return None if mean is None else 10**mean - 1


def rises(curve: Curve) -> bool:
    """Return whether the quality increases strictly with the bytes."""
    qualities = [quality for _, quality in sorted(curve)]
    return all(low < high for low, high in pairwise(qualities))


def _mean_difference(anchor: Curve, test: Curve) -> float | None:
    """Compute the mean of `test` minus `anchor` over the interval of abscissas that both cover."""
    places = [sorted(x for x, _ in curve) for curve in (anchor, test)]
    if any(len(each) < 2 or len(set(each)) < len(each) for each in places):
        return None
    low, high = max(each[0] for each in places), min(each[-1] for each in places)
    if low >= high:
        return None
    return (_integral(test, low, high) - _integral(anchor, low, high)) / (high - low)


def _integral(curve: Curve, low: float, high: float) -> float:
    """Integrate the piecewise cubic through the points from `low` to `high`, both within them."""
    from scipy.interpolate import PchipInterpolator

    x, y = zip(*sorted(curve), strict=True)
    return float(PchipInterpolator(x, y).integrate(low, high))


def check_packages() -> None:
    """Fail before anything is measured if a package for the figures or their plot is missing.

    Raises:
        OptionError: SciPy or matplotlib is not installed.
    """
    try:
        import matplotlib.figure  # noqa: F401
        import scipy.interpolate  # noqa: F401
    except ImportError as error:
        raise OptionError('Sizes of files need packages: pip install "nanogs[bench]".') from error
