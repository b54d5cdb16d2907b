"""First pass over the input: each segment, sorted by Morton code, into a file of its own.

A sorted segment holds the rows of any block in one piece, whatever blocks are chosen afterwards.
"""

import numpy as np

from nanogs.findings import to_plain
from nanogs.pipeline.rows import read_segment
from nanogs.pipeline.settings import Settings
from nanogs.pipeline.units import Units
from nanogs.pipeline.unpack import Unpacked
from nanogs.store.columns import CODES, sorted_columns
from nanogs.store.scratch import Scratch
from nanogs.store.tables import Record, Sorted, write_table

DIGEST = "digest"


def spill(
    scratch: Scratch,
    name: str,
    settings: Settings,
    units: Units,
    number: int,
    unpacked: Unpacked | None = None,
) -> Record:
    """Sort a segment and write it, with evenly spread ones of its codes apart.

    Args:
        scratch: Where to.
        name: Of the table.
        settings: The job.
        units: Of its scene.
        number: Of the segment.
        unpacked: The files that have been unpacked, if any.

    Raises:
        FormatError: The input cannot be read, or has changed.
        ModelError: A row is not usable, and that is to be an error.
        OutputError: The table cannot be written.
    """
    segment = settings.segments[number]
    splats = read_segment(settings, segment, unpacked)
    codes = units.codes(splats)
    order = np.argsort(codes, kind="stable")
    digest = codes[order[:: settings.every]]
    columns = sorted_columns(splats, order) | {CODES: Sorted(codes, order), DIGEST: digest}
    facts = {
        "splats": len(splats),
        "dropped": segment.stop - segment.start - len(splats),
        "notes": [to_plain(note) for note in splats.notes],
    }
    return write_table(scratch, name, columns, facts)
