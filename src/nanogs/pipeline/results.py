"""Results of any count, as the searches ask for them, of a model in memory; see `job_results`."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Generic, Protocol, Self, TypeVar

from nanogs.clock import StageClock
from nanogs.pipeline.foreseen import delivery_stages
from nanogs.pipeline.one_block import OneBlock
from nanogs.pipeline.outcome import Outcome
from nanogs.pipeline.run import brief, deliver, plain
from nanogs.pipeline.settings import Sharing
from nanogs.progress import Stage, Tracker

T = TypeVar("T")
M = TypeVar("M")


class Results(Protocol[T]):
    """Makes results of any count of a scene that has been looked at, one after the other."""

    @property
    def available(self) -> int:
        """Splats of the whole scene."""

    @property
    def fewest(self) -> int:
        """The smallest count that can be had."""

    @property
    def looks(self) -> bool:
        """Whether a result takes rendering and so a long time: quick ones then lead the search."""

    def plain(self, rounds: int | None = None) -> Self:
        """Results that are cut without looking; see `run.plain`."""

    def brief(self) -> Self:
        """Results that are fitted in few steps; see `run.brief`."""

    def packed(self, sh_degree: int, sharing: Sharing | None) -> Self:
        """Results with harmonics of a degree at most, fitted in sets as a palette holds them.

        Args:
            sh_degree: Of the harmonics, as far as the scene's are.
            sharing: How many sets of higher harmonics there are, or None where each splat has its
                own.
        """

    def stages(self, count: int) -> list[Stage]:
        """The stages of one result."""

    def make(self, count: int, progress: Tracker) -> T:
        """The result of a count."""

    def marked(self, count: int, mark: Callable[[T], M], progress: Tracker) -> tuple[T, M]:
        """Make the result of a count, and measure it.

        Args:
            count: Splats.
            mark: Measures the result. It depends on nothing else and returns values that JSON
                holds, so that a resumed run takes them from its files.
            progress: Told of each stage.
        """

    def keep(self, result: T) -> None:
        """Keep what is needed of this result; one that was kept before may be discarded."""


@dataclass(slots=True, eq=False)
class Attempts(Generic[T, M]):
    """Makes the results of the counts that a search tries, measures each, and keeps the best.

    The latest that meets what is asked is the best: searches come nearer and nearer. One is held at
    a time.

    Attributes:
        results: Of the model.
        mark: Measures a result.
        meets: Whether a result of such a mark is what is asked.
        measuring: The stage of measuring, by the count.
        expected: How many results the search makes, about.
        progress: Told of each stage.
        best: The latest that is what is asked, or None.
    """

    results: Results[T]
    mark: Callable[[T], M]
    meets: Callable[[M], bool]
    measuring: Callable[[int], Stage]
    expected: int
    progress: Tracker
    best: T | None = field(default=None, init=False)
    _tried: int = field(default=0, init=False)

    def __call__(self, count: int) -> M:
        """Make the result of a count, and measure it."""
        measuring = self.measuring(count)
        stages = [*self.results.stages(count), measuring]
        part = self.progress.within(self._tried, self.expected, stages)
        self._tried += 1

        def mark(result: T) -> M:
            part.begin(measuring.name)
            return self.mark(result)

        result, found = self.results.marked(count, mark, part)
        if self.meets(found):
            self.results.keep(result)
            self.best = result
        return found

    def found(self) -> T:
        """The best, of a search that has ended with a count that it tried."""
        assert self.best is not None, "the count that was found is one that meets the wish"  # noqa: S101
        return self.best


@dataclass(frozen=True, slots=True, eq=False)
class HeldResults:
    """Results of a model in memory; see `Results`.

    Attributes:
        scene: The model, looked at, and its forest.
        clock: Gets the seconds of each stage.
    """

    scene: OneBlock
    clock: StageClock

    @property
    def available(self) -> int:
        """As `Results` says."""
        return self.scene.forest.splats

    @property
    def fewest(self) -> int:
        """As `Results` says."""
        return self.scene.forest.fewest

    @property
    def looks(self) -> bool:
        """As `Results` says."""
        return self.scene.looks

    def plain(self, rounds: int | None = None) -> "HeldResults":
        """As `Results` says."""
        scene = self.scene
        return replace(self, scene=replace(scene, settings=plain(scene.settings, rounds)))

    def brief(self) -> "HeldResults":
        """As `Results` says."""
        return replace(self, scene=replace(self.scene, settings=brief(self.scene.settings)))

    def packed(self, sh_degree: int, sharing: Sharing | None) -> "HeldResults":
        """As `Results` says."""
        settings = replace(self.scene.settings, sh_degree=sh_degree, sharing=sharing)
        return replace(self, scene=replace(self.scene, settings=settings))

    def stages(self, count: int) -> list[Stage]:
        """As `Results` says."""
        return delivery_stages(self.scene.settings.parameters, len(self.scene.usable), count)

    def make(self, count: int, progress: Tracker) -> Outcome:
        """As `Results` says."""
        return deliver(self.scene, count, self.clock, progress)

    def marked(
        self, count: int, mark: Callable[[Outcome], M], progress: Tracker
    ) -> tuple[Outcome, M]:
        """As `Results` says."""
        outcome = self.make(count, progress)
        return outcome, mark(outcome)

    def keep(self, result: Outcome) -> None:
        """Do nothing: the caller holds the result itself."""
