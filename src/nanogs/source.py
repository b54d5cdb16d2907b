"""Models of which some rows are read at a time: in memory, in a file, joined, filtered or turned.

Every reader gives a `Source`; `load` is one whose rows are all read. `Joined`, `Filtered` and
`Turned` change rows when they are read, and hold none. What a format has to do with it is in `io`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Self

import numpy as np

from nanogs._types import I64
from nanogs.errors import ModelError, OptionError
from nanogs.filters import Filter, FilterReport, apply, refuse_empty, refuse_whole
from nanogs.findings import join_findings
from nanogs.frames import change_between, change_frame
from nanogs.splats import (
    ExtraElement,
    RenderMode,
    Splats,
    concatenate,
    padded,
    refuse_misaligned,
)

BLOCK_ROWS = 8192  # of a block, unless told otherwise
PAGE_ROWS = 1 << 13  # rows in and out of which a filter's are counted


@dataclass(frozen=True, slots=True)
class Layout:
    """The columns of a model, and what is said of all its splats.

    Attributes:
        sh_degree: Degree of the spherical harmonics, 0 to 4.
        double_means: Whether the centres are in double precision.
        extras: Name and dtype of the extra columns.
        render_mode: The rasteriser that the model was trained for.
        comments: Comment lines.
        notes: What is left out of the whole, one sentence each.
    """

    sh_degree: int
    double_means: bool
    extras: tuple[tuple[str, str], ...]
    render_mode: str
    comments: tuple[str, ...]
    notes: tuple[str, ...] = ()


class Source(ABC):
    """A model of which some rows are read at a time.

    `read(start, stop)` and `take(rows)` give splats with the columns of `columns`, bit for bit as
    the whole has them, with notes about those rows; further PLY elements come without their rows,
    which `read_elements` gives. A source that holds files open or temporary ones is closed by
    `close`, or at the end of a `with` block.

    Attributes:
        name: What it is called in messages.
    """

    name = "the model"

    @property
    @abstractmethod
    def count(self) -> int:
        """Number of splats."""

    @property
    @abstractmethod
    def columns(self) -> Layout:
        """The columns; no row is read for them."""

    @abstractmethod
    def read(self, start: int, stop: int) -> Splats:
        """Some rows.

        Args:
            start: The first row.
            stop: The row after the last, at most `count`.

        Raises:
            FormatError: They cannot be read, or are damaged.
        """

    def take(self, rows: I64) -> Splats:
        """Rows by number, in any order; those that lie far apart are read one page at a time.

        Raises:
            FormatError: They cannot be read, or are damaged.
        """
        if not len(rows):
            return self.read(0, 0)
        order = np.argsort(rows, kind="stable")
        ascending = rows[order]
        breaks = np.flatnonzero(np.diff(ascending // PAGE_ROWS)) + 1
        parts = [
            self.read(int(some[0]), int(some[-1]) + 1).take(some - some[0])
            for some in np.split(ascending, breaks)
        ]
        back = np.empty_like(order)
        back[order] = np.arange(len(order))
        return joined_rows(parts).take(back)

    def blocks(self, rows: int | None = None) -> Iterator[Splats]:
        """All splats in their order, so many at a time; `BLOCK_ROWS` unless told otherwise.

        Raises:
            FormatError: As for `read`, after some blocks perhaps.
        """
        step = rows or BLOCK_ROWS
        for start in range(0, self.count, step):
            yield self.read(start, min(start + step, self.count))

    @property
    def elements(self) -> tuple[tuple[str, int], ...]:
        """Name and number of rows of each further PLY element."""
        return ()

    def read_elements(self) -> tuple[ExtraElement, ...]:
        """The further PLY elements with their rows.

        Raises:
            FormatError: They cannot be read.
        """
        return ()

    def load(self) -> Splats:
        """The whole model.

        Raises:
            FormatError: As for `read`.
        """
        splats = self.read(0, self.count)
        return replace(splats, elements=self.read_elements()) if self.elements else splats

    def close(self) -> None:  # noqa: B027 - most have nothing to close
        """Close files that are open, and remove temporary ones."""

    def __len__(self) -> int:
        return self.count

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class InMemory(Source):
    """A model that is held whole, as a source; what is read are views of it."""

    def __init__(self, splats: Splats) -> None:
        self._splats = splats

    @property
    def count(self) -> int:
        """Number of splats."""
        return len(self._splats)

    @property
    def columns(self) -> Layout:
        """The columns of the model."""
        splats = self._splats
        return Layout(
            sh_degree=splats.sh_degree,
            double_means=splats.means.dtype == np.float64,
            extras=tuple((name, column.dtype.str) for name, column in splats.extras.items()),
            render_mode=splats.render_mode.value,
            comments=tuple(splats.comments),
            notes=tuple(splats.notes),
        )

    def read(self, start: int, stop: int) -> Splats:
        """Some rows; see `Source`. What is said of the whole is in `columns`."""
        return replace(self._splats.span(start, stop), notes=())

    def take(self, rows: I64) -> Splats:
        """Rows by number; see `Source`."""
        return replace(self._splats.take(rows), notes=())

    @property
    def elements(self) -> tuple[tuple[str, int], ...]:
        """The elements of the model; see `Source`."""
        return tuple((element.name, len(element.rows)) for element in self._splats.elements)

    def read_elements(self) -> tuple[ExtraElement, ...]:
        """The elements of the model; see `Source`."""
        return tuple(self._splats.elements)

    def load(self) -> Splats:
        """The model itself."""
        return self._splats


def source_of(model: Splats | Source) -> Source:
    """A model in memory as a source; sources as they are."""
    return InMemory(model) if isinstance(model, Splats) else model


class Joined(Source):
    """Several models as parts of one scene, one after the other.

    The columns are those that all have; coefficients that a part lacks are 0.

    Args:
        parts: One or more.
        layout: Columns that the parts are brought to; by default `joined_layout` of theirs. Of a
            lower SH degree than theirs, it leaves out the bands above.

    Raises:
        ModelError: The parts make no one scene.
    """

    def __init__(self, parts: Sequence[Source], layout: Layout | None = None) -> None:
        self._parts = parts
        self._layout = layout or joined_layout(parts)
        self._ends = [0, *accumulate(part.count for part in parts)]
        self.name = ", ".join(part.name for part in parts)

    @property
    def count(self) -> int:
        """Splats of all parts."""
        return self._ends[-1]

    @property
    def columns(self) -> Layout:
        """The columns that the parts are brought to."""
        return self._layout

    def read(self, start: int, stop: int) -> Splats:
        """Some rows; see `Source`."""
        found = []
        for part, (first, end) in zip(self._parts, pairwise(self._ends), strict=True):
            low, high = max(start, first), min(stop, end)
            if low < high or (start == stop == first):
                found.append(fitted(part.read(low - first, high - first), self._layout))
        return joined_rows(found)

    def load(self) -> Splats:
        """The whole model, with the notes of all parts."""
        splats = joined_rows([fitted(part.load(), self._layout) for part in self._parts])
        notes = dict.fromkeys([*self._layout.notes, *splats.notes])
        return replace(splats, notes=tuple(notes))

    def close(self) -> None:
        """Close all parts."""
        for part in self._parts:
            part.close()


def joined_layout(parts: Sequence[Source]) -> Layout:
    """The columns that parts of one scene are brought to.

    Raises:
        OptionError: There is no part.
        ModelError: They are for different renderers.
    """
    if not parts:
        raise OptionError("Give at least one file.")
    layouts = [part.columns for part in parts]
    modes = {layout.render_mode for layout in layouts}
    if len(modes) > 1:
        raise ModelError(
            "The inputs are for different renderers "
            f"({', '.join(sorted(map(str, modes)))}) and make no one scene; simplify them apart."
        )
    columns = [dict(layout.extras) for layout in layouts]
    shared = {
        name: kind
        for name, kind in columns[0].items()
        if all(each.get(name) == kind for each in columns)
    }
    left = sorted({name for each in columns for name in each} - set(shared))
    notes = [f"Extra columns that not all inputs have are left out: {', '.join(left)}."] * any(left)
    if len({layout.sh_degree for layout in layouts}) > 1:
        notes.append("The inputs' SH degrees differ: coefficients that one lacks are 0.")
    if any(rows for part in parts for _, rows in part.elements):
        notes.append("Further elements of the inputs are left out: blocks hold splats alone.")
    return Layout(
        sh_degree=max(layout.sh_degree for layout in layouts),
        double_means=any(layout.double_means for layout in layouts),
        extras=tuple(shared.items()),
        render_mode=layouts[0].render_mode,
        comments=layouts[0].comments,
        notes=tuple(notes),
    )


def fitted(splats: Splats, layout: Layout) -> Splats:
    """The splats with the columns and comments of a layout, without elements."""
    means = splats.means.astype(np.float64) if layout.double_means else splats.means
    cut = splats.with_sh_degree(layout.sh_degree)
    return Splats(
        means=means,
        log_scales=splats.log_scales,
        quats=splats.quats,
        opacity_logits=splats.opacity_logits,
        sh=padded(cut.sh, (layout.sh_degree + 1) ** 2),
        extras={name: splats.extras[name].astype(kind) for name, kind in layout.extras},
        render_mode=RenderMode(layout.render_mode),
        comments=layout.comments,
        notes=splats.notes,
    )


def joined_rows(parts: Sequence[Splats]) -> Splats:
    """Rows of one model that were read apart, and what was said of them."""
    if len(parts) == 1:
        return parts[0]
    return replace(concatenate(parts), notes=join_findings(part.notes for part in parts))


class _Changed(Source):
    """A source whose rows are changed when they are read."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self.name = source.name

    @property
    def count(self) -> int:
        """Number of splats."""
        return self._source.count

    @property
    def columns(self) -> Layout:
        """The columns; see `Source`."""
        return self._source.columns

    @property
    def elements(self) -> tuple[tuple[str, int], ...]:
        """The elements of the source; see `Source`."""
        return self._source.elements

    def read_elements(self) -> tuple[ExtraElement, ...]:
        """The elements of the source; see `Source`."""
        return self._source.read_elements()

    def close(self) -> None:
        """Close the source."""
        self._source.close()


