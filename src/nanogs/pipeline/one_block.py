"""A model in memory as it passes through the stages: one block, of which nothing is copied."""

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from nanogs import parallel
from nanogs._types import F64, I32, Array, Bool, F
from nanogs.activations import alphas
from nanogs.fit.groups import ViewGroup, split
from nanogs.fit.report import RefitReport
from nanogs.fit.targets import Fitting, Target, as_target, make_target
from nanogs.io.rate_distortion import Curvatures
from nanogs.kernels.blocks import ALL_BLOCKS, FIELDS
from nanogs.method.activation import scene_origin
from nanogs.method.correct import Correction, Ordering
from nanogs.method.cut import cut, label_groups, merge_scores
from nanogs.method.forest import Forest, grow_forest
from nanogs.method.nodes import Nodes, activate_nodes, normalised, prominence, without_coverages
from nanogs.method.order import morton_order
from nanogs.method.parameters import ForestParameters
from nanogs.method.reassign import reassign
from nanogs.method.store import Groups, store_groups
from nanogs.method.viewers import Dilation, Viewers, estimate_dilation
from nanogs.method.visibility import MissedLight, shown_share
from nanogs.pipeline.options.settings import Access, InputFile, Segment, Settings
from nanogs.pipeline.options.views import AUTOMATIC
from nanogs.pipeline.scene import (
    LIGHT,
    ROUNDS,
    SUMS,
    Block,
    FitViews,
    Look,
    Members,
    Scene,
    Task,
)
from nanogs.pipeline.tasks.partition import Partition
from nanogs.pipeline.tasks.units import viewers_of
from nanogs.pipeline.tasks.views import Views, deciding_count
from nanogs.progress import PartProgress, ignore_progress
from nanogs.raster.camera import Camera
from nanogs.raster.light import SplatLight, render_with_light
from nanogs.raster.rendering import PreparedSplats, prepare
from nanogs.report import PassReport
from nanogs.slices import SLICE_STEPS, slices
from nanogs.source import InMemory
from nanogs.splats import Splats, pick
from nanogs.store.tables import Record
from nanogs.views.light import visible_weights


class _Placement(NamedTuple):
    """The usable rows in Morton order, the origin (3,), and what depends on positions.

    That is the dilation that rasterisers add to splats, and where viewers are assumed to stand: at
    the user's cameras if there are any, else as the model suggests.
    """

    rows: I32
    origin: F64
    dilation: Dilation
    viewers: Dilation | Viewers


