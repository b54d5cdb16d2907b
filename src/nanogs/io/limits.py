"""What formats that hold splats alone have in common when a model holds more."""

from collections.abc import Iterator

import numpy as np

from nanogs.errors import OutputError
from nanogs.splats import Splats


def losses(splats: Splats, suffix: str, max_degree: int) -> Iterator[str]:
    """What a format leaves out that holds no further columns and elements, and no doubles.

    Args:
        splats: The model.
        suffix: What the format is called in the sentences.
        max_degree: The highest SH degree it holds.
    """
    if splats.extras:
        yield f"{suffix} holds no extra columns: {', '.join(splats.extras)} are left out."
    if splats.elements:
        names = ", ".join(element.name for element in splats.elements)
        yield f"{suffix} holds no further elements: {names} are left out."
    if splats.sh_degree > max_degree:
        yield (
            f"{suffix} holds spherical harmonics up to degree {max_degree}: those of degree"
            f" {splats.sh_degree} are left out."
        )
    if splats.means.dtype == np.float64:
        yield f"{suffix} holds centres in single precision: these doubles are rounded."


def refuse_nonfinite(splats: Splats, suffix: str) -> None:
    """Refuse what a format cannot state: NaN and infinities, but for opacities and zero scales.

    Raises:
        OutputError: A splat holds such a value, or a centre is beyond float32.
    """
    with np.errstate(over="ignore"):
        good = splats.finite() & np.isfinite(splats.means.astype(np.float32)).all(axis=1)
    if not good.all():
        raise OutputError(
            f"{len(splats) - int(good.sum())} splats hold a NaN or infinite value, the first in row"
            f" {int(np.argmin(good))}, which {suffix} cannot hold; leave them out with"
            " `nanogs simplify --ratio 1`."
        )
