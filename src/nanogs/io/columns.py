"""How the columns of a 3DGS PLY vertex map onto the arrays of `Splats`."""

import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import product
from typing import Any

from nanogs._types import Array
from nanogs.errors import FormatError
from nanogs.formatting import counted
from nanogs.splats import MAX_SH_DEGREE

MEANS = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
BASE_COLOUR = ("f_dc_0", "f_dc_1", "f_dc_2")
OPACITY = "opacity"
SCALES = ("scale_0", "scale_1", "scale_2")
QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
SMOOTHING = "filter_3D"  # of Mip-Splatting and methods that follow it
REQUIRED = (*MEANS, *BASE_COLOUR, OPACITY, *SCALES, *QUATS)
REST = re.compile(r"f_rest_(0|[1-9][0-9]*)", re.ASCII)
DEGREE_OF_REST = {3 * ((d + 1) ** 2 - 1): d for d in range(MAX_SH_DEGREE + 1)}


def rest_names(degree: int) -> list[str]:
    """Return the columns of the higher SH coefficients: all of red, then green, then blue."""
    return [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]


def by_column(names: Sequence[str], array: Array) -> Iterator[tuple[str, Array]]:
    """Yield each column of an array with its name, as a view of shape (N,).

    Args:
        names: Names of the columns, in C order of all axes but the first.
        array: (N, ...); the axes but the first have as many entries together as there are names.
    """
    places: Iterator[Any] = product(*map(range, array.shape[1:]))
    for name, place in zip(names, places, strict=True):
        yield name, array[:, *place]


def is_known(name: str) -> bool:
    """Whether nanogs interprets a vertex column of that name."""
    return name in REQUIRED or REST.fullmatch(name) is not None


def sh_degree(names: Iterable[str], where: str) -> int:
    """Compute the SH degree from the number of `f_rest_*` columns.

    Args:
        names: All column names.
        where: The file and element, for the message.

    Raises:
        FormatError: Their number is not that of a degree, or their indices have gaps.
    """
    present = {name for name in names if REST.fullmatch(name)}
    degree = DEGREE_OF_REST.get(len(present))
    if degree is None:
        raise FormatError(
            f"{where} has {counted(len(present), 'f_rest property', 'f_rest properties')}, but"
            " spherical harmonics of degree 0 to 4 have 0, 9, 24, 45 or 72; export the file again."
        )
    if missing := [name for name in rest_names(degree) if name not in present]:
        raise FormatError(
            f"{where} has {len(present)} f_rest properties, but {missing[0]} is missing from"
            " the sequence; export the file again."
        )
    return degree


def scale_names(names: Iterable[str], where: str) -> tuple[str, ...]:
    """Return the columns of the scales: three, or two if splats are flat, as 2DGS trains them.

    Raises:
        FormatError: A property that all splats have is missing.
    """
    present = set(names)
    missing = [name for name in REQUIRED if name not in present]
    if missing and missing != [SCALES[2]]:
        kind = "a point cloud or mesh" if len(missing) > 4 else "damaged"
        raise FormatError(
            f"{where} lacks {', '.join(missing)}: it is {kind}, not a 3D Gaussian splatting"
            " model; export the splats."
        )
    return SCALES[:2] if missing else SCALES
