"""Conversion of splats to the columns of a table, and back."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from nanogs._types import I64, Array
from nanogs.source import Layout
from nanogs.splats import COLUMNS, RenderMode, Splats, row_shapes
from nanogs.store.tables import Record, Sorted, Table

_EXTRA = "extra:"
CODES = "codes"


def columns_of(splats: Splats) -> dict[str, Array]:
    """Return every column of the splats by name."""
    own: dict[str, Array] = {name: getattr(splats, name) for name in COLUMNS}
    return own | {_EXTRA + name: column for name, column in splats.extras.items()}


def sorted_columns(splats: Splats, rows: I64) -> dict[str, Array | Sorted]:
    """Return the columns of some rows in the given order; rows are gathered when written."""
    return {name: Sorted(column, rows) for name, column in columns_of(splats).items()}


def row_bytes(layout: Layout) -> int:
    """Return the bytes of a splat in memory and in a table."""
    return sum(np.dtype(kind).itemsize for kind in _kinds(layout).values())


def _kinds(layout: Layout) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Return type and shape of a splat's entry in each column, by name."""
    kinds: dict[str, tuple[str, tuple[int, ...]]] = {
        name: ("<f8" if layout.double_means and name == "means" else "<f4", shape)
        for name, shape in row_shapes(layout.sh_degree).items()
    }
    return kinds | {_EXTRA + name: (kind, ()) for name, kind in layout.extras}


def empty_columns(layout: Layout, count: int) -> dict[str, Array]:
    """Allocate columns for `count` splats, uninitialised."""
    kinds = _kinds(layout).items()
    return {name: np.empty((count, *shape), kind) for name, (kind, shape) in kinds}


def no_splats(layout: Layout) -> Splats:
    """Return a model without splats that has the columns and properties of a layout."""
    return splats_of(empty_columns(layout, 0), layout)


def splats_of(columns: Mapping[str, Array], layout: Layout) -> Splats:
    """Make splats of columns, without copying them."""
    own: dict[str, Any] = {name: columns[name] for name in COLUMNS}
    extras = {name: columns[_EXTRA + name] for name, _ in layout.extras}
    return Splats(
        **own,
        extras=extras,
        render_mode=RenderMode(layout.render_mode),
        comments=layout.comments,
    )


def read_rows(table: Table, columns: Mapping[str, Array], at: int, rows: I64 | slice) -> None:
    """Fill columns from row `at` on with rows of a table: a slice, or ascending row numbers."""
    for name, column in columns.items():
        if isinstance(rows, slice):
            table.read_into(name, rows.start, column[at : at + rows.stop - rows.start])
        else:
            table.take_into(name, rows, column[at : at + len(rows)])


def count_of(record: Record) -> int:
    """Return the number of rows of a table of splats."""
    return record.columns["means"].shape[0]
