"""The interface that makes results of any count for the searches, and that of a model in memory.

The one of a scene in blocks is in `job_results`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Generic, NamedTuple, Protocol, Self, TypeVar

from nanogs.clock import StageClock
from nanogs.io.format import Sharing
from nanogs.pipeline.estimates.durations import delivery_stages
from nanogs.pipeline.one_block import OneBlock
from nanogs.pipeline.options.settings import Settings, brief, plain
from nanogs.pipeline.outcome import Outcome
from nanogs.pipeline.run import deliver
from nanogs.progress import Stage, Tracker
from nanogs.report import StopReason

T = TypeVar("T")
"""A result: an `Outcome` in memory, a `job_results.Result` in blocks."""
M = TypeVar("M")
"""A measurement of a result."""
P = TypeVar("P")
"""The report of one count that was tried."""


class Results(Protocol[T]):
    """Makes results of any count, one at a time, of a scene whose forest has been grown."""

    @property
    def available(self) -> int:
        """Splats of the whole scene that are usable."""

    @property
    def fewest(self) -> int:
        """The smallest count that can be delivered."""

    @property
    def looks(self) -> bool:
        """Whether making a result includes rendering, which takes long.

        Quick results then lead the search.
        """

    @property
    def fits(self) -> bool:
        """Whether results are fitted, so that it is known how much their values show."""

    def changed(self, change: Callable[[Settings], Settings]) -> Self:
        """Return a maker of results with other settings.

        Args:
            change: Takes the settings, and returns those to use in their place.
        """

    def plain(self, rounds: int | None = None) -> Self:
        """Return a maker of results that are cut without rendering; see `settings.plain`."""
        return self.changed(lambda settings: plain(settings, rounds))

    def brief(self) -> Self:
        """Return a maker of results that are only compared; see `settings.brief`."""
        return self.changed(brief)

    def packed(self, sh_degree: int, sharing: Sharing | None) -> Self:
        """Return a maker of results for a packing: of an SH degree, with shared harmonics.

        Args:
            sh_degree: Highest degree of the harmonics, as far as the scene has them.
            sharing: How splats share higher harmonics, as entries of a palette, which the fit keeps
                to; None if each has its own.
        """
        return self.changed(lambda given: replace(given, sh_degree=sh_degree, sharing=sharing))

    def stages(self, count: int) -> list[Stage]:
        """Return the stages of making one result."""

    def make(self, count: int, progress: Tracker) -> T:
        """Make the result of a count."""

    def make_and_measure(
        self, count: int, measure: Callable[[T], M], progress: Tracker
    ) -> tuple[T, M]:
        """Make the result of a count, and measure it.

        Args:
            count: Number of splats.
            measure: Measures the result. It must depend on the result alone and return values that
                JSON can hold, because a resumed run reads them from its files.
            progress: Notified of each stage.
        """

    def keep(self, result: T) -> None:
        """Keep what is needed of this result; one that was kept before may be discarded."""

    def verify(self, result: T, progress: Tracker) -> None:
        """Make damaged or missing files of a result again, if an earlier run made them."""


@dataclass(frozen=True, slots=True)
class Found(Generic[P]):
    """The outcome of a search for a count.

    Attributes:
        count: The count.
        probes: The counts that were tried, in order, with what was measured.
        stop: Why the search ended.
    """

    count: int
    probes: tuple[P, ...]
    stop: StopReason


class Delivered(NamedTuple, Generic[T]):
    """The outcome of a search: the result that meets the target, and what is reported about it.

    Attributes:
        result: The result.
        fields: Fields of its report, by name.
        notes: Notes of its report, one sentence each.
    """

    result: T
    fields: dict[str, Any]
    notes: tuple[str, ...] = ()


@dataclass(slots=True, eq=False)
class Attempts(Generic[T, M]):
    """Makes the results of the counts that a search tries, measures each, and keeps the best.

    The best is the latest that meets what is asked, since searches come nearer and nearer. It is
    held while the next one is made, and no other is.

    Attributes:
        results: Makes results of the model.
        measure: Measures a result.
        meets: Whether a result with this measurement meets what is asked.
        measuring: Returns the stage of measuring for a count.
        expected: Number of results that the search makes, about.
        progress: Notified of each stage.
        best: The latest result that meets what is asked, or None.
    """

    results: Results[T]
    measure: Callable[[T], M]
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

        def measure(result: T) -> M:
            part.begin(measuring.name)
            return self.measure(result)

        result, found = self.results.make_and_measure(count, measure, part)
        if self.meets(found):
            self.results.keep(result)
            self.best = result
        return found

    def found(self) -> T:
        """Return the best result of a search that has ended with a count that it tried."""
        assert self.best is not None, "a count that was found meets the target"  # noqa: S101
        return self.best


@dataclass(frozen=True, slots=True, eq=False)
class HeldResults(Results[Outcome]):
    """Results of a model in memory.

    Attributes:
        scene: The model, rendered if its preset does so, and its forest.
        clock: Gets the seconds of each stage.
    """

    scene: OneBlock
    clock: StageClock

    @property
    def available(self) -> int:
        """Splats of the whole model that are usable."""
        return self.scene.forest.splats

    @property
    def fewest(self) -> int:
        """The smallest count that can be delivered."""
        return self.scene.forest.fewest

    @property
    def looks(self) -> bool:
        """Whether making a result includes rendering; see `Results.looks`."""
        return self.scene.looks

    @property
    def fits(self) -> bool:
        """Whether results are fitted; see `Results.fits`."""
        return self.looks and self.scene.settings.parameters.steps > 0

    def changed(self, change: Callable[[Settings], Settings]) -> Self:
        """Return a maker of results with other settings; see `Results.changed`."""
        scene = self.scene
        return replace(self, scene=replace(scene, settings=change(scene.settings)))

    def stages(self, count: int) -> list[Stage]:
        """Return the stages of making one result."""
        return delivery_stages(self.scene.settings.parameters, len(self.scene.usable), count)

    def make(self, count: int, progress: Tracker) -> Outcome:
        """Make the result of a count."""
        return deliver(self.scene, count, self.clock, progress)

    def make_and_measure(
        self, count: int, measure: Callable[[Outcome], M], progress: Tracker
    ) -> tuple[Outcome, M]:
        """Make the result of a count, and measure it; see `Results.make_and_measure`."""
        outcome = self.make(count, progress)
        return outcome, measure(outcome)

    def keep(self, result: Outcome) -> None:
        """Do nothing: the caller holds the result itself."""

    def verify(self, result: Outcome, progress: Tracker) -> None:
        """Do nothing: there are no files."""
