"""First pass over the input: each segment is sorted by Morton code and written to its own table.

Any block is then one contiguous range of a sorted segment, so blocks can be chosen afterwards.
"""

import numpy as np

from nanogs.findings import to_plain
from nanogs.pipeline.job.rows import read_segment
from nanogs.pipeline.options.settings import Settings
from nanogs.pipeline.tasks.units import Units
from nanogs.pipeline.tasks.unpack import Unpacked
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
    """Sort a segment by Morton code and write it, with a digest: evenly spread codes of it.

    Args:
        scratch: Where to write.
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
    digest = codes[order[:: settings.rows_per_code]]
    columns = sorted_columns(splats, order) | {CODES: Sorted(codes, order), DIGEST: digest}
    facts = {
        "splats": len(splats),
        "dropped": segment.stop - segment.start - len(splats),
        "notes": [to_plain(note) for note in splats.notes],
    }
    return write_table(scratch, name, columns, facts)
