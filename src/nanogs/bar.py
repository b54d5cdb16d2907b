"""The bar of `progress=True`, in a notebook or, on stderr, a terminal; none in pipes and files."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from nanogs.kernels.compiling import remark, watching
from nanogs.progress import Progress, Step
from nanogs.ranges import as_switch


def wants_bar(progress: Progress | bool | None) -> bool:
    """Return whether the `progress` argument of the library's functions asks for a bar.

    Raises:
        OptionError: It is neither True, False nor None, and no function.
    """
    if progress is None or callable(progress):
        return False
    return as_switch("`progress`, unless it is a function or None,", progress)


@contextmanager
def show_progress(progress: Progress | bool | None) -> Iterator[Progress | None]:
    """Provide the progress callback of a call while it runs.

    Args:
        progress: The `progress` argument of the library's functions: True draws a bar, False and
            None nothing; a function is yielded unchanged.

    Raises:
        OptionError: It is none of these.
    """
    if not wants_bar(progress):
        yield progress if callable(progress) else None
        return
    with _bar() as on_step:
        yield on_step


@contextmanager
def _bar() -> Iterator[Progress]:
    """Draw one bar for the whole call with Rich, which also supports notebooks."""
    from rich import progress as rich
    from rich.console import Console

    console = Console(stderr=True)
    bar = rich.Progress(
        rich.TextColumn("{task.description}", markup=False),
        rich.BarColumn(),
        rich.TaskProgressColumn(),
        rich.TimeRemainingColumn(elapsed_when_finished=True),
        console=console,
        disable=not (console.is_terminal or console.is_jupyter),
        redirect_stdout=console.is_terminal,  # in notebooks it would turn printed text into HTML
    )
    task = bar.add_task("starting", total=1.0)

    def on_step(step: Step) -> None:
        stage = f"{step.number}/{step.stages} {step.stage}"
        last = step.fraction == 1  # Rich does not draw the last update by itself in notebooks
        bar.update(task, completed=step.fraction, description=stage, refresh=last)

    with bar, watching(_sayer(lambda text: bar.update(task, description=text))):
        yield on_step


def _sayer(say: Callable[[str], None]) -> Callable[[bool], None]:
    """Make a callback that shows when kernels are compiled; the next step overwrites the text."""

    def on_step(begun: bool) -> None:
        if begun:
            say(remark())

    return on_step
