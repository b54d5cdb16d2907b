"""How the command speaks: data on stdout, everything for people on stderr."""

import dataclasses
import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
)
from rich.table import Table
from rich.text import Text

from nanogs.kernels.compiling import when_compiling
from nanogs.report import StageClock

_WIDE = 1000  # columns in a pipe, where nothing needs to be broken


def _console(*, stderr: bool) -> Console:
    """Colours and breaks at the terminal's width on a terminal only."""
    console = Console(stderr=stderr, highlight=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = _WIDE
    return console


err = _console(stderr=True)
out = _console(stderr=False)

COMPILING = "Compiling for this processor: once after an installation, up to half a minute."


def fail(message: str) -> None:
    """Say what went wrong, in one line however narrow the terminal."""
    err.print("[bold red]error:[/]", end=" ")
    err.print(message, markup=False, soft_wrap=True)


def warn(message: str) -> None:
    """Say what the user should know."""
    err.print("[yellow]note:[/]", end=" ")
    err.print(message, markup=False, soft_wrap=True)


def print_json(data: dict[str, Any], file: TextIO | None = None) -> None:
    """Write one JSON object, to stdout by default; infinities, which JSON lacks, become strings."""
    stream = file or sys.stdout
    json.dump(_plain(data), stream, indent=2, allow_nan=False)
    stream.write("\n")


def _plain(value: Any) -> Any:  # noqa: ANN401 - whatever a report holds
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _plain(dataclasses.asdict(value))
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and (value != value or value in (float("inf"), -float("inf"))):
        return str(value)
    return value


def with_file_seconds(run: dict[str, Any], clock: StageClock, start: float) -> dict[str, Any]:
    """A report with the seconds of reading and writing the files around it.

    Args:
        run: The report as a dictionary.
        clock: Holds the stages before, such as "read", and "write".
        start: `time.perf_counter()` at the start of the command.
    """
    before = {stage: spent for stage, spent in clock.seconds.items() if stage != "write"}
    seconds = before | run["seconds"] | {"write": clock.seconds["write"]}
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


class _LateProgress(Progress):
    """Shows nothing until some seconds have passed."""

    appears: float = 0  # on the clock of `time.monotonic`

    def get_renderables(self) -> Iterable[RenderableType]:
        if time.monotonic() >= self.appears:
            yield from super().get_renderables()


@contextmanager
def _bar(*columns: ProgressColumn, quiet: bool, after: float = 0) -> Iterator[Progress]:
    """A bar on a terminal only; a line, there and elsewhere, if kernels have to be compiled."""
    shown = err.is_terminal and not quiet
    late = _LateProgress(*columns, console=err, transient=True, disable=not shown)
    late.appears = time.monotonic() + after
    with late as progress:
        if not quiet:
            when_compiling(lambda: err.print(COMPILING))
        yield progress


@contextmanager
def count_down(start: int, target: int, *, quiet: bool) -> Iterator[Callable[[str, int], None]]:
    """A progress bar from the input's count down to the target, on a terminal only.

    Yields:
        What the library calls with the stage's name and the number of splats left.
    """
    columns = (
        TextColumn("{task.description:<8}"),
        BarColumn(),
        TextColumn("{task.fields[left]:>12,} splats"),
        TimeElapsedColumn(),
    )
    with _bar(*columns, quiet=quiet) as progress:
        task = progress.add_task("read", total=max(start - target, 1), left=start)

        def update(stage: str, left: int) -> None:
            progress.update(task, description=stage, completed=start - left, left=left)

        yield update


@contextmanager
def spinner(*, quiet: bool, after: float = 0) -> Iterator[Callable[[str], None]]:
    """A turning line that says what is being done, on a terminal only.

    Args:
        quiet: Show nothing.
        after: Seconds before it appears: what is done by then needs no line.

    Yields:
        What is called with each new description.
    """
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with _bar(*columns, quiet=quiet, after=after) as progress:
        task = progress.add_task("")
        yield lambda text: progress.update(task, description=text)


@contextmanager
def stage_bar(*, quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """A progress bar that starts anew with each stage, on a terminal only.

    Yields:
        What the library calls with a stage's name, how many parts are done, and of how many.
    """
    columns = (TextColumn("{task.description:<8}"), BarColumn(), TimeElapsedColumn())
    with _bar(*columns, quiet=quiet) as progress:
        task = progress.add_task("read", total=1)

        def update(stage: str, done: int, total: int) -> None:
            progress.update(task, description=stage, completed=done, total=total)

        yield update
