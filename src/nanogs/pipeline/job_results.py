"""Results of any count of a scene in blocks; a resumed run finds their measurements again."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from nanogs.errors import OutputError
from nanogs.pipeline.foreseen import result_stages
from nanogs.pipeline.results import M
from nanogs.pipeline.run import Run, brief, is_done, plain
from nanogs.pipeline.scene import Task
from nanogs.pipeline.settings import Settings, Sharing
from nanogs.pipeline.stages import level_stages
from nanogs.pipeline.work import Work
from nanogs.progress import Stage, Tracker

MARKED, COUNT, MARK = "marked", "count", "mark"


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """A result of a job in blocks, in its files.

    Attributes:
        work: The job, as it was for this result.
        level: Of the result.
    """

    work: Work
    level: int


@dataclass(slots=True, eq=False)
class _Tried:
    """The counts that were tried, which result is kept of them, and which have files now."""

    counts: tuple[int, ...] = ()
    kept: Result | None = None
    made: list[Result] = field(default_factory=list)


@dataclass(frozen=True, slots=True, eq=False)
class JobResults:
    """Results of a scene in blocks; see `results.Results`.

    Each is a further level of the job. Files of two results at most are kept: of the latest, and of
    the best so far. A resumed run searches again from the start, which comes to the same counts; it
    takes measurements that are kept, and need not make these results again.

    Attributes:
        work: The job; what is done once is done.
        run: Does its tasks.
        settings: By which results are made.
        tried: The levels so far.
    """

    work: Work
    run: Run
    settings: Settings
    tried: _Tried

    @classmethod
    def of(cls, work: Work, run: Run) -> "JobResults":
        """Results of a job of which no level has been made."""
        return cls(work, run, work.settings, _Tried())

    @property
    def available(self) -> int:
        """As `Results` says."""
        return self.work.partition.splats

    @property
    def fewest(self) -> int:
        """One: below what blocks can be merged to, the rest is done in memory."""
        return 1

    @property
    def looks(self) -> bool:
        """As `Results` says."""
        return self.work.looks

    def plain(self, rounds: int | None = None) -> "JobResults":
        """As `Results` says."""
        return replace(self, settings=plain(self.settings, rounds))

    def brief(self) -> "JobResults":
        """As `Results` says."""
        return replace(self, settings=brief(self.settings))

    def packed(self, sh_degree: int, sharing: Sharing | None) -> "JobResults":
        """As `Results` says."""
        return replace(self, settings=replace(self.settings, sh_degree=sh_degree, sharing=sharing))

    def stages(self, count: int) -> list[Stage]:
        """As `Results` says."""
        return result_stages(self.settings, count)

    def make(self, count: int, progress: Tracker) -> Result:
        """As `Results` says."""
        result = self._next(count)
        self._do(result, progress)
        return result

    def marked(
        self, count: int, mark: Callable[[Result], M], progress: Tracker
    ) -> tuple[Result, M]:
        """As `Results` says.

        Raises:
            OutputError: The job has made another search.
        """
        result = self._next(count)
        work, task = result.work, Task(MARKED, 0, result.level)
        if self.run.resumed and is_done(work, task):
            facts = work.record(task).facts
            if facts[COUNT] != count:
                raise OutputError(
                    f"{work.scratch.place} is of another search, which tried {facts[COUNT]:,}"
                    f" splats and not {count:,}; remove the job's folder."
                )
            self.tried.made.append(result)
            return result, facts[MARK]
        self._do(result, progress)
        found = mark(result)
        work.write(task.name, {}, {COUNT: count, MARK: found})
        return result, found

    def keep(self, result: Result) -> None:
        """As `Results` says."""
        self.tried.kept = result

    def verify(self, result: Result, progress: Tracker) -> None:
        """Make files of a result again that are damaged or missing, if a run before made them."""
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
    """Delete the files of a result, as far as they are there."""
    work, level = result.work, result.level
    stages = [stage for stage, _ in level_stages(work.settings, level)]
    work.scratch.discard(tuple(f"{stage.name}-{level}-" for stage in stages))
