"""Progress bars, on a terminal only."""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

from rich.console import RenderableType
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
)

from nanogs.cli.console import err
from nanogs.kernels.compiling import when_compiling

COMPILING = "Compiling for this processor: once after an installation, up to half a minute."


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
