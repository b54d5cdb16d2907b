"""Results of any count of a scene in blocks; a resumed run reuses their stored measurements."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self

from nanogs.errors import OutputError
from nanogs.pipeline.estimates.durations import result_stages
from nanogs.pipeline.options.settings import Settings
from nanogs.pipeline.run import Run, is_done
from nanogs.pipeline.scene import Task
from nanogs.pipeline.search.results import M, Results
from nanogs.pipeline.stages import level_stages
from nanogs.pipeline.work import Work
from nanogs.progress import Stage, Tracker

MEASURED, COUNT, VALUE = "measured", "count", "value"  # names in the job's tables


class Rounding(NamedTuple):
    """Rounding by rate and distortion: the format's options, and the coarseness."""

    options: Mapping[str, Any]
    coarseness: float


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """A result of a job in blocks, stored in the job's files.

    Attributes:
        work: The job, with the settings of this result.
        level: Number of the level that is this result.
        rounding: How its values are rounded before it is written; None if to the nearest.
    """

    work: Work
    level: int
    rounding: Rounding | None = None


@dataclass(slots=True, eq=False)
class _Tried:
    """The counts tried so far, the result kept as the best, and the results that have files."""

    counts: tuple[int, ...] = ()
    kept: Result | None = None
    made: list[Result] = field(default_factory=list)


@dataclass(frozen=True, slots=True, eq=False)
class JobResults(Results[Result]):
    """Results of a scene in blocks.

    Each result is a further level of the job. Files of at most two results are kept: of the latest,
    and of the best so far. A resumed run repeats the search from the start, which tries the same
    counts; it reuses the stored measurements, and need not make these results again.

    Attributes:
        work: The job, which has no levels yet; the stages that all results share are done.
        run: Runs its tasks.
        settings: Settings of the results.
        tried: The results so far.
    """

    work: Work
    run: Run
    settings: Settings
    tried: _Tried = field(default_factory=_Tried)

    @property
    def available(self) -> int:
        """Number of splats of the whole scene; see `Results`."""
        return self.work.partition.splats

    @property
    def fewest(self) -> int:
        """One: if blocks cannot be merged as far as asked, the rest is merged in memory."""
        return 1

    @property
    def looks(self) -> bool:
        """Whether a result takes rendering; see `Results`."""
        return self.work.looks

    @property
    def fits(self) -> bool:
        """Whether results are fitted; see `Results.fits`."""
        return self.looks and self.settings.parameters.steps > 0

    def changed(self, change: Callable[[Settings], Settings]) -> Self:
        """Return results with other settings; see `Results.changed`."""
        return replace(self, settings=change(self.settings))

    def stages(self, count: int) -> list[Stage]:
        """List the stages of one result."""
        return result_stages(self.settings, count)

    def make(self, count: int, progress: Tracker) -> Result:
        """Make the result of a count."""
        result = self._next(count)
        self._do(result, progress)
        return result

    def make_and_measure(
        self, count: int, measure: Callable[[Result], M], progress: Tracker
    ) -> tuple[Result, M]:
        """Make and measure the result of a count, or reuse its stored measurement.

        Raises:
            OutputError: The stored measurement is of another count: of another search.
        """
        result = self._next(count)
        work, task = result.work, Task(MEASURED, 0, result.level)
        if self.run.resumed and is_done(work, task):
            facts = work.record(task).facts
            if facts[COUNT] != count:
                raise OutputError(
                    f"{work.scratch.label} belongs to another search, which tried"
                    f" {facts[COUNT]:,} splats and not {count:,}; remove the job's folder."
                )
            self.tried.made.append(result)
            return result, facts[VALUE]
        self._do(result, progress)
        found = measure(result)
        work.write(task.name, {}, {COUNT: count, VALUE: found})
        return result, found

    def keep(self, result: Result) -> None:
        """Keep the files of this result; those of the one kept before may be deleted."""
        self.tried.kept = result

    def verify(self, result: Result, progress: Tracker) -> None:
        """Make damaged or missing files of a result again, if an earlier run made them."""
        if self.run.resumed:
            self._do(result, progress)

    def _next(self, count: int) -> Result:
        for made in self.tried.made:
            if made is not self.tried.kept:
                _discard(made)
        self.tried.made = [made for made in self.tried.made if made is self.tried.kept]
        self.tried.counts += (count,)
        settings = replace(self.settings, counts=self.tried.counts)
        return Result(replace(self.work, settings=settings), len(self.tried.counts) - 1)

    def _do(self, result: Result, progress: Tracker) -> None:
        stages = level_stages(result.work.settings, result.level)
        self.run.do(result.work, stages, progress)
        self.tried.made.append(result)


def _discard(result: Result) -> None:
    """Delete the files of a result that exist."""
    work, level = result.work, result.level
    stages = [stage for stage, _ in level_stages(work.settings, level)]
    work.scratch.discard(tuple(f"{stage.name}-{level}-" for stage in stages))
