"""How far a call has come: the library tells it in steps, and whoever called draws them.

A call knows its stages when it begins, and about how long each takes beside the others. So the
fraction of the whole that it tells moves evenly, never falls, and is 1 only when all is done.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple, TypeVar

T = TypeVar("T")
WAITING = "wait"  # told in place of a stage while a cluster has no worker
_ALMOST = 0.999  # the most that is told before the end


@dataclass(frozen=True, slots=True)
class Step:
    """Where a call is.

    Attributes:
        stage: Name of the stage, such as "choose".
        number: Of the stage, from 1.
        stages: How many there are; some may be passed over.
        done: Parts of the stage that are done; not whole where a part tells how far it is.
        parts: Of the stage, 1 or more.
        fraction: Of the whole call that is done, in [0, 1]. It never falls, and is 1 in the last
            step alone, which is told when all is done.
    """

    stage: str
    number: int
    stages: int
    done: float
    parts: int
    fraction: float


Progress = Callable[[Step], None]
"""Called with each step, in the thread that called the library. What it raises ends the call."""
Parts = Callable[[float, int], None]
"""Called within a stage: how many parts are done, and of how many."""


class Stage(NamedTuple):
    """A stage to come, and how long it takes beside the others, in any unit."""

    name: str
    weight: float


class Tracker:
    """Makes steps of what the stages of a call report."""

    def __init__(self, tell: Progress | None, stages: Sequence[Stage]) -> None:
        """Begin before the first stage.

        Args:
            tell: Called with each step, or None.
            stages: All that may come, in their order.
        """
        self._tell = tell or _ignore
        self._names = [stage.name for stage in stages] or [""]
        total = sum(stage.weight for stage in stages) or 1.0
        self._shares = [stage.weight / total for stage in stages] or [1.0]
        self._starts = [0.0, *accumulate(self._shares)]
        self._now, self._name = 0, self._names[0]
        self._fraction = 0.0

    def begin(self, name: str) -> None:
        """Begin the next stage of a name; those before it are passed over.

        One that was not foreseen is told where the one before it is.
        """
        self._enter(name)
        self.part(0, 1)

    def part(self, done: float, parts: int) -> None:
        """Tell how many parts of the present stage are done, and of how many."""
        share = min(max(done / parts, 0.0), 1.0) if parts else 1.0
        fraction = self._starts[self._now] + self._shares[self._now] * share
        self._fraction = max(self._fraction, min(fraction, _ALMOST))
        self._step(self._name, done, max(parts, 1))

    def within(self, done: int, parts: int, stages: Sequence[Stage]) -> "Tracker":
        """A tracker of stages that are, all together, one part of the present stage.

        Args:
            done: Parts done before; where more come than were expected, the last is told again.
            parts: Of the present stage.
            stages: Of the one part.
        """
        before = min(done, parts - 1)
        return Tracker(lambda step: self.part(before + step.fraction, parts), stages)

    def passing(self) -> Progress:
        """A function for a call whose stages are the next ones here."""

        def told(step: Step) -> None:
            self._enter(step.stage)
            self.part(step.done, step.parts)

        return told

    def aside(self, name: str) -> None:
        """Tell something that is no stage, such as a wait; the fraction stays."""
        self._step(name, 0, 1)

    def finish(self) -> None:
        """Tell the last step: all is done."""
        self._now, self._fraction = len(self._names) - 1, 1.0
        self._step(self._names[-1], 1, 1)

    def _enter(self, name: str) -> None:
        ahead = self._now + (name != self._name)
        if name in self._names[ahead:]:
            self._now = self._names.index(name, ahead)
        self._name = name

    def _step(self, name: str, done: float, parts: int) -> None:
        self._tell(Step(name, self._now + 1, len(self._names), done, parts, self._fraction))


def each(items: Iterable[T], tell: Parts) -> Iterator[T]:
    """The items one after the other, each told as a part.

    Args:
        items: What takes about the same time each.
        tell: Told before each item, and after the last, how many are done.
    """
    known = list(items)
    for done, item in enumerate(known):
        tell(done, len(known))
        yield item
    tell(len(known), len(known))


def untold(_done: float, _parts: int) -> None:
    """Tell nobody of parts."""


def _ignore(_step: Step) -> None:
    pass