@dataclass(eq=False)
class OneBlock(Scene):
    """A model in memory, and the results of its stages so far; see `Scene`.

    It holds at most one result, whatever the level that is asked for; see `asking`.

    Attributes:
        splats: The model.
        usable: (M,) int32, its usable rows, ascending.
        settings: Settings of the simplification.
        threads: Number of threads in use.
        on_progress: Progress callback for the parts of the current task.
        asked_count: Number of splats asked for.
        visible: (N,) float64 in [0, 1], the share of each splat's alpha that reaches the views in
            which it lies; 1 for one that lies in none. None if nothing was rendered.
        missed: (N,) bool, the splats that lie in no view.
        missed_light: Estimate of how much of the model the views leave out.
        fitting: Renders of the original that are fitted to, as far as they are kept; without the
            deciding ones.
        view_groups: The deciding views: results are chosen and fits are judged by them.
        curvatures: How much the values of the result show, if it was fitted.
    """

    splats: Splats
    usable: I32
    settings: Settings
    threads: int
    on_progress: PartProgress = ignore_progress
    asked_count: int = 0
    _records: dict[str, Record] = field(default_factory=dict)
    _views: Views | None = None
    _shots: list[Target] = field(default_factory=list)
    _pictures: list[Target] = field(default_factory=list)
    fitting: tuple[Target, ...] = ()
    view_groups: tuple[ViewGroup, ...] = ()
    _placement: _Placement | None = None
    visible: F64 | None = None
    missed: Bool | None = None
    missed_light: MissedLight = field(default_factory=MissedLight)
    _forest: Forest | None = None
    _leaves: Nodes | None = None
    # The result in progress: labels and scores by cut, labels after reassignment, the latest groups
    # with their labels, splats.
    _cuts: dict[int, I32] = field(default_factory=dict)
    _reassigned: I32 | None = None
    _corrected: dict[int, F] = field(default_factory=dict)  # scores of a cut with corrected errors
    _stored: list[tuple[I32, Groups]] = field(default_factory=list)
    _part: Splats | None = None
    curvatures: Curvatures | None = None
    _fit: RefitReport | None = None

    def asking(self, count: int) -> "OneBlock":
        """Return a scene for the result of a count, which keeps nothing of it in this one.

        So a result that is cancelled is freed with its scene, whatever stage it has reached.

        Args:
            count: Splats to deliver.
        """
        return replace(
            self, asked_count=count, _records=dict(self._records),
            _cuts={}, _reassigned=None, _corrected={}, _stored=[],
            curvatures=None,
        )  # fmt: skip

    # What is known.

    def record(self, task: Task) -> Record:
        """Return the record of a task; see `Scene.record`."""
        return self._records[task.name]

    def write(self, name: str, columns: Mapping[str, Array], facts: Mapping[str, Any]) -> Record:
        """Keep the facts of a task; its columns are kept as attributes, so none are given."""
        assert not columns  # noqa: S101 - columns are attributes here
        self._records[name] = Record(name, {}, facts)
        return self._records[name]

    @property
    def partition(self) -> Partition:
        """The partition into one block."""
        return Partition(((0, len(self.usable)),))

    @property
    def views(self) -> Views:
        """The views of the scene."""
        assert self._views is not None  # noqa: S101 - an earlier stage
        return self._views

    @property
    def placement(self) -> _Placement:
        """The usable rows in Morton order, and what depends on positions."""
        assert self._placement is not None  # noqa: S101 - an earlier stage
        return self._placement

    @property
    def forest(self) -> Forest:
        """The merge forest."""
        assert self._forest is not None  # noqa: S101 - an earlier stage
        return self._forest

    def target(self, level: int) -> int:
        """Return the number of splats asked for, or the forest's fewest if that is more."""
        return max(self.asked_count, self.forest.fewest)

    def merges(self, level: int) -> bool:
        """Whether a result has fewer splats than the model."""
        return self.target(level) < len(self.usable)

    @property
    def shown(self) -> float | None:
        """Share of the prominence of all splats that the views show; see `Scene.shown`."""
        if self.visible is None or self.missed is None or self._leaves is None:
            return None
        leaves, rows = self._leaves, self._leaves.rows
        prominences = prominence(leaves.coverages, leaves.means, self.placement.viewers)
        return shown_share(prominences, self.visible[rows], self.missed[rows])

    # Looking.

    def find_units(self, name: str) -> Record:
        """Find Morton order, origin, dilation and viewers, and keep them as `placement`."""
        splats, usable = self.splats, self.usable
        stored = splats.means if len(usable) == len(splats) else pick(splats.means, usable)
        origin, opacities = scene_origin(stored), np.empty(len(usable))
        means = np.empty((len(usable), 3))

        def convert(part: slice) -> None:
            np.subtract(stored[part], origin, out=means[part])
            opacities[part] = alphas(pick(splats.opacity_logits, usable[part]))

        parallel.for_each(slices(len(usable), SLICE_STEPS), convert)
        pixels = self.settings.parameters.pixels
        dilation = estimate_dilation(means, opacities, splats.render_mode, pixels)
        viewers: Dilation | Viewers = dilation
        if given := self.settings.asked.given():
            viewers = viewers_of(given, origin, means)
        self._placement = _Placement(self.usable[morton_order(means)], origin, dilation, viewers)
        return self.write(name, {}, {})

    def sample(self) -> Splats:
        """Return the whole model."""
        return self.splats

    def keep_views(self, name: str, views: Views) -> Record:
        """Keep the views that were chosen."""
        self._views = views
        return self.write(name, {}, {})

    def bare(self, block: int) -> Block:
        """Return the block with its colours: views are kept as images here."""
        return self.open(block)

    def occluders(self, block: int) -> None:
        """Return None: there are no other blocks."""

    def surroundings(self, block: int) -> None:
        """Return None: there are no other blocks."""

    def closer_views(self, own: Block) -> Sequence[Camera]:
        """Return no views: the block is the whole scene."""
        return ()

    def draw(self, drawn: PreparedSplats, camera: Camera) -> SplatLight:
        """Render a view, and keep it for choosing results and for the fit."""
        # With depth, the user's views can be divided into near and far ones; automatic views differ
        # little in their distances.
        depth = self.settings.asked != AUTOMATIC
        picture, light = render_with_light(drawn, camera, depth=depth)
        self._shots.append(as_target(picture, camera))
        return light

    @property
    def pictured(self) -> Sequence[Camera]:
        """Cameras only for the fit; rendered before growing, so that the fit holds less."""
        return self.views.further if self.settings.parameters.pictured else ()

    def picture(self, drawn: PreparedSplats, camera: Camera) -> None:
        """Keep the original on a view, or half of it if the fit uses half of the pixels."""
        halves = self.settings.parameters.halves
        wanted = FIELDS[len(self._pictures) % 2] if halves else ALL_BLOCKS
        self._pictures.append(make_target(drawn, camera, depth=False, wanted=wanted))

    def keep_look(self, name: str, look: Look) -> Record:
        """Keep the visibility, and divide the views into fitted and deciding ones."""
        own, self.missed, lights, self.missed_light = look
        self.visible = own.visible
        # Views that show nothing cannot decide, and steps of the fit on them would be lost.
        shots = [shot for shot in self._shots if shot.shows] or self._shots
        looked, self.view_groups = split(shots, deciding_count(len(shots)))
        self.fitting = (*looked, *(picture for picture in self._pictures if picture.shows))
        self._shots, self._pictures = [], []
        return self.write(name, {}, {LIGHT: [light for _, light in lights]})

    # Growing and cutting.

    def grow(self, name: str, block: int) -> Record:
        """Grow the merge forest, and keep it with its leaves."""
        start = time.perf_counter()
        bare = [self._activated(blurred=True)]
        coverages = bare[0].coverages
        bare[0] = without_coverages(bare[0])
        activating = time.perf_counter() - start
        # Memory peaks in the merge passes, which need no leaves after the first one. So the leaves
        # are freed there and computed again below; the coverages, an eleventh of them, are kept.
        self._forest = grow_forest(bare.pop(), self.settings.parameters, self.on_progress)
        start = time.perf_counter()
        self._leaves = self._activated(coverages)
        seconds = [{"activate": activating + time.perf_counter() - start}]
        seconds += [each.seconds for each in self._forest.passes]
        return self.write(name, {}, {"seconds": seconds})

    def _activated(self, coverages: F64 | None = None, *, blurred: bool = False) -> Nodes:
        rows, origin, dilation, viewers = self.placement
        nodes = activate_nodes(
            self.splats, rows, origin, dilation, coverages=coverages, blurred=blurred
        )
        visible = self.visible if self.guided else None
        if viewers is dilation and visible is None:
            return nodes
        weights = prominence(nodes.coverages, nodes.means, viewers)
        if visible is not None:
            hidden = self.missed_light.hidden(self.settings.parameters.hidden)
            weights = visible_weights(weights, visible[rows], hidden)
        return replace(nodes, weights=normalised(weights))

    def open(self, block: int) -> Block:
        """Return the splats of the model."""
        return Block(self.splats, self.placement.rows, self.visible)

    def cut(self, block: int, level: int, number: int) -> I32:
        """Return the group of each leaf, computed once per cut; see `Scene.cut`."""
        if number not in self._cuts:
            forest, target = self.forest, self.target(level)
            if (scores := self._corrected.get(number)) is None:
                labels = cut(forest, target, self.balances[number])
            else:
                labels = label_groups(forest.splats, forest.children, scores, target)
            self._cuts[number] = labels
        return self._cuts[number]

    def ordering(self, own: Block, block: int, level: int, number: int) -> Ordering:
        """Return the merges and their errors, as a cut is guided by them."""
        assert self._leaves is not None  # noqa: S101 - an earlier stage
        scores = self._corrected.get(number)
        if scores is None:
            # Not divided by the median error, which is next to nothing if most splats are equal.
            scores = merge_scores(self.forest, self.balances[number], 1.0)
        return Ordering(self.forest.children, scores, self._leaves.weights)

    def keep_correction(self, task: Task, number: int, correction: Correction) -> Record:
        """Keep the corrected errors for the cut; see `Scene.keep_correction`."""
        # Scores of an earlier correction are not needed any more: its cut is made.
        self._corrected = {number: correction.scores}
        return self.write(task.name, {}, {SUMS: correction.sums.tolist()})

    def correction_targets(
        self, block: int, own: Block, others: PreparedSplats | None
    ) -> Iterable[Target]:
        """Return the original on the views that are kept for the fit."""
        return self.fitting

    def reassign(self, name: str, block: int, level: int) -> Record:
        """Reassign the splats after the chosen cut; see `Scene.reassign`."""
        assert self._leaves is not None  # noqa: S101 - an earlier stage
        labels = self.picked_labels(block, level)
        # Only the chosen cut is used from here on: free the other candidates.
        self._cuts, self._corrected = {self.picked(level): labels}, {}
        self._stored = [each for each in self._stored if each[0] is labels]
        rounds, groups = self.settings.parameters.rounds, self.target(level)
        blurs = self.placement.dilation.blurs(self._leaves.means)
        self._reassigned, done = reassign(self._leaves, labels, groups, rounds, blurs)
        return self.write(name, {}, {ROUNDS: done})

    def members(self, block: int, level: int, *, reassigned: bool) -> Members:
        """Return the splats and groups of the chosen cut, or after reassignment."""
        own = self.open(block)
        labels = self._reassigned if reassigned else self.picked_labels(block, level)
        assert labels is not None  # noqa: S101 - an earlier stage
        return Members(own.splats, own.rows, own.visible, labels)

    def stored(self, members: Members) -> Groups:
        """Merge each group into one splat; the latest two results are cached."""
        for labels, groups in self._stored:
            if labels is members.labels:
                return groups
        assert self._leaves is not None  # noqa: S101 - an earlier stage
        origin, dilation = self.placement.origin, self.placement.dilation
        del self._stored[:-1]
        groups = store_groups(
            self._leaves, members.labels, self.splats, origin, dilation,
            growth=None if self.guided else self.settings.parameters.growth,
        )  # fmt: skip
        self._stored.append((members.labels, groups))
        return groups

    # Choosing and fitting.

    @property
    def deciding(self) -> Sequence[Camera]:
        """The cameras of the views that results are chosen by."""
        return [target.camera for group in self.view_groups for target in group.targets]

    def deciding_targets(
        self, own: Block, others: PreparedSplats | None
    ) -> Sequence[Target | None]:
        """Return the original on each of the deciding views."""
        return [target for group in self.view_groups for target in group.targets]

    def fit_views(self, block: int, level: int) -> FitViews | None:
        """Return the views to fit a result to; None if there are none."""
        drawn = self.settings.looks and not self.settings.parameters.pictured
        further = self.views.further if drawn else ()
        original = prepare(self.splats).with_buffers() if further else None
        fitting = Fitting(self.fitting, original, further)
        return FitViews(fitting, self.view_groups, len(self.splats)) if len(fitting) else None

    def part(self, block: int, level: int) -> Splats:
        """Return the splats of a result, before the fit."""
        assert self._part is not None  # noqa: S101 - an earlier stage
        return self._part

    def keep_part(self, name: str, small: Splats) -> Record:
        """Keep the splats of a result, and free the groups they were made from."""
        self._cuts, self._reassigned, self._corrected, self._stored = {}, None, {}, []
        self._part = small
        return self.write(name, {}, {})

    def keep_fit(
        self, name: str, fitted: Splats, curvatures: Curvatures | None, report: RefitReport | None
    ) -> Record:
        """Keep the splats of a result after the fit, and what the fit has found."""
        self._part, self.curvatures, self._fit = fitted, curvatures, report
        return self.write(name, {}, {})

    @property
    def passes(self) -> tuple[PassReport, ...]:
        """Reports of the merge passes."""
        return self.forest.passes

    def fit_report(self, level: int) -> RefitReport | None:
        """Return the report of a result's fit; None if it could not be fitted."""
        return self._fit

    def notes_on_fits(self, level: int) -> Sequence[str]:
        """Return a note if a result could not be fitted; see `Scene.notes_on_fits`."""
        if self._fit is not None:
            return ()
        return (
            "The result was not fitted, because a single view cannot show whether a fit helps.",
        )


def whole_settings(splats: Splats, parameters: ForestParameters) -> Settings:
    """Return the settings for a model in memory."""
    count = len(splats)
    return Settings(
        inputs=(InputFile("", 0, 0, count, Access.WHOLE),),
        layout=InMemory(splats).columns,
        segments=(Segment(0, count),),
        ratios=(),
        counts=(),
        nan="drop",
        block=count,
        parameters=parameters,
    )
