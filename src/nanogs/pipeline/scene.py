"""The state of a scene as it passes through the stages: its blocks, and the results so far.

Each stage is written once, for a block of a scene. `one_block.OneBlock` is a model in memory;
`work.Work` is a scene in blocks, of which only files are kept.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple

from nanogs._types import F64, I32, I64, Array, Bool
from nanogs.fit.groups import ViewGroup
from nanogs.fit.report import RefitReport
from nanogs.fit.targets import Fitting, Target
from nanogs.io.rate_distortion import Curvatures
from nanogs.method.correct import Correction, Ordering
from nanogs.method.growth import Cover
from nanogs.method.store import Groups
from nanogs.method.visibility import MissedLight
from nanogs.pipeline.options.settings import Settings
from nanogs.pipeline.tasks.partition import Partition
from nanogs.pipeline.tasks.views import Views
from nanogs.progress import PartProgress
from nanogs.raster.camera import Camera
from nanogs.raster.light import SplatLight
from nanogs.raster.rendering import PreparedSplats
from nanogs.report import PassReport
from nanogs.splats import Splats
from nanogs.store.tables import Record

LIGHT = "light"  # fact of stage `look`: how much of a block each view shows
SUMS = "sums"  # fact of a correction: `Correction.sums`; zeros if nothing could be corrected
ROUNDS = "rounds"  # fact of reassignment: number of rounds in which splats moved


@dataclass(frozen=True, slots=True)
class Task:
    """One task of a job: a stage, for one block, segment or file, and one level.

    Attributes:
        stage: Name of the stage.
        number: Of the segment, block or unpacked file.
        level: Of the result.
    """

    stage: str
    number: int = 0
    level: int = 0

    @property
    def name(self) -> str:
        """Name of the table that the task writes."""
        return f"{self.stage}-{self.level}-{self.number:05d}"


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """The splats of a block.

    Attributes:
        splats: N of them.
        rows: (M,) integers, the usable rows in Morton order.
        visible: (N,) float64, the visibility of each splat, or None if nothing is rendered.
    """

    splats: Splats
    rows: I64 | I32
    visible: F64 | None


@dataclass(frozen=True, slots=True, eq=False)
class Members(Block):
    """The splats of a block's groups, some of which may come from other blocks.

    Attributes:
        labels: (M,) int32, the group of each row, in the order of `rows`.
        others: Groups of other blocks that may cover the sides of these, for growth; empty if
            growth does not depend on them.
    """

    labels: I32
    others: Sequence[Cover] = ()


@dataclass(frozen=True, slots=True, eq=False)
class FitViews:
    """The views to fit a block to.

    Attributes:
        fitting: Views of the original that are fitted to, kept as images or rendered when needed.
        deciding: Other views, which decide how much of the fit is kept.
        original_count: Number of splats of the original.
    """

    fitting: Fitting
    deciding: Sequence[ViewGroup]
    original_count: int


class ViewLight(NamedTuple):
    """A view, and how much of a block it shows: the block's contributions, in pixels of alpha 1."""

    camera: Camera
    light: float


class Look(NamedTuple):
    """The result of rendering a block from the views.

    Attributes:
        own: The block, with the visibility of its splats.
        missed: (N,) bool, the splats that lie in no view.
        lights: The views, and how much of the block each shows.
        missed_light: Estimate of how much of the block the views leave out.
    """

    own: Block
    missed: Bool
    lights: Sequence[ViewLight]
    missed_light: MissedLight


@dataclass(frozen=True, slots=True)
class Chosen:
    """The choice for a level: whether reassignment is kept, and how much splats may grow."""

    reassigned: bool
    growth: float