class Turned(_Changed):
    """A model in another frame; see `nanogs.frames`.

    Args:
        source: The model.
        before: The frame it is in, such as "rub".
        after: The frame it is to be in.

    Raises:
        OptionError: One of them is no frame.
    """

    def __init__(self, source: Source, before: str, after: str) -> None:
        change_between(before, after)
        super().__init__(source)
        self._turn: Callable[[Splats], Splats] = lambda rows: change_frame(rows, before, after)

    def read(self, start: int, stop: int) -> Splats:
        """Some rows; see `Source`."""
        return self._turn(self._source.read(start, stop))

    def load(self) -> Splats:
        """The whole model."""
        return self._turn(self._source.load())


class Reduced(_Changed):
    """A model without the bands of spherical harmonics above a degree.

    Args:
        source: The model.
        degree: The highest that may stay, 0 to 4.
    """

    def __init__(self, source: Source, degree: int) -> None:
        super().__init__(source)
        self._degree = degree

    @property
    def columns(self) -> Layout:
        """The columns that stay."""
        before = self._source.columns
        return replace(before, sh_degree=min(before.sh_degree, self._degree))

    def read(self, start: int, stop: int) -> Splats:
        """Some rows; see `Source`."""
        return self._source.read(start, stop).with_sh_degree(self._degree)

    def load(self) -> Splats:
        """The whole model."""
        return self._source.load().with_sh_degree(self._degree)


