"""Sources that change the rows of another source when these are read: filtered, turned, ..."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from nanogs._types import I64
from nanogs.errors import OptionError
from nanogs.filters import (
    Filter,
    FilterReport,
    apply,
    checked_filters,
    refuse_empty,
    refuse_whole,
)
from nanogs.findings import join_findings
from nanogs.frames import change_between, change_frame, comments_in
from nanogs.pose import Pose
from nanogs.slices import overlapping
from nanogs.source import base
from nanogs.source.base import Source, joined_rows, refuse_no_source, span_of
from nanogs.splats import ExtraElement, RenderMode, Splats, check_degree, refuse_misaligned


class _Changed(Source):
    """A source that changes the rows of another when these are read."""

    def __init__(self, source: Source) -> None:
        refuse_no_source(source)
        self._source, self.name = source, source.name
        self.columns, self.elements = source.columns, source.elements

    @cached_property
    def count(self) -> int:
        """Number of splats."""
        return self._source.count

    def read_elements(self) -> tuple[ExtraElement, ...]:
        """Read the elements of the original source; see `Source.read_elements`."""
        return self._source.read_elements()

    def close(self) -> None:
        """Close the original source."""
        self._source.close()


class _Mapped(_Changed):
    """A source that changes each row independently of the others."""

    def __init__(self, source: Source, change: Callable[[Splats], Splats]) -> None:
        super().__init__(source)
        self._change = change

    def _span(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop`; see `Source.read`."""
        return self._change(self._source.read(start, stop))

    def load(self) -> Splats:
        """Read the whole model, changed."""
        return self._change(self._source.load())


class Turned(_Mapped):
    """A model turned to another frame; see `nanogs.frames`.

    Args:
        source: The model.
        before: The frame it is in, such as "rub".
        after: The frame it is to be in.

    Raises:
        OptionError: One of them is no frame.
    """

    def __init__(self, source: Source, before: str, after: str) -> None:
        change = change_between(before, after)
        super().__init__(source, lambda rows: change_frame(rows, before, after))
        comments = comments_in(change, self.columns.comments)
        self.columns = replace(self.columns, comments=comments)


class Posed(_Mapped):
    """A model that is moved, turned or scaled.

    Args:
        source: The model.
        pose: The transform.
    """

    def __init__(self, source: Source, pose: Pose) -> None:
        super().__init__(source, pose.applied)
        self.columns = replace(self.columns, comments=pose.comments(self.columns.comments))


def turned_source(source: Source, frames: tuple[str, str] | None) -> Source:
    """Return a source turned from the first of two frames to the second, if there are any."""
    return Turned(source, *frames) if frames else source


class Reduced(_Mapped):
    """A model without the bands of spherical harmonics above a degree.

    Args:
        source: The model.
        degree: The highest that may stay, 0 to 4.

    Raises:
        OptionError: The degree is not from 0 to 4.
    """

    def __init__(self, source: Source, degree: int) -> None:
        check_degree(degree)
        super().__init__(source, lambda rows: rows.with_sh_degree(degree))
        self.columns = self.columns.reduced(degree)


class Tagged(_Mapped):
    """A model with another render mode than its own.

    Args:
        source: The model.
        mode: The rasteriser it is to be drawn by, as a `RenderMode` or its value.

    Raises:
        OptionError: There is no such mode.
    """

    def __init__(self, source: Source, mode: RenderMode | str) -> None:
        if mode not in tuple(RenderMode):
            raise OptionError(f"The mode must be one of {', '.join(RenderMode)}, not {mode!r}.")
        mode = RenderMode(mode)
        super().__init__(source, lambda rows: replace(rows, render_mode=mode))
        self.columns = replace(self.columns, render_mode=mode.value)


