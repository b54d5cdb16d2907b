"""The default method, stage by stage: look, grow, cut, reassign, choose, fit.

`docs/method.md` says why.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nanogs._types import F64, I32
from nanogs.clock import StageClock
from nanogs.errors import ModelError
from nanogs.fit.api import fit_to_views
from nanogs.fit.report import RefitReport
from nanogs.fit.targets import Fitting
from nanogs.method.choose import Candidate, choose_model
from nanogs.method.cut import cut
from nanogs.method.extent import Dilation, dilation
from nanogs.method.forest import Forest, grow_forest
from nanogs.method.gaussians import scene_origin
from nanogs.method.nodes import (
    Nodes,
    activate_nodes,
    normalised,
    without_coverages,
)
from nanogs.method.order import morton_order
from nanogs.method.parameters import ForestParameters
from nanogs.method.reassign import reassign
from nanogs.method.store import Groups, store_groups
from nanogs.method.visibility import OriginalViews, judge, look, shown_share, visible_weights
from nanogs.pipeline.outcome import Outcome
from nanogs.pipeline.presets import renders
from nanogs.pipeline.weights import fit_parameters
from nanogs.progress import Tracker
from nanogs.raster.camera import Camera
from nanogs.raster.lens import lens_notes
from nanogs.raster.rendering import prepare
from nanogs.report import CandidateReport, StopReason
from nanogs.splats import Splats, pick


@dataclass(frozen=True, slots=True, eq=False)
class Build:
    """A model's merge forest and all that is needed to deliver any count from it.

    Attributes:
        splats: The model.
        leaves: M nodes, one for each usable splat.
        forest: Their merges.
        origin: (3,) what the leaves' centres are relative to, scene units.
        dilation: What rasterisers add to splats, by where they are from the origin.
        views: What the original shows, or None where nothing is rendered.
        parameters: Of the method.
        shown: See `SimplifyReport`.
        threads: Threads for nearest-neighbour queries.
        notes: What the user should know, one sentence each.
    """

    splats: Splats
    leaves: Nodes
    forest: Forest
    origin: F64
    dilation: Dilation
    views: OriginalViews | None
    shown: float | None
    parameters: ForestParameters
    threads: int
    notes: tuple[str, ...]


def build_forest(
    splats: Splats,
    rows: I32,
    parameters: ForestParameters,
    cameras: Sequence[Camera] | None,
    threads: int,
    clock: StageClock,
    progress: Tracker,
) -> Build:
    """Look at the model, weigh its splats by what is seen of them, and grow their forest."""
    notes: tuple[str, ...] = ()
    views = None
    if renders(parameters):
        progress.begin("look")
        with clock.time("look"):
            try:
                views = look(splats, cameras, parameters, progress.part)
                notes = (*lens_notes(cameras or ()), *views.notes)
            except ModelError as error:
                notes = (f"Nothing was measured: {error}",)
    progress.begin("activate")
    with clock.time("activate"):
        centres = pick(splats.means, rows)
        origin = scene_origin(centres)
        means = centres - origin
        del centres
        alphas = pick(splats.opacities(), rows)
        added = dilation(means, alphas, splats.render_mode, parameters.pixels)
        rows = rows[morton_order(means)]
        del means, alphas

    def leaves() -> Nodes:
        with clock.time("activate"):
            nodes = activate_nodes(splats, rows, origin, added)
            if views is None or not parameters.measure:
                return nodes
            weights = visible_weights(nodes.coverages, views.visible[rows], parameters.hidden)
            return replace(nodes, weights=normalised(weights))

    progress.begin("grow")
    # Made again for what follows: the passes are the most that is held, and they have no use for
    # the leaves after the first.
    forest = grow_forest(without_coverages(leaves()), parameters, threads, progress.part)
    for one_pass in forest.passes:
        clock.add(one_pass.seconds)
    nodes, shown = leaves(), None
    if views is not None:
        shown = shown_share(nodes.coverages, views.visible[rows], views.missed[rows])
    return Build(splats, nodes, forest, origin, added, views, shown, parameters, threads, notes)


def deliver(build: Build, target: int, clock: StageClock, progress: Tracker) -> Outcome:
    """The model of the asked count, or of the fewest the forest has."""
    forest = build.forest
    groups = max(target, forest.fewest)
    if groups == forest.splats:
        whole = build.splats.take(np.sort(build.leaves.rows))
        stop = StopReason.TARGET if groups == target else forest.stop
        return Outcome(whole, forest.passes, stop, notes=build.notes)
    candidates: tuple[CandidateReport, ...] = ()
    if build.views is not None and build.parameters.measure:
        progress.begin("choose")
        with clock.time("choose"):
            chosen, candidates = _choose(build, groups, build.views, progress)
        small = chosen.model
    else:
        small = _group(build, groups, clock, progress)
    fitted, notes = None, build.notes
    if build.views is not None and build.parameters.steps:
        progress.begin("fit")
        with clock.time("fit"):
            small, fitted, unfitted = _fit(build, small, build.views, progress)
            notes += unfitted
    return Outcome(
        splats=small,
        passes=forest.passes,
        stop=StopReason.TARGET if groups == target else forest.stop,
        shown=build.shown,
        candidates=candidates,
        refit=fitted,
        notes=notes,
    )


def _fit(
    build: Build, small: Splats, views: OriginalViews, progress: Tracker
) -> tuple[Splats, RefitReport | None, tuple[str, ...]]:
    """The fitted model, or the same one and why it cannot be fitted."""
    original = prepare(build.splats) if views.further else None
    fitting = Fitting(views.fitting, original, views.further)
    if not len(fitting):
        return small, None, ("The result was not fitted: one view cannot tell what helps.",)
    chosen = replace(
        fit_parameters(build.parameters),
        views=len(fitting),
        validation=sum(len(group.targets) for group in views.deciding),
    )
    fitted, report = fit_to_views(
        small, fitting, views.deciding, chosen, len(build.splats), build.threads,
        progress.part,
    )  # fmt: skip
    return fitted, report, ()


def _group(build: Build, groups: int, clock: StageClock, progress: Tracker) -> Splats:
    """The model of the cut that the parameters ask for."""
    progress.begin("cut")
    with clock.time("cut"):
        labels = _regroup(build, cut(build.forest, groups, build.parameters.balance), groups)
    progress.begin("store")
    with clock.time("store"):
        return _grouped(build, labels, sheets=True).grown(build.parameters.growth)


def _choose(
    build: Build, groups: int, views: OriginalViews, progress: Tracker
) -> tuple[Candidate, tuple[CandidateReport, ...]]:
    """The candidate that does best on views of the original, and how all did."""
    return choose_model(
        lambda labels: _regroup(build, labels, groups),
        lambda balance: cut(build.forest, groups, balance),
        lambda labels: _grouped(build, labels, sheets=False).grown,
        lambda small: judge(small, views),
        build.parameters.balances,
        build.parameters.growth,
        progress.part,
    )


def _regroup(build: Build, labels: I32, groups: int) -> I32:
    return reassign(build.leaves, labels, groups, build.parameters.rounds, build.threads)


def _grouped(build: Build, labels: I32, *, sheets: bool) -> Groups:
    return store_groups(
        build.leaves, labels, build.splats, build.origin, build.dilation, sheets=sheets
    )
