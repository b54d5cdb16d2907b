"""The interface of a source: a model that is read some rows at a time."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Self

import numpy as np

from nanogs._types import I64
from nanogs.errors import ModelError, OptionError
from nanogs.findings import join_findings
from nanogs.formatting import counted
from nanogs.ranges import is_number
from nanogs.slices import BLOCK_ROWS
from nanogs.splats import ExtraElement, Splats, concatenate

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

PAGE_ROWS = 1 << 13  # rows for each count of a filter, and that `take` reads at a time


@dataclass(frozen=True, slots=True)
class Layout:
    """The columns of a model, and its other properties that do not depend on the row.

    Attributes:
        sh_degree: Degree of the spherical harmonics, 0 to 4.
        double_means: Whether the centres are in double precision.
        extras: Name and dtype of the extra columns.
        render_mode: The rasteriser that the model was trained for.
        comments: Comment lines.
        notes: What is left out of the whole model, one sentence each.
    """

    sh_degree: int
    double_means: bool
    extras: tuple[tuple[str, str], ...]
    render_mode: str
    comments: tuple[str, ...]
    notes: tuple[str, ...] = ()

    def bare(self) -> "Layout":
        """Return the layout without higher harmonics and extra columns."""
        return replace(self, sh_degree=0, extras=())

    def reduced(self, sh_degree: int | None) -> "Layout":
        """Return the layout with harmonics of a degree at most, or None for all."""
        if sh_degree is None or sh_degree >= self.sh_degree:
            return self
        return replace(self, sh_degree=sh_degree)


class Source(ABC):
    """A model that is read some rows at a time.

    `read(start, stop)` and `take(rows)` return splats with the columns of `columns`, bit for bit as
    in the whole model, with notes about those rows; further PLY elements have no rows there, which
    `read_elements` gives. A source that holds files open or temporary ones is closed by `close`, or
    at the end of a `with` block. Threads may read from a source of a file at once.

    Attributes:
        name: Its name in messages.
        elements: Name and number of rows of each further PLY element.
    """

    name: str = "the model"
    elements: tuple[tuple[str, int], ...] = ()

    @cached_property
    def count(self) -> int:
        """Number of splats."""
        raise NotImplementedError

    @cached_property
    def columns(self) -> Layout:
        """The columns, known without reading any row."""
        raise NotImplementedError

    def read(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop`.

        Args:
            start: The first row, from 0.
            stop: The row after the last, from `start` to `count`.

        Raises:
            OptionError: There are no such rows.
            FormatError: They cannot be read, or are damaged.
        """
        whole = is_number(start, whole=True) and is_number(stop, whole=True)
        if not (whole and 0 <= start <= stop <= self.count):
            raise self._lacking(f"no rows {start} to {stop}")
        return self._span(start, stop)

    @abstractmethod
    def _span(self, start: int, stop: int) -> Splats:
        """Read rows as `read` does, after it has checked that they exist."""

    def take(self, rows: "ArrayLike") -> Splats:
        """Read rows by number, in any order; those far apart are read one page at a time.

        Args:
            rows: (M,) integers, each from 0 and below `count`.

        Raises:
            OptionError: They are no integers, or there are no such rows.
            FormatError: They cannot be read, or are damaged.
        """
        rows = np.asarray(rows)
        if not rows.size:
            return self.read(0, 0)
        if rows.ndim != 1 or rows.dtype.kind not in "iu":
            raise OptionError(
                "`take` needs row numbers; np.flatnonzero(mask) makes them from a mask."
            )
        if len(beyond := rows[(rows < 0) | (rows >= self.count)]):
            raise self._lacking(f"no row {beyond[0]}")
        return self._take(rows)

    def _take(self, rows: I64) -> Splats:
        """Read rows as `take` does, after it has checked that there is one and all exist."""
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

    def _lacking(self, what: str) -> OptionError:
        rows = counted(self.count, "row is", "rows are")
        return OptionError(f"{self.name} has {what}: its {rows} counted from 0.")

    def blocks(self, rows: int | None = None) -> Iterator[Splats]:
        """Yield all splats in order, `rows` at a time, by default `BLOCK_ROWS`.

        Raises:
            FormatError: As for `read`, possibly after some blocks.
            OptionError: `rows` is not a whole number of 1 or more.
        """
        step = BLOCK_ROWS if rows is None else rows
        if not is_number(step, whole=True) or step < 1:
            raise OptionError(f"Blocks have a whole number of rows, 1 or more, not {rows!r}.")
        starts = range(0, self.count, step)
        return (self.read(start, min(start + step, self.count)) for start in starts)

    def read_elements(self) -> tuple[ExtraElement, ...]:
        """Read the further PLY elements with their rows.

        Raises:
            FormatError: They cannot be read.
        """
        return ()

    def load(self) -> Splats:
        """Read the whole model.

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


def refuse_no_source(given: object) -> None:
    """Refuse an argument that is not a `Source`, such as a path or a model.

    Raises:
        ModelError: It is none.
    """
    if isinstance(given, Source):
        return
    kind, made = type(given).__name__, "nanogs.open makes one of a file"
    if isinstance(given, Splats):
        made = "nanogs.source.InMemory makes one of a model"
    raise ModelError(f"A source is needed, not {kind}; {made}.")


def joined_rows(parts: Sequence[Splats]) -> Splats:
    """Concatenate rows of one model that were read apart, and merge their notes."""
    if len(parts) == 1:
        return parts[0]
    return replace(concatenate(parts), notes=join_findings(part.notes for part in parts))


def span_of(part: Splats, start: int, stop: int) -> Splats:
    """Return rows of a part that is always read as a whole; its notes go with its first row.

    Where several reads share a part, such as a chunk of a file, its notes are counted once.

    Args:
        part: Splats, with notes about all of them.
        start: The first row, from 0.
        stop: The row after the last.
    """
    rows = part.span(start, stop)
    return rows if start == 0 < stop else replace(rows, notes=())
