"""A scene on its way through the stages: its blocks, and what the stages before have found.

Stages are written once, for a block of a scene. `one_block.OneBlock` is a model in memory;
`work.Work` is a scene in blocks, of which only files are kept.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple

from nanogs._types import F64, I32, I64, Array, Bool
from nanogs.fit.groups import Group
from nanogs.fit.report import RefitReport
from nanogs.fit.targets import Fitting, Target
from nanogs.method.growth import Cover
from nanogs.method.store import Groups
from nanogs.method.visibility import Discovery
from nanogs.pipeline.partition import Partition
from nanogs.pipeline.settings import Settings
from nanogs.pipeline.views import Views
from nanogs.progress import Parts
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import PreparedSplats, Rendering
from nanogs.report import PassReport
from nanogs.splats import Splats
from nanogs.store.tables import Record

LIGHT = "light"  # a fact of looking: how much of a block each view shows
ROUNDS = "rounds"  # a fact of reassignment: in how many of its rounds splats moved


@dataclass(frozen=True, slots=True)
class Task:
    """One of the tasks of a job.

    Attributes:
        stage: What is done.
        number: Of the segment or block.
        level: Of the result.
    """

    stage: str
    number: int = 0
    level: int = 0

    @property
    def name(self) -> str:
        """Name of the table that it writes."""
        return f"{self.stage}-{self.level}-{self.number:05d}"


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """The splats of a block.

    Attributes:
        splats: N of them.
        rows: (M,) integers, the usable rows in Morton order.
        visible: (N,) float64, how visible each splat is, or None where nothing is looked at.
    """

    splats: Splats
    rows: I64 | I32
    visible: F64 | None


@dataclass(frozen=True, slots=True, eq=False)
class Members(Block):
    """The splats of a block's groups, of which some may come from other blocks.

    Attributes:
        labels: (M,) int32, the group of each row, in that order.
        others: Groups of other blocks that may cover these, where that is asked for.
    """

    labels: I32
    others: Sequence[Cover] = ()


@dataclass(frozen=True, slots=True, eq=False)
class FitViews:
    """The views to fit a block to.

    Attributes:
        fitting: Views of the original, kept or to be drawn.
        deciding: Others, which decide what is kept.
        count: Splats of the original.
    """

    fitting: Fitting
    deciding: Sequence[Group]
    count: int


class Lit(NamedTuple):
    """A view, and how much of a block it shows, pixels of alpha 1."""

    camera: Camera
    light: float


@dataclass(frozen=True, slots=True)
class Chosen:
    """The choice for a level: whether splats stay reassigned, and how much they may grow."""

    reassigned: bool
    growth: float


class Scene(ABC):
    """A scene as a stage sees it.

    Attributes:
        settings: What is done to it.
        threads: Threads in use.
        tell: Told of the parts of the present task.
    """

    settings: Settings
    threads: int
    tell: Parts

    @abstractmethod
    def record(self, task: Task) -> Record:
        """The record of what a task wrote."""

    @abstractmethod
    def write(self, name: str, columns: Mapping[str, Array], facts: Mapping[str, Any]) -> Record:
        """Keep what a task has found, under its name."""

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
        """Splats that a result is to have."""

    @abstractmethod
    def merges(self, level: int) -> bool:
        """Whether a result has fewer splats than the scene."""

    @abstractmethod
    def survey(self, name: str) -> Record:
        """Find the units that all blocks share."""

    @abstractmethod
    def sample(self) -> Splats:
        """Splats that cameras are placed by, spread over the scene."""

    @abstractmethod
    def given_cameras(self, some: Splats) -> Sequence[Camera] | None:
        """The views that the user asks for; None for automatic ones."""

    @abstractmethod
    def from_afar(self) -> Splats:
        """The scene, or a coarse level of it, to find roaming views in."""

    @abstractmethod
    def keep_views(self, name: str, views: Views) -> Record:
        """Keep the views that were chosen."""

    @abstractmethod
    def bare(self, block: int) -> Block:
        """The splats of a block for views that only say what hides what."""

    @abstractmethod
    def hiding(self, block: int) -> PreparedSplats | None:
        """Splats of other blocks that may hide a block; None where there are none."""

    @abstractmethod
    def closer_views(self, own: Block) -> Sequence[Camera]:
        """Views of a block alone, where it is small in all those of the scene."""

    @abstractmethod
    def draw(self, drawn: PreparedSplats, camera: Camera) -> Rendering:
        """A view that is looked from, with the contribution of each splat."""

    @property
    def pictured(self) -> Sequence[Camera]:
        """Views that are fitted to and not looked at, where their pictures are few enough to keep.

        Others are drawn when their turn comes.
        """
        return ()

    def picture(self, drawn: PreparedSplats, camera: Camera) -> None:
        """Keep the picture of one of these."""
        raise NotImplementedError

    @abstractmethod
    def keep_look(
        self, name: str, own: Block, missed: Bool, lights: Sequence[Lit], discovery: Discovery
    ) -> Record:
        """Keep how visible a block's splats are, what views show of it, and what they leave out."""

    @abstractmethod
    def grow(self, name: str, block: int) -> Record:
        """Grow the merge forest of a block."""

    @abstractmethod
    def settle(self, name: str, block: int, level: int) -> Record:
        """Reassign the splats of a block after the chosen cut."""

    @abstractmethod
    def open(self, block: int) -> Block:
        """The splats of a block."""

    @abstractmethod
    def cut(self, block: int, level: int, balance: int) -> I32:
        """(M,) the group of each leaf of a block in the cut of a balance, by its number."""

    @abstractmethod
    def members(self, block: int, level: int, *, reassigned: bool) -> Members:
        """The splats of a block's groups: of the chosen cut, or after reassignment."""

    @abstractmethod
    def stored(self, members: Members) -> Groups:
        """The groups of a block as splats."""

    @abstractmethod
    def surroundings(self, block: int) -> PreparedSplats | None:
        """Splats drawn with a block and not changed; None where there are no other blocks."""

    @property
    @abstractmethod
    def deciding(self) -> Sequence[Camera]:
        """The views by which results are chosen."""

    @abstractmethod
    def pictures(self, block: int, own: Block) -> Sequence[Target | None]:
        """The original on each of these views, or the part that shows a block; None without it."""

    @abstractmethod
    def fit_views(self, block: int, level: int) -> FitViews | None:
        """The views to fit a block to; None where too few show it."""

    @abstractmethod
    def part(self, block: int, level: int) -> Splats:
        """The splats of a block in a result, before the fit."""

    @abstractmethod
    def keep_part(self, name: str, level: int, small: Splats) -> Record:
        """Keep the splats of a block in a result, before the fit."""

    @abstractmethod
    def keep_fit(self, name: str, level: int, fitted: Splats, report: RefitReport | None) -> Record:
        """Keep the splats of a block in a result after the fit; no report where none was made."""

    @property
    @abstractmethod
    def passes(self) -> tuple[PassReport, ...]:
        """Reports of the passes of growing the forest; of blocks, summed and without seconds."""

    @property
    @abstractmethod
    def shown(self) -> float | None:
        """Share of the prominence of all splats, in [0, 1], that the views show."""

    @abstractmethod
    def fit_report(self, level: int) -> RefitReport | None:
        """How a result was fitted; None where it could not be."""

    @abstractmethod
    def notes_on_fits(self, level: int) -> Sequence[str]:
        """A sentence on what could not be fitted; none where all was."""

    def of_job(self, stage: str, level: int = 0) -> Record:
        """The record of what a stage of one task wrote."""
        return self.record(Task(stage, 0, level))

    def of_block(self, stage: str, block: int, level: int = 0) -> Record:
        """The record of what a stage wrote for a block."""
        return self.record(Task(stage, block, level))

    def of_blocks(self, stage: str, level: int = 0) -> list[Record]:
        """The records of what a stage wrote, one a block."""
        return [self.record(Task(stage, b, level)) for b in range(self.partition.blocks)]

    @property
    def blind(self) -> int:
        """How many of the kept views show nothing of the scene, which was looked at."""
        lights = zip(*(record.facts[LIGHT] for record in self.of_blocks("look")), strict=False)
        return sum(not any(each) for each in islice(lights, len(self.views.kept)))

    @property
    def looks(self) -> bool:
        """Whether anything is looked at: not in a scene that shows nothing."""
        return self.settings.looks and bool(self.views.kept)

    @property
    def measures(self) -> bool:
        """Whether results are chosen by how they look."""
        return self.settings.measures and self.looks

    @property
    def balances(self) -> tuple[float, ...]:
        """The balances of the cuts that are tried; the usual one where none can be measured."""
        given = self.settings.parameters
        return given.balances if self.measures else (given.balance,)

    def balance(self, level: int) -> int:
        """Number of the balance that was chosen."""
        return int(self.of_job("pick", level).facts["balance"]) if self.tries(level) else 0

    def tries(self, level: int) -> bool:
        """Whether candidates of a result are tried."""
        return self.measures and self.merges(level)

    def chosen(self, level: int) -> Chosen:
        """How the groups of a level become splats."""
        parameters = self.settings.parameters
        if not self.tries(level):
            return Chosen(parameters.rounds > 0, parameters.growth)
        facts = self.of_job("choose", level).facts
        return Chosen(bool(facts["reassigned"]), float(facts["growth"]))

    def reassign_rounds(self, level: int) -> int | None:
        """Rounds of reassignment in which splats moved, the most of any block; None without any."""
        if not self.settings.parameters.rounds or not self.merges(level):
            return None
        return max(int(record.facts[ROUNDS]) for record in self.of_blocks("settle", level))

    def fits(self, level: int) -> bool:
        """Whether a result is fitted to what views show."""
        return self.settings.fits and self.merges(level)
