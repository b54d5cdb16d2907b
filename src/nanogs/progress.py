"""Progress reporting: the library emits steps, and the caller decides how to display them.

A call knows its stages when it begins, and roughly the relative duration of each. So the reported
fraction of the whole grows evenly, never falls, and is 1 only when all is done.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple, TypeVar

from nanogs.errors import OptionError

T = TypeVar("T")
WAITING = "wait"  # reported in place of a stage while a cluster has no worker
_ALMOST = 0.999  # largest fraction that is reported before the end


@dataclass(frozen=True, slots=True)
class Step:
    """The state of a call's progress.

    Attributes:
        stage: Name of the stage, such as "choose".
        number: Number of the stage, from 1.
        stages: Number of stages; some may be skipped.
        done: Number of parts of the stage that are done; fractional if a part reports its own
            progress.
        parts: Number of parts of the stage, 1 or more.
        fraction: Fraction of the whole call that is done, in [0, 1]. It never falls, and is 1 only
            in the last step, which is reported when all is done.
    """

    stage: str
    number: int
    stages: int
    done: float
    parts: int
    fraction: float


Progress = Callable[[Step], None]
"""Callback for each step, called in the thread that called the library; if it raises, the call
ends with that exception."""
PartProgress = Callable[[float, int], None]
"""Callback within a stage: the number of parts that are done, and the number of all parts."""


class Stage(NamedTuple):
    """A planned stage, and its duration relative to the others, in any unit."""

    name: str
    weight: float


class Tracker:
    """Turns the progress of a call's stages into steps for the callback."""

    def __init__(self, on_step: Progress | None, stages: Sequence[Stage]) -> None:
        """Start before the first stage.

        Args:
            on_step: Callback for each step, or None.
            stages: All stages that may come, in their order.

        Raises:
            OptionError: The callback is not a function.
        """
        if on_step and not callable(on_step):
            raise OptionError(f"`progress` must be a function or None, not {on_step!r}.")
        self._on_step = on_step or _ignore
        self._names = [stage.name for stage in stages] or [""]
        total = sum(stage.weight for stage in stages) or 1.0
        self._shares = [stage.weight / total for stage in stages] or [1.0]
        self._starts = [0.0, *accumulate(self._shares)]
        self._now, self._name = 0, self._names[0]
        self._fraction = 0.0

    def begin(self, name: str) -> None:
        """Begin the next stage of this name; the stages before it are skipped.

        A stage that was not planned is reported at the position of the one before it.
        """
        self._enter(name)
        self.part(0, 1)

    def part(self, done: float, parts: int) -> None:
        """Report the number of parts of the current stage that are done, and of all its parts."""
        share = min(max(done / parts, 0.0), 1.0) if parts else 1.0
        fraction = self._starts[self._now] + self._shares[self._now] * share
        self._fraction = max(self._fraction, min(fraction, _ALMOST))
        self._step(self._name, done, max(parts, 1))

    def within(self, done: int, parts: int, stages: Sequence[Stage]) -> "Tracker":
        """Make a tracker whose stages are, all together, one part of the current stage.

        Args:
            done: Number of parts done before; if more come than expected, the last is reported
                again.
            parts: Number of parts of the current stage.
            stages: Stages of the one part.
        """
        before = min(done, parts - 1)
        return Tracker(lambda step: self.part(before + step.fraction, parts), stages)

    def passing(self) -> Progress:
        """Return a callback for a nested call whose stages are the next ones of this tracker."""

        def on_step(step: Step) -> None:
            self._enter(step.stage)
            self.part(step.done, step.parts)

        return on_step

    def aside(self, name: str) -> None:
        """Report something that is not a stage, such as a wait; the fraction is unchanged."""
        self._step(name, 0, 1)

    def finish(self) -> None:
        """Report the last step: all is done."""
        self._now, self._fraction = len(self._names) - 1, 1.0
        self._step(self._names[-1], 1, 1)

    def _enter(self, name: str) -> None:
        ahead = self._now + (name != self._name)
        if name in self._names[ahead:]:
            self._now = self._names.index(name, ahead)
        self._name = name

    def _step(self, name: str, done: float, parts: int) -> None:
        self._on_step(Step(name, self._now + 1, len(self._names), done, parts, self._fraction))


def each(items: Iterable[T], on_progress: PartProgress) -> Iterator[T]:
    """Iterate over items, and report each as a part.

    Args:
        items: Items that take about the same time each.
        on_progress: Progress callback, called before each item and after the last.
    """
    known = list(items)
    for done, item in enumerate(known):
        on_progress(done, len(known))
        yield item
    on_progress(len(known), len(known))


def ignore_progress(_done: float, _parts: int) -> None:
    """Ignore the progress of parts: the default callback."""


def _ignore(_step: Step) -> None:
    pass
