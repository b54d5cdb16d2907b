"""`progress=True`: a bar in a notebook or, on stderr, a terminal; nothing in pipes and files."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from nanogs.kernels.compiling import watching
from nanogs.progress import Progress, Step


@contextmanager
def drawn(progress: Progress | bool | None) -> Iterator[Progress | None]:
    """The function that a call tells its steps to, for as long as it runs.

    Args:
        progress: As the library's functions take it: True draws a bar, False and None nothing; a
            function is given back.
    """
    if not isinstance(progress, bool):
        yield progress
    elif not progress:
        yield None
    else:
        with _bar() as told:
            yield told


@contextmanager
def _bar() -> Iterator[Progress]:
    """One bar for the whole call; Rich knows how notebooks show one."""
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
        redirect_stdout=console.is_terminal,  # or cells would show what is printed as HTML
    )
    task = bar.add_task("starting", total=1.0)

    def told(step: Step) -> None:
        stage = f"{step.number}/{step.stages} {step.stage}"
        last = step.fraction == 1  # which Rich does not draw by itself in notebooks
        bar.update(task, completed=step.fraction, description=stage, refresh=last)

    with bar, watching(_sayer(lambda text: bar.update(task, description=text))):
        yield told


def _sayer(say: Callable[[str], None]) -> Callable[[bool], None]:
    """A line about kernels being compiled, which the next step overwrites."""

    def told(begun: bool) -> None:
        if begun:
            say("compiling for this processor; later runs find it on the disk")

    return told