class Noted(_Changed):
    """A model that keeps the notes about its rows, once they have been read.

    A reader may go through all rows in order, or load the model; others may read some rows before.

    Args:
        source: The model.
    """

    def __init__(self, source: Source) -> None:
        super().__init__(source)
        self._found: list[Sequence[str]] = []
        self._end = 0  # number of the first rows that `_found` is about

    @property
    def notes(self) -> tuple[str, ...]:
        """The notes about all rows, or about the first ones as far as they have been read."""
        return join_findings([self.columns.notes, *self._found])

    def _span(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop`; see `Source.read`."""
        rows = self._source.read(start, stop)
        if self._end < self.count:
            if start == 0:  # a reader begins, perhaps after another that has not read everything
                self._found.clear()
                self._end = 0
            if start == self._end:
                self._found.append(rows.notes)
                self._end = stop
        return rows

    def _take(self, rows: I64) -> Splats:
        """Read rows by number; see `Source.take`."""
        return self._source.take(rows)

    def load(self) -> Splats:
        """Read the whole model."""
        splats = self._source.load()
        self._found, self._end = [splats.notes], self.count
        return splats


class Filtered(_Changed):
    """The splats of a model that pass several filters, each applied to what those before it left.

    The rows that are left of each page are counted in a first pass over the source, made when the
    counts are first needed; then pages are read when they are asked for, and filtered again.

    Args:
        source: The model.
        filters: Filters, such as `nanogs.filters.box(low, high)`.
        kept: Number of rows left of each page, if they have been counted.

    Raises:
        OptionError: They are no filters, or one has to see the whole model; `nanogs.filters.apply`
            can be used for it.
    """

    def __init__(
        self, source: Source, filters: Sequence[Filter], kept: Sequence[int] | None = None
    ) -> None:
        super().__init__(source)
        filters = checked_filters(filters)
        refuse_whole(filters)
        self._filters, self._given = filters, kept
        self._last: tuple[int, Splats] | None = None

    @cached_property
    def _passed(self) -> np.ndarray[tuple[int, int], np.dtype[np.int64]]:
        """(P, F) number of rows of each page that are left after each filter.

        Raises:
            ModelError: No splat is left, or an element has one row for each splat.
        """
        pages = []
        for page in self._source.blocks(base.PAGE_ROWS):
            left, counts = page, []
            for each in self._filters:
                left = left.take(each.mask(left))
                counts.append(len(left))
            pages.append(counts)
        passed = np.array(pages, np.int64).reshape(-1, len(self._filters))
        before = self._source.count
        for each, after in zip(self._filters, passed.sum(axis=0).tolist(), strict=True):
            refuse_empty(each, before, after)
            before = after
        refuse_misaligned(self._source.elements, self._source.count, before)
        return passed

    @property
    def kept(self) -> tuple[int, ...]:
        """Number of rows left of each page of `PAGE_ROWS` rows.

        Raises:
            ModelError: No splat is left, or an element has one row for each splat.
        """
        if self._given is None:
            self._given = tuple(self._passed[:, -1].tolist())
        return tuple(self._given)

    @property
    def reports(self) -> tuple[FilterReport, ...]:
        """Reports of the number of splats that each filter removes."""
        left = [self._source.count, *self._passed.sum(axis=0).tolist()]
        return tuple(
            FilterReport(each.name, each.argument, before - after, after)
            for each, (before, after) in zip(self._filters, pairwise(left), strict=True)
        )

    @cached_property
    def _ends(self) -> I64:
        return np.concatenate(([0], np.cumsum(self.kept, dtype=np.int64)))

    @cached_property
    def count(self) -> int:
        """Number of splats that are left."""
        return int(self._ends[-1])

    def _span(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop` of those left; see `Source.read`."""
        parts = [
            span_of(self._page(page), low, high)
            for page, low, high in overlapping(self._ends, start, stop)
        ]
        return joined_rows(parts or [span_of(self._source.read(0, 0), 0, 0)])

    def _page(self, number: int) -> Splats:
        last = self._last  # once, because another thread may read another page
        if last is None or last[0] != number:
            at = number * base.PAGE_ROWS
            rows = self._source.read(at, min(at + base.PAGE_ROWS, self._source.count))
            for each in self._filters:
                rows = rows.take(each.mask(rows))
            last = self._last = number, rows
        return last[1]

    def close(self) -> None:
        """Free the cached page, and close the source."""
        self._last = None
        super().close()

    def load(self) -> Splats:
        """Read all splats that are left."""
        return apply(self._source.load(), self._filters)[0]
