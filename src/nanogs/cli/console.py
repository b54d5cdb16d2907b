"""Output of the command: data on stdout, messages for people on stderr."""

import json
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import fields, is_dataclass
from typing import Any, TextIO

from rich.console import Console
from rich.segment import Segments
from rich.table import Table
from rich.text import Text

from nanogs.cli.wording import reworded
from nanogs.formatting import plain

_WIDE = 1000  # width in columns if the output is a pipe, so that lines are not wrapped


def _console(*, stderr: bool) -> Console:
    """Create a console that uses colours and wraps lines on a terminal only."""
    console = Console(stderr=stderr, highlight=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = _WIDE
    return console


_subject = ContextVar("subject", default="")
err = _console(stderr=True)
out = _console(stderr=False)


def fail(message: str) -> None:
    """Print an error on stderr, without wrapping the line."""
    err.print("[bold red]error:[/]", end=" ")
    err.print(message, markup=False, soft_wrap=True)


@contextmanager
def notes_about(name: str) -> Iterator[None]:
    """Prefix messages within the context by the name of one of several files."""
    before = _subject.set(name)
    try:
        yield
    finally:
        _subject.reset(before)


def warn(message: str) -> None:
    """Print a note on stderr, with options of the command in place of Python arguments."""
    name, message = _subject.get(), reworded(message)
    err.print("[yellow]note:[/]", end=" ")
    err.print(f"{name}: {message}" if name else message, markup=False, soft_wrap=True)


def say(message: str) -> None:
    """Print a result on stderr, in one line."""
    name = _subject.get()
    err.print(f"{name}: {message}" if name else message, markup=False, soft_wrap=True)


def arrow() -> str:
    """Return the arrow between old and new values: → or, if the encoding has none, ->."""
    try:
        "→".encode(err.encoding)
    except (LookupError, UnicodeEncodeError):
        return "->"
    return "→"


def print_json(data: dict[str, Any], file: TextIO | None = None) -> None:
    """Write one JSON object, to stdout by default; infinities, which JSON lacks, become strings."""
    stream = file or sys.stdout
    json.dump(plain(data), stream, indent=2, allow_nan=False)
    stream.write("\n")


def key_value_table(rows: dict[str, str]) -> Table:
    """Return a table of names and values, without lines."""
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="dim")
    table.add_column(overflow="fold")
    for name, value in rows.items():
        table.add_row(name, Text(value))  # Text, because brackets in a path would be markup
    return table


def show_report(report: Any, first: dict[str, str] | None = None) -> None:  # noqa: ANN401
    """Print all fields of a report, a dataclass, on stderr: one line each, and tables.

    A dataclass in a field is printed as its `text` if it has one, else as its fields. Several of a
    kind are printed as a table. Fields that are empty, zero or at their default are left out, and
    so are notes, which are printed elsewhere.

    Args:
        report: The report.
        first: Lines to print before the report's.
    """
    record = {
        field.name.replace("_", " "): value
        for field in fields(report)
        if (value := getattr(report, field.name)) and value != field.default
        if field.name != "notes"
    }
    tables = {name: value for name, value in record.items() if _is_table(value)}
    lines = {name: value_text(value) for name, value in record.items() if name not in tables}
    show(err, key_value_table((first or {}) | lines))
    for name, entries in tables.items():
        err.print(f"{name}:", markup=False)
        show(err, entry_table(entries))


def entry_table(entries: Sequence[Any]) -> Table:
    """Return a table of dataclasses of one type, with a column for each field."""
    names = [field.name for field in fields(entries[0])]
    table = Table(box=None, pad_edge=False)
    for name in names:
        table.add_column(name.replace("_", " "), justify="right")
    for entry in entries:
        # Text, because brackets in a name would be markup.
        table.add_row(*(Text(value_text(getattr(entry, name))) for name in names))
    return table


def _is_table(value: Any) -> bool:  # noqa: ANN401
    return isinstance(value, tuple) and is_dataclass(value[0])


def value_text(value: Any) -> str:  # noqa: ANN401 - whatever a report holds
    """Format a value of a report; of a tuple, only its length."""
    if is_dataclass(value):
        own = {field.name: getattr(value, field.name) for field in fields(value)}
        return getattr(value, "text", "") or value_text(own)
    if isinstance(value, dict):
        named = {key.replace("_", " "): value_text(each) for key, each in value.items()}
        return ", ".join(f"{name} {text}" for name, text in named.items())
    if isinstance(value, tuple):
        return str(len(value))
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.4g}" if isinstance(value, float) else "-" if value is None else str(value)


def show(console: Console, table: Table) -> None:
    """Print a table; without trailing blanks if the output is not a terminal.

    A table with a heading may be wider than the terminal: no number or name of it is cut off.
    """
    options = console.options
    if table.show_header:
        needed = console.measure(table, options=options.update(width=_WIDE)).maximum
        options = options.update(width=max(needed, console.width))
    rendered = Segments(list(console.render(table, options)))
    if console.is_terminal:
        console.print(rendered, crop=False, end="")
        return
    with console.capture() as caught:
        console.print(rendered, crop=False, end="")
    console.file.writelines(f"{line.rstrip()}\n" for line in caught.get().splitlines())
