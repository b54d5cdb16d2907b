"""The palette of the higher SH coefficients of SOG, and the label of each splat."""

from typing import Any

import numpy as np

from nanogs._types import F32
from nanogs.io.palette import Palette, palette
from nanogs.io.precision import visibility
from nanogs.io.sog.codebook import codebook, json_values, nearest
from nanogs.io.sog.meta import CODES, MAX_DEGREE, PALETTE_COLUMNS
from nanogs.io.sog.options import EXACT_BITS, MERGED_BITS, USUAL_PALETTE, SogOptions
from nanogs.io.sog.texture import Submit, as_texture
from nanogs.progress import PartProgress
from nanogs.splats import Splats


def encode_harmonics(
    splats: Splats, options: SogOptions, submit: Submit, on_progress: PartProgress
) -> dict[str, Any]:
    """Submit the palette of the higher coefficients and its labels; return `shN` of `meta.json`."""
    degree = min(splats.sh_degree, MAX_DEGREE)
    coefficients = (degree + 1) ** 2 - 1
    points = splats.sh[:, 1 : coefficients + 1].reshape(len(splats), -1)
    size = options.palette_size or USUAL_PALETTE.entries(len(splats))
    found = palette(points, size, visibility(splats), on_progress)
    book = codebook(found.entries, 1 << (options.sh_bits or _usual_bits(found, size)))
    codes = nearest(found.entries, book)
    distinct = palette(codes.astype(np.float32), len(codes))  # each is written once
    count = len(distinct.entries)
    height = -(-count // PALETTE_COLUMNS)
    texels = np.zeros((height * PALETTE_COLUMNS, coefficients, 3), np.uint8)
    texels[:count] = distinct.entries.reshape(count, coefficients, 3)
    submit("shN_centroids.webp", texels.reshape(height, -1, 3))
    labels = distinct.labels[found.labels].astype(np.uint16)
    nothing = np.zeros(len(labels), np.uint8)
    submit(
        "shN_labels.webp",
        as_texture(np.column_stack([labels & 255, labels >> 8, nothing]).astype(np.uint8)),
    )
    return {
        "count": count,
        "bands": degree,
        "codebook": json_values(book),
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }


def _usual_bits(found: Palette, size: int) -> int:
    """Return the default bits of a code for a palette of at most `size` entries."""
    # A full palette may hold harmonics that were merged before, even if it is exact now.
    full = size <= len(found.entries) < len(found.labels)
    unmerged = found.exact and (not full or _few_values(found.entries))
    return EXACT_BITS if unmerged else MERGED_BITS


def _few_values(entries: F32) -> bool:
    """Whether the values of the entries come from a codebook already and are not means."""
    return len(np.unique(entries)) <= CODES
