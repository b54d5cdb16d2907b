"""How a run's progress is shown: a bar on a terminal, numbered lines elsewhere."""

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace

from rich.console import RenderableType
from rich.progress import BarColumn, Progress, ProgressColumn, Task
from rich.text import Text

from nanogs.cli.console import err, warn
from nanogs.formatting import time_text
from nanogs.kernels.compiling import watching
from nanogs.progress import WAITING, Step

PATIENCE = 2.0  # seconds before anything is shown: what is done by then needs no sign of life
EVERY = 30.0  # seconds between lines within a stage, where there is no terminal
_TICK = 0.25
_SURE = 0.02  # of the whole, before which the time left is anybody's guess
COMPILING = "compiling for this processor; later runs find it on the disk"


@dataclass(slots=True)
class Watch:
    """A run as it stands; takes its steps.

    Attributes:
        quiet: Whether nothing is to be said.
        step: The latest, its fraction that of the whole run.
        file: Such as "file 2 of 5", or empty.
        compiling: Whether kernels are being compiled just now.
    """

    quiet: bool = False
    step: Step | None = None
    file: str = ""
    compiling: bool = False
    _start: float = field(default_factory=time.monotonic)
    _told: float = 0.0  # when the latest step came
    _before: float = 0.0  # seconds until then that went into compiling
    _compiled: float = 0.0  # seconds until now that did
    _since: float = 0.0  # when compiling began
    _waiting: bool = False
    changed: Callable[[], None] = lambda: None

    def __call__(self, step: Step) -> None:
        """Take a step."""
        if step.stage == WAITING and not (self.quiet or self._waiting):
            warn("The cluster has no worker; waiting for one.")
        self._waiting = step.stage == WAITING
        self.step, self._told, self._before = step, time.monotonic(), self._compiled
        self.changed()

    def of_file(self, number: int, files: int) -> "Callable[[Step], None]":
        """A function that takes the steps of one of several files.

        Args:
            number: Of the file, from 1.
            files: How many there are.
        """
        if files == 1:
            return self

        def told(step: Step) -> None:
            self.file = f"file {number} of {files}"
            self(replace(step, fraction=(number - 1 + step.fraction) / files))

        return told

    def note_compiling(self, begun: bool) -> None:
        """Take note that compiling has begun or ended."""
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
        """Seconds that the rest will take, going by what was done; None where that is unknown."""
        if self.step is None or self.step.fraction < _SURE or self.compiling:
            return None
        fraction = self.step.fraction
        worked = self._told - self._start - self._before
        since = time.monotonic() - self._told - (self._compiled - self._before)
        return max(worked * (1 - fraction) / fraction - since, 0.0)

    def stage(self) -> str:
        """The stage, and which of how many it is."""
        if self.step is None:
            return "starting"
        of_files = f"{self.file}: " if self.file else ""
        return f"{of_files}{self.step.number}/{self.step.stages} {self.step.stage}"

    def what(self) -> str:
        """The stage, and whether it waits for kernels to be compiled."""
        return f"{self.stage()}, {COMPILING}" if self.compiling else self.stage()

    def how_far(self) -> str:
        """Per cent of the whole, and the time left where it is known."""
        left = self.left()
        percent = f"{int(100 * self.step.fraction) if self.step else 0} %"
        return percent if left is None else f"{percent}, {time_text(max(left, 1.0))} left"


@contextmanager
def shown(*, quiet: bool) -> Iterator[Watch]:
    """Show the steps of a run, once it has taken two seconds.

    Args:
        quiet: Show nothing.

    Yields:
        What is called with each step.
    """
    watch = Watch(quiet)
    display: AbstractContextManager[object] = nullcontext()
    if not quiet:
        display = _Bar(watch) if err.is_terminal else _Lines(watch)
    with watching(watch.note_compiling), display:
        yield watch


class _Words(ProgressColumn):
    """Words beside the bar."""

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
    """A line a stage and one each half minute, where there is no terminal."""

    def __init__(self, watch: Watch) -> None:
        self._watch = watch
        self._done = threading.Event()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._said, self._when = "", 0.0  # the stage of the latest line, and when it was written
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
        """Write a line if it is time for one."""
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
