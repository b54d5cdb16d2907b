"""Display of a run's progress: a bar on a terminal, numbered lines elsewhere."""

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cache

from rich.console import RenderableType
from rich.progress import BarColumn, Progress, ProgressColumn, Task
from rich.text import Text

from nanogs.cli.console import err, warn
from nanogs.formatting import time_text
from nanogs.kernels.compiling import remark, unsaved, watching
from nanogs.progress import WAITING, Step

PATIENCE = 2.0  # seconds before anything is shown; shorter runs need no progress
EVERY = 30.0  # seconds between lines within a stage, if there is no terminal
_TICK = 0.25  # seconds between checks whether a line is due
_SURE = 0.02  # fraction of the run from which the time left is estimated


@dataclass(slots=True)
class Watch:
    """The state of a run; called with each step, it is a progress callback of the library.

    Attributes:
        quiet: Whether to print nothing.
        step: The latest step; its fraction is that of the whole run.
        file: Text like "file 2 of 5", or empty.
        compiling: Whether kernels are being compiled now.
        changed: Called when the state has changed.
    """

    quiet: bool = False
    step: Step | None = None
    file: str = ""
    compiling: bool = False
    _start: float = field(default_factory=time.monotonic)
    _told: float = 0.0  # time of the latest step
    _before: float = 0.0  # seconds of compiling until that time
    _compiled: float = 0.0  # seconds of compiling until now
    _since: float = 0.0  # start of the current compilation
    _waiting: bool = False
    changed: Callable[[], None] = lambda: None

    def __call__(self, step: Step) -> None:
        """Record a step."""
        if step.stage == WAITING and not (self.quiet or self._waiting):
            warn("The cluster has no worker; waiting for one.")
        self._waiting = step.stage == WAITING
        self.step, self._told, self._before = step, time.monotonic(), self._compiled
        self.changed()

    def of_file(self, number: int, files: int) -> "Callable[[Step], None]":
        """Return a progress callback for one of several files.

        Args:
            number: Number of the file, from 1.
            files: Number of files.
        """
        if files == 1:
            return self

        def on_step(step: Step) -> None:
            self.file = f"file {number} of {files}"
            self(replace(step, fraction=(number - 1 + step.fraction) / files))

        return on_step

    def note_compiling(self, begun: bool) -> None:
        """Record that compiling has begun or ended."""
        now = time.monotonic()
        if begun:
            self._since = now
        else:
            self._compiled += now - self._since
        self.compiling = begun
        self.changed()

    @property
    def seconds(self) -> float:
        """Seconds since the run began."""
        return time.monotonic() - self._start

    def left(self) -> float | None:
        """Estimate the seconds left from the speed so far, without compiling; None if unknown."""
        if self.step is None or self.step.fraction < _SURE or self.compiling:
            return None
        fraction = self.step.fraction
        worked = self._told - self._start - self._before
        since = time.monotonic() - self._told - (self._compiled - self._before)
        return max(worked * (1 - fraction) / fraction - since, 0.0)

    def stage(self) -> str:
        """Return the stage with its number, such as "2/5 choose"."""
        if self.step is None:
            return "starting"
        of_files = f"{self.file}: " if self.file else ""
        return f"{of_files}{self.step.number}/{self.step.stages} {self.step.stage}"

    def what(self) -> str:
        """Return the stage, with a remark if kernels are being compiled."""
        return f"{self.stage()}, {remark()}" if self.compiling else self.stage()

    def how_far(self) -> str:
        """Return the per cent of the run that is done, and the time left if known."""
        left = self.left()
        percent = f"{int(100 * self.step.fraction) if self.step else 0} %"
        return percent if left is None else f"{percent}, {time_text(max(left, 1.0))} left"


@contextmanager
def shown(*, quiet: bool) -> Iterator[Watch]:
    """Show the progress of a run in a context manager, once it has taken two seconds.

    Args:
        quiet: Show nothing.

    Yields:
        The progress callback.
    """
    watch = Watch(quiet)
    display: AbstractContextManager[object] = nullcontext()
    if not quiet:
        display = _Bar(watch) if err.is_terminal else _Lines(watch)
    with watching(watch.note_compiling), display:
        yield watch
    if unsaved() and not quiet:
        _warn_once(unsaved())


@cache
def _warn_once(message: str) -> None:
    warn(message)


class _Words(ProgressColumn):
    """A column of text beside the bar."""

    def __init__(self, words: Callable[[], str]) -> None:
        super().__init__()
        self._words = words

    def render(self, _task: Task) -> Text:
        return Text(self._words())


class _Bar(Progress):
    """One bar for the whole run, on a terminal."""

    def __init__(self, watch: Watch) -> None:
        self._watch = watch
        columns = (_Words(watch.what), BarColumn(), _Words(watch.how_far))
        super().__init__(*columns, console=err, transient=True)
        self._task = self.add_task("", total=1.0)
        watch.changed = self._update

    def get_renderables(self) -> Iterable[RenderableType]:
        if self._watch.seconds >= PATIENCE:
            yield from super().get_renderables()

    def _update(self) -> None:
        if self._watch.step:
            self.update(self._task, completed=self._watch.step.fraction)


class _Lines:
    """A line for each stage and every half minute, for output that is not a terminal."""

    def __init__(self, watch: Watch) -> None:
        self._watch = watch
        self._done = threading.Event()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._said, self._when = "", 0.0  # stage and time of the latest line
        self._compiled = False

    def __enter__(self) -> None:
        self._watch.changed = self._look
        self._thread.start()

    def __exit__(self, *_exception: object) -> None:
        self._done.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._done.wait(_TICK):
            self._look()

    def _look(self) -> None:
        """Print a line if one is due."""
        with self._lock:
            waits = self._watch.step is None and not self._watch.compiling
            if waits or self._watch.seconds < PATIENCE or self._done.is_set():
                return
            stage, now = self._watch.stage(), time.monotonic()
            compiling = self._watch.compiling and not self._compiled
            if stage == self._said and not compiling and now - self._when < EVERY:
                return
            text = f"{stage}: {self._watch.how_far()}" if stage == self._said else stage
            self._compiled |= compiling
            self._said, self._when = stage, now
            text = self._watch.what() if compiling else text
            err.print(text, markup=False, soft_wrap=True)