class Scene(ABC):
    """A scene as a stage sees it: the interface between stages and data.

    Attributes:
        settings: Settings of the job.
        threads: Number of threads in use.
        on_progress: Progress callback for the parts of the current task.
    """

    settings: Settings
    threads: int
    on_progress: PartProgress

    @abstractmethod
    def record(self, task: Task) -> Record:
        """Return the record that a task wrote."""

    @abstractmethod
    def write(self, name: str, columns: Mapping[str, Array], facts: Mapping[str, Any]) -> Record:
        """Keep the columns and facts that a task has found, under the name of its table."""

    @property
    @abstractmethod
    def partition(self) -> Partition:
        """The rows of each block."""

    @property
    @abstractmethod
    def views(self) -> Views:
        """The views of the whole scene."""

    @abstractmethod
    def target(self, level: int) -> int:
        """Return the number of splats that a result is to have."""

    @abstractmethod
    def merges(self, level: int) -> bool:
        """Whether a result has fewer splats than the scene."""

    @abstractmethod
    def find_units(self, name: str) -> Record:
        """Compute and keep the units (origin, scales, Morton box) that all blocks share."""

    @abstractmethod
    def sample(self) -> Splats:
        """Return splats spread over the scene, for placing cameras."""

    @abstractmethod
    def keep_views(self, name: str, views: Views) -> Record:
        """Keep the views that were chosen."""

    @abstractmethod
    def bare(self, block: int) -> Block:
        """Return the splats of a block for rendering visibility, which needs no colours."""

    @abstractmethod
    def occluders(self, block: int) -> PreparedSplats | None:
        """Return splats of other blocks that may occlude a block; None if there are none."""

    @abstractmethod
    def closer_views(self, own: Block) -> Sequence[Camera]:
        """Return additional views of a block that is small in every view of the scene."""

    @abstractmethod
    def draw(self, drawn: PreparedSplats, camera: Camera) -> SplatLight:
        """Render one of the views that visibility is measured on; return the light of splats."""

    @property
    def pictured(self) -> Sequence[Camera]:
        """Cameras only for the fit, if they are few enough that all their renders are kept.

        The renders of others are made when the fit needs them.
        """
        return ()

    def picture(self, drawn: PreparedSplats, camera: Camera) -> None:
        """Render the original from one of the `pictured` cameras and keep the image."""
        raise NotImplementedError

    @abstractmethod
    def keep_look(self, name: str, look: Look) -> Record:
        """Keep a block's visibility, how much of it each view shows, and what the views miss."""

    @abstractmethod
    def grow(self, name: str, block: int) -> Record:
        """Grow the merge forest of a block."""

    @abstractmethod
    def reassign(self, name: str, block: int, level: int) -> Record:
        """Reassign the splats of a block after the chosen cut."""

    @abstractmethod
    def open(self, block: int) -> Block:
        """Return the splats of a block, and their visibility if it is known."""

    @abstractmethod
    def cut(self, block: int, level: int, number: int) -> I32:
        """Return (M,) int32: the group of each leaf of a block in a cut.

        Args:
            block: Number of the block.
            level: Of the result.
            number: Of the cut: first those of `balances`, then those with corrected errors.
        """

    @abstractmethod
    def ordering(self, own: Block, block: int, level: int, number: int) -> Ordering:
        """Return the merges of a block's forest and their errors, as a cut is guided by them.

        Args:
            own: The block.
            block: Its number.
            level: Of the result.
            number: Of the cut: that of balance 1, or one with corrected errors.
        """

    @abstractmethod
    def keep_correction(self, task: Task, number: int, correction: Correction) -> Record:
        """Keep the corrected errors that a further cut of a block is guided by.

        Args:
            task: The task that has found them.
            number: Of the cut.
            correction: Of the block's merges.
        """

    @abstractmethod
    def correction_targets(
        self, block: int, own: Block, others: PreparedSplats | None
    ) -> Iterable[Target]:
        """Return the original on the views that errors are corrected by, those that do not decide.

        In a scene of several blocks, the parts that show a block.

        Args:
            block: Number of the block.
            own: The block.
            others: Its `surroundings`.
        """

    @abstractmethod
    def members(self, block: int, level: int, *, reassigned: bool) -> Members:
        """Return the splats and groups of a block: of the chosen cut, or after reassignment."""

    @abstractmethod
    def stored(self, members: Members) -> Groups:
        """Merge each group of a block into one splat."""

    @abstractmethod
    def surroundings(self, block: int) -> PreparedSplats | None:
        """Return splats of other blocks, drawn with a block but never changed.

        None if there are no other blocks.
        """

    @property
    @abstractmethod
    def deciding(self) -> Sequence[Camera]:
        """The views by which results are chosen."""

    @abstractmethod
    def deciding_targets(
        self, own: Block, others: PreparedSplats | None
    ) -> Sequence[Target | None]:
        """Return the original on each deciding view, or the part of it that shows a block.

        An entry is None if its view does not show the block.

        Args:
            own: The block.
            others: Its `surroundings`.
        """

    @abstractmethod
    def fit_views(self, block: int, level: int) -> FitViews | None:
        """Return the views to fit a block to; None if too few show it."""

    @abstractmethod
    def part(self, block: int, level: int) -> Splats:
        """Return the splats of a block in a result, before the fit."""

    @abstractmethod
    def keep_part(self, name: str, small: Splats) -> Record:
        """Keep the splats of a block in a result, before the fit."""

    @abstractmethod
    def keep_fit(
        self, name: str, fitted: Splats, curvatures: Curvatures | None, report: RefitReport | None
    ) -> Record:
        """Keep the splats of a block in a result after the fit.

        Args:
            name: Name of the task.
            fitted: The splats.
            curvatures: How much their values show; None without a fit.
            report: None without a fit.
        """

    @property
    @abstractmethod
    def passes(self) -> tuple[PassReport, ...]:
        """Reports of the merge passes; for several blocks summed, and without seconds."""

    @property
    @abstractmethod
    def shown(self) -> float | None:
        """Share of the prominence of all splats, in [0, 1], that the views show.

        None if nothing was rendered.
        """

    @abstractmethod
    def fit_report(self, level: int) -> RefitReport | None:
        """Return the report of a result's fit; None if it could not be fitted."""

    @abstractmethod
    def notes_on_fits(self, level: int) -> Sequence[str]:
        """Return a sentence on blocks that could not be fitted; empty if all were."""

    def of_job(self, stage: str, level: int = 0) -> Record:
        """Return the record of a stage that has a single task."""
        return self.record(Task(stage, 0, level))

    def of_block(self, stage: str, block: int, level: int = 0) -> Record:
        """Return the record that a stage wrote for a block."""
        return self.record(Task(stage, block, level))

    def of_blocks(self, stage: str, level: int = 0) -> list[Record]:
        """Return the records that a stage wrote, one for each block."""
        return [self.record(Task(stage, b, level)) for b in range(self.partition.blocks)]

    @property
    def blind(self) -> int:
        """Number of kept views that show nothing of the scene; stage `look` must be done."""
        lights = zip(*(record.facts[LIGHT] for record in self.of_blocks("look")), strict=False)
        return sum(not any(each) for each in islice(lights, len(self.views.kept)))

    @property
    def looks(self) -> bool:
        """Whether views are rendered; False, too, if no views were found for the scene."""
        return self.settings.looks and bool(self.views.kept)

    @property
    def guided(self) -> bool:
        """Whether candidates are rendered and the one that looks best is chosen."""
        return self.settings.guided and self.looks

    @property
    def balances(self) -> tuple[float, ...]:
        """Balances of the cuts to try; only the parameter `balance` if the method is not guided."""
        given = self.settings.parameters
        return given.balances if self.guided else (given.balance,)

    def picked(self, level: int) -> int:
        """Return the number of the cut chosen for a level; 0 if none was tried."""
        return int(self.of_job("pick", level).facts["cut"]) if self.tries(level) else 0

    def picked_labels(self, block: int, level: int) -> I32:
        """Return the group of each leaf of a block in the chosen cut, before reassignment."""
        return self.cut(block, level, self.picked(level))

    def tries(self, level: int) -> bool:
        """Whether several candidates of a result are made and compared."""
        return self.guided and self.merges(level)

    def chosen(self, level: int) -> Chosen:
        """Return the choice of reassignment and growth for a level."""
        parameters = self.settings.parameters
        if not self.tries(level):
            return Chosen(parameters.rounds > 0, parameters.growth)
        facts = self.of_job("choose", level).facts
        return Chosen(bool(facts["reassigned"]), float(facts["growth"]))

    def reassign_rounds(self, level: int) -> int | None:
        """Return the number of reassignment rounds in which splats moved.

        It is the largest of any block; None if nothing is reassigned.
        """
        if not self.settings.parameters.rounds or not self.merges(level):
            return None
        return max(int(record.facts[ROUNDS]) for record in self.of_blocks("reassign", level))

    def fits(self, level: int) -> bool:
        """Whether a result is fitted to renders of the original."""
        return self.settings.fits and self.merges(level)
