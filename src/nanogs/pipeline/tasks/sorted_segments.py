"""First pass over the input: each segment is sorted by Morton code and written to its own table.

Any block is then one contiguous range of a sorted segment, so blocks can be chosen afterwards.
"""

from typing import TYPE_CHECKING

from nanogs.findings import to_plain
from nanogs.pipeline.job.rows import read_segment
from nanogs.sorting import stable_order
from nanogs.store.columns import CODES, sorted_columns
from nanogs.store.tables import Record, Sorted, write_table

if TYPE_CHECKING:
    from nanogs.pipeline.scene import Task
    from nanogs.pipeline.work import Work

DIGEST = "digest"


def write_segment(work: "Work", task: "Task") -> Record:
    """Sort a segment by Morton code and write it, with a digest: evenly spread codes of it.

    Raises:
        FormatError: The input cannot be read, or has changed.
        ModelError: A row is not usable, and that is to be an error.
        OutputError: The table cannot be written.
    """
    settings = work.settings
    segment = settings.segments[task.number]
    splats = read_segment(settings, segment, work.unpacked())
    codes = work.units.codes(splats)
    order = stable_order(codes)
    digest = codes[order[:: settings.rows_per_code]]
    columns = sorted_columns(splats, order) | {CODES: Sorted(codes, order), DIGEST: digest}
    facts = {
        "splats": len(splats),
        "dropped": segment.stop - segment.start - len(splats),
        "notes": [to_plain(note) for note in splats.notes],
    }
    return write_table(work.scratch, task.name, columns, facts)
