"""Encoding a model as the columns of an `.spz` file, and the palette of its harmonics.

The higher SH coefficients are most of a file. The format has no palette, but repetitions within
32 kB cost gzip next to nothing: with a palette, splats that share an entry are written in a row, so
that each entry is packed once.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from nanogs._types import F32, F64, I64, U8
from nanogs.io.by_column import Encoder
from nanogs.io.palette import palette
from nanogs.io.precision import MOST_BITS, visibility
from nanogs.io.spz.centres import position_bytes
from nanogs.io.spz.codes import (
    STEPS,
    alpha_codes,
    coefficient_codes,
    colour_codes,
    scale_codes,
)
from nanogs.io.spz.header import VERSION_SHORT_ROTATIONS
from nanogs.io.spz.rotations import (
    as_they_are,
    packed_rotations,
    packed_rounding,
    smallest_rotations,
    unit_or_read,
    xyz_rotations,
    xyz_rounding,
)
from nanogs.progress import PartProgress
from nanogs.source import InMemory
from nanogs.splats import Splats

_Pack = Callable[[F32], U8]  # encodes (R, 4) unit wxyz rotations
_Turn = Callable[[Splats], tuple[F32, F32]]  # returns rotations and log-scales of a block to write


def encoders(fraction: int, version: int, bits: int, buckets: F64) -> list[Encoder]:
    """Return the functions that encode a block of rows, one for each column of the file.

    Args:
        fraction: Fraction bits of the centres.
        version: Version of the file, 2 to 4.
        bits: Precision of values, a key of `STEPS`.
        buckets: (K - 1, 1) steps of the higher SH coefficients.
    """
    steps = STEPS[bits]
    pack: _Pack
    turned: _Turn = as_they_are
    if version == VERSION_SHORT_ROTATIONS:
        rounding = xyz_rounding(steps.rotations)
        pack = partial(xyz_rotations, step=steps.rotations)
        turned = partial(unit_or_read, rounding=rounding)
    else:
        rounding = packed_rounding(steps.magnitudes)
        pack = partial(packed_rotations, rounding=rounding, step=steps.magnitudes)
    if bits < MOST_BITS:
        turned = partial(smallest_rotations, rounding=rounding)
    encoders: list[Encoder] = [
        lambda block: position_bytes(block.means, fraction),
        lambda block: alpha_codes(block, steps.alphas),
        lambda block: colour_codes(block, steps.colours),
        lambda block: scale_codes(turned(block)[1], steps.scales),
        lambda block: pack(turned(block)[0]),
    ]
    if len(buckets):
        encoders.append(lambda block: coefficient_codes(block.sh[:, 1:], buckets))
    return encoders


def with_palette(
    splats: Splats, size: int, on_progress: PartProgress, buckets: F64 | None
) -> tuple[InMemory, I64 | None]:
    """Replace the higher SH coefficients by at most `size` palette entries.

    Args:
        splats: N splats.
        size: Largest number of entries.
        on_progress: Progress callback.
        buckets: (K - 1, 1) steps of the coefficients; None if splats may not be moved.

    Returns:
        The splats, sorted by palette entry, and (N,) int64, the entry of each, ascending; entries
        that the steps make equal count as one. If splats may not be moved: the splats in their own
        order, and None.
    """
    points = splats.sh[:, 1:].reshape(len(splats), -1)
    found = palette(points, size, visibility(splats), on_progress)
    sh = splats.sh.copy()
    sh[:, 1:] = found.entries[found.labels].reshape(len(splats), -1, 3)
    sharing = replace(splats, sh=sh)
    if buckets is None:
        return InMemory(sharing), None
    codes = coefficient_codes(found.entries.reshape(len(found.entries), -1, 3), buckets)
    distinct = palette(codes.astype(np.float32), len(codes))
    labels = distinct.labels[found.labels]
    rows = np.argsort(labels, kind="stable")
    return InMemory(sharing.take(rows)), labels[rows].astype(np.int64)
