"""How the command speaks: data on stdout, everything for people on stderr."""

import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, TextIO

from rich.console import Console
from rich.table import Table
from rich.text import Text

from nanogs.formatting import plain

if TYPE_CHECKING:
    from nanogs.clock import StageClock

_WIDE = 1000  # columns in a pipe, where nothing needs to be broken


def _console(*, stderr: bool) -> Console:
    """Colours and breaks at the terminal's width on a terminal only."""
    console = Console(stderr=stderr, highlight=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = _WIDE
    return console


_subject = ContextVar("subject", default="")
err = _console(stderr=True)
out = _console(stderr=False)


def fail(message: str) -> None:
    """Say what went wrong, in one line however narrow the terminal."""
    err.print("[bold red]error:[/]", end=" ")
    err.print(message, markup=False, soft_wrap=True)


@contextmanager
def notes_about(name: str) -> Iterator[None]:
    """Begin notes in the block with a name: that of one of several files."""
    before = _subject.set(name)
    try:
        yield
    finally:
        _subject.reset(before)


def warn(message: str) -> None:
    """Say what the user should know."""
    name = _subject.get()
    err.print("[yellow]note:[/]", end=" ")
    err.print(f"{name}: {message}" if name else message, markup=False, soft_wrap=True)


def say(message: str) -> None:
    """Say what became of a file, in one line."""
    name = _subject.get()
    err.print(f"{name}: {message}" if name else message, markup=False, soft_wrap=True)


def arrow() -> str:
    """The sign between before and after; plain where the terminal has few characters."""
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


def with_file_seconds(run: dict[str, Any], clock: "StageClock", start: float) -> dict[str, Any]:
    """A report with the seconds of reading and writing the files around it.

    Args:
        run: The report as a dictionary.
        clock: Holds the stages before, such as "read", and "write".
        start: `time.perf_counter()` at the start of the command.
    """
    around = clock.seconds
    after = {stage: around[stage] for stage in ("write", "measure") if stage in around}
    seconds = {stage: spent for stage, spent in around.items() if stage not in after}
    seconds |= run["seconds"] | after
    return run | {"seconds": seconds, "total_seconds": time.perf_counter() - start}


def key_value_table(rows: dict[str, str]) -> Table:
    """Two columns without lines: what it is, and its value."""
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="dim")
    table.add_column(overflow="fold")
    for name, value in rows.items():
        table.add_row(name, Text(value))  # a path may have brackets, which are no markup
    return table


def show(console: Console, table: Table) -> None:
    """Print a table; into a pipe without the blanks that fill its lines up."""
    if console.is_terminal:
        console.print(table)
        return
    with console.capture() as caught:
        console.print(table)
    console.file.writelines(f"{line.rstrip()}\n" for line in caught.get().splitlines())
