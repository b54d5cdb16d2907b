"""The model of a job: its input files joined as one scene, filtered, and read by segments."""

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import accumulate, pairwise
from pathlib import Path

import numpy as np

from nanogs.errors import ModelError, OptionError
from nanogs.filters import Filter, filter_of
from nanogs.io import open as open_model
from nanogs.pipeline.job.inputs import Inputs, input_file
from nanogs.pipeline.options.settings import Access, FilterCounts, InputFile, Segment, Settings
from nanogs.pipeline.reading import Changes, dropped_first, open_parts
from nanogs.pipeline.tasks.unpack import Unpacked
from nanogs.source import Filtered, Joined, Layout, Source, fitted, joined_layout
from nanogs.source.base import PAGE_ROWS
from nanogs.splats import Splats, concatenate

RUN_ROWS, _MOST_RUNS, _LEAST_RUNS = 1024, 256, 16  # rows of a run; most and fewest runs
_NEAR = 8  # runs are read together, gaps included, if that is at most this many times their rows


def describe_inputs(
    paths: Sequence[Path], changes: Changes
) -> tuple[tuple[InputFile, ...], Layout]:
    """Describe the input files, and the columns of their splats; no row is read.

    Raises:
        FormatError: One of them cannot be read.
        ModelError: They do not make one scene.
    """
    # A render mode that is asked for is part of the layout, which overrides the files' when read.
    sources = open_parts(paths, changes.render_mode)
    layout = joined_layout(sources)
    if remarks := dict.fromkeys(remark for source in sources for remark in source.remarks):
        layout = replace(layout, notes=(*layout.notes, *remarks))
    if changes.sh_degree is not None and changes.sh_degree < layout.sh_degree:
        notes = (*layout.notes, dropped_first(changes.sh_degree))
        layout = replace(layout, sh_degree=changes.sh_degree, notes=notes)
    return tuple(map(input_file, map(open_model, paths))), layout


def count_filtered(
    files: Sequence[InputFile], layout: Layout, filters: Sequence[Filter]
) -> FilterCounts | None:
    """Apply filters to all rows of files and count the rows left; None without filters.

    Raises:
        FormatError: One of the files cannot be read.
        ModelError: Nothing is left.
    """
    if not filters:
        return None
    with Inputs(files, None) as inputs:
        left = Filtered(Joined(inputs.parts, layout), filters)
        plain = tuple(each.plain for each in filters if each.plain is not None)
        return FilterCounts(plain, tuple(report.left for report in left.reports), left.kept)


def refuse_large_whole(files: Sequence[InputFile], rows: int) -> None:
    """Refuse files that must be read whole and have more rows than a segment may have.

    Raises:
        OptionError: There is one.
    """
    for file in files:
        if file.splats > rows and file.access is Access.WHOLE:
            raise OptionError(
                f"{file.path}: files of this kind are not read in parts, and this one is too large"
                " to be read whole within the memory given; convert it to .ply, or raise"
                " `max_memory`."
            )


def segments_of(count: int, rows: int) -> tuple[Segment, ...]:
    """Divide `count` rows into segments of about equal size, of at most `rows`."""
    parts = -(-count // rows)
    bounds = [count * part // parts for part in range(parts + 1)]
    return tuple(Segment(*pair) for pair in pairwise(bounds))


@contextmanager
def opened(settings: Settings, unpacked: Unpacked | None = None) -> Iterator[Source]:
    """Open the model of a job, and check before and after that its files are unchanged.

    Args:
        settings: The job.
        unpacked: The files that have been unpacked, if any.

    Raises:
        FormatError: A file cannot be read, or has changed since the job began.
    """
    with Inputs(settings.inputs, unpacked) as inputs:
        source: Source = Joined(inputs.parts, settings.layout)
        if settings.filters is not None:
            filters = [filter_of(*plain) for plain in settings.filters.plain]
            source = Filtered(source, filters, settings.filters.kept)
        yield source
        inputs.check()


def read_segment(settings: Settings, segment: Segment, unpacked: Unpacked) -> Splats:
    """Read the usable splats of a segment, with the columns of the job.

    Args:
        settings: The job.
        segment: The rows to read.
        unpacked: The files that have been unpacked.

    Raises:
        FormatError: The file cannot be read, or has changed since the job began.
        ModelError: A splat holds a NaN or an infinite value, and that is to be an error.
    """
    with opened(settings, unpacked) as source:
        splats = source.read(segment.start, segment.stop)
    finite = splats.finite()
    if finite.all():
        return splats
    if settings.nan == "error":
        where = _row_name(settings, segment.start + int(np.argmin(finite)))
        raise ModelError(
            f'{where} holds a NaN or an infinite value; leave such splats out with `nan="drop"`.'
        )
    return splats.take(finite)


def _row_name(settings: Settings, row: int) -> str:
    """Name a row of the model, to begin a sentence."""
    if settings.filters is not None:
        return f"Row {row} of those that filters leave"
    ends = [0, *accumulate(file.splats for file in settings.inputs)]
    number = bisect_right(ends, row) - 1
    return f"{settings.inputs[number].path}: row {row - ends[number]}"


def sample(
    settings: Settings,
    unpacked: Unpacked | None = None,
    *,
    rows: int | None = None,
    span: int = RUN_ROWS,
    bare: bool = True,
) -> Splats:
    """Read usable rows of all inputs in evenly spread runs.

    Args:
        settings: The job.
        unpacked: The files that have been unpacked, if any.
        rows: Number of rows in all, about; by default as many as a block has, whose memory is
            enough for them, but at least 16,384 and at most 262,144.
        span: Rows of each run.
        bare: Whether to leave out higher harmonics and extra columns.

    Raises:
        FormatError: A file cannot be read, or has changed since the job began.
    """
    parts = []
    layout = settings.layout.bare() if bare else settings.layout
    rows = rows or min(max(settings.block // RUN_ROWS, _LEAST_RUNS), _MOST_RUNS) * RUN_ROWS
    every = -(-settings.splats // rows)
    apart = span * every
    # A page takes hardly longer to read than a run.
    runs = max(PAGE_ROWS // apart, 1) if every <= _NEAR else 1
    with opened(settings, unpacked) as source:
        for start in range(0, source.count, runs * apart):
            part = source.read(start, min(start + (runs - 1) * apart + span, source.count))
            wanted = part.finite() & (np.arange(len(part)) % apart < span)
            parts.append(fitted(part.take(wanted), layout))
    return concatenate(parts)