class Filtered(_Changed):
    """The splats of a model that several filters leave, each looking at what those before it left.

    What each page of rows keeps is counted in a first pass over the source, made when it is first
    needed; then pages are read as they are asked for, and filtered again.

    Args:
        source: The model.
        filters: What leaves out splats, such as `nanogs.filters.box(low, high)`.
        kept: What each page keeps, if it has been counted.

    Raises:
        OptionError: A filter has to see the whole model, which `nanogs.filters.apply` gives it.
    """

    def __init__(
        self, source: Source, filters: Sequence[Filter], kept: Sequence[int] | None = None
    ) -> None:
        super().__init__(source)
        refuse_whole(filters)
        self._filters, self._given = filters, kept
        self._last: tuple[int, Splats] | None = None

    @cached_property
    def _passed(self) -> np.ndarray[tuple[int, int], np.dtype[np.int64]]:
        """(P, F) rows of each page that are left after each filter.

        Raises:
            ModelError: None is left, or an element has one row a splat.
        """
        pages = []
        for page in self._source.blocks(PAGE_ROWS):
            left, counts = page, []
            for each in self._filters:
                left = left.take(each.keep(left))
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
        """What each page of `PAGE_ROWS` rows keeps.

        Raises:
            ModelError: None is left, or an element has one row a splat.
        """
        if self._given is None:
            self._given = tuple(self._passed[:, -1].tolist())
        return tuple(self._given)

    @property
    def reports(self) -> tuple[FilterReport, ...]:
        """What each filter takes."""
        left = [self._source.count, *self._passed.sum(axis=0).tolist()]
        return tuple(
            FilterReport(each.name, each.argument, before - after, after)
            for each, (before, after) in zip(self._filters, pairwise(left), strict=True)
        )

    @cached_property
    def _ends(self) -> I64:
        return np.concatenate(([0], np.cumsum(self.kept, dtype=np.int64)))

    @property
    def count(self) -> int:
        """Splats that are left."""
        return int(self._ends[-1])

    def read(self, start: int, stop: int) -> Splats:
        """Some rows; see `Source`."""
        first = int(np.searchsorted(self._ends, start, side="right")) - 1
        last = max(int(np.searchsorted(self._ends, stop, side="left")), first + 1)
        pages = [self._page(page) for page in range(first, min(last, len(self._ends) - 1))]
        rows = joined_rows(pages or [self._source.read(0, 0)])
        skipped = int(self._ends[first])
        return rows.take(slice(start - skipped, stop - skipped))

    def _page(self, number: int) -> Splats:
        if self._last is None or self._last[0] != number:
            at = number * PAGE_ROWS
            rows = self._source.read(at, min(at + PAGE_ROWS, self._source.count))
            for each in self._filters:
                rows = rows.take(each.keep(rows))
            self._last = number, rows
        return self._last[1]

    def close(self) -> None:
        """Let go of the last page, and close the source."""
        self._last = None
        super().close()

    def load(self) -> Splats:
        """The whole model that is left."""
        return apply(self._source.load(), self._filters)[0]
