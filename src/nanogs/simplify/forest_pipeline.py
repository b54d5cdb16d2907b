"""The default method, stage by stage: look, grow, cut, reassign, choose, recolour.

`docs/method.md` says why.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nanogs._types import F64, I32
from nanogs.errors import ModelError
from nanogs.progress import Tracker
from nanogs.refit.api import refit
from nanogs.refit.report import RefitReport
from nanogs.render.camera import Camera
from nanogs.render.lens import lens_notes
from nanogs.report import CandidateReport, RecolourReport, StageClock, StopReason
from nanogs.simplify.choose import BALANCES, Candidate, choose_model
from nanogs.simplify.cut import cut
from nanogs.simplify.extent import Dilation, dilation
from nanogs.simplify.gaussians import scene_origin
from nanogs.simplify.nodes import (
    Nodes,
    activate_nodes,
    normalised,
    stored_order,
    without_coverages,
)
from nanogs.simplify.order import morton_order
from nanogs.simplify.outcome import Outcome
from nanogs.simplify.presets import USUAL_BALANCE, ForestParameters
from nanogs.simplify.reassign import reassign
from nanogs.simplify.recolour import recolour
from nanogs.simplify.stages import REFIT
from nanogs.simplify.store import store_groups
from nanogs.simplify.tree import Forest, grow_forest
from nanogs.simplify.visibility import OriginalViews, judge, look, visible_weights
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
        cameras: The user's, or None for automatic ones.
        parameters: Of the method.
        threads: Threads for nearest-neighbour queries.
        notes: What the user should know, one sentence each.
    """

    splats: Splats
    leaves: Nodes
    forest: Forest
    origin: F64
    dilation: Dilation
    views: OriginalViews | None
    cameras: Sequence[Camera] | None
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
    if parameters.measure:
        progress.begin("look")
        with clock.time("look"):
            try:
                views = look(splats, cameras, parameters.views, progress.part)
                notes = tuple(lens_notes(cameras or ()))
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
            if views is None:
                return nodes
            weights = visible_weights(nodes.coverages, views.visible[rows], parameters.hidden)
            return replace(nodes, weights=normalised(weights))

    progress.begin("grow")
    # Made again for what follows: the passes are the most that is held, and they have no use for
    # the leaves after the first.
    forest = grow_forest(
        without_coverages(leaves()), parameters.k, parameters.lambda_app, threads, progress.part
    )
    for one_pass in forest.passes:
        clock.add(one_pass.seconds)
    return Build(
        splats, leaves(), forest, origin, added, views, cameras, parameters, threads, notes
    )


def deliver(build: Build, target: int, clock: StageClock, progress: Tracker) -> Outcome:
    """The model of the asked count, or of the fewest the forest has."""
    forest = build.forest
    groups = max(target, forest.fewest)
    if groups == forest.splats:
        whole = build.splats.take(np.sort(build.leaves.rows))
        stop = StopReason.TARGET if groups == target else forest.stop
        return Outcome(whole, forest.passes, stop, notes=build.notes)
    if build.views is None:
        small = _group(build, groups, clock, progress)
        candidates: tuple[CandidateReport, ...] = ()
        recoloured = None
    else:
        progress.begin("choose")
        with clock.time("choose"):
            chosen, candidates = _choose(build, groups, build.views, progress)
        small, recoloured = chosen.model, None
        if build.parameters.recolour:
            progress.begin("recolour")
            with clock.time("recolour"):
                small, recoloured = _recolour(build, chosen, build.views, progress)
    fitted, notes = None, build.notes
    if build.parameters.refit:
        with clock.time("refit"):
            small, fitted, unfitted = _fit(build, small, progress)
            notes += unfitted
    return Outcome(
        splats=small,
        passes=forest.passes,
        stop=StopReason.TARGET if groups == target else forest.stop,
        candidates=candidates,
        recolour=recoloured,
        refit=fitted,
        notes=notes,
    )


def _fit(
    build: Build, small: Splats, progress: Tracker
) -> tuple[Splats, RefitReport | None, tuple[str, ...]]:
    """The fitted model, or the same one and why it cannot be fitted."""
    try:
        fitted, report = refit(
            build.splats,
            small,
            cameras=build.cameras,
            parameters=REFIT,
            threads=build.threads,
            progress=progress.passing(),
        )
        return fitted, report, ()
    except ModelError as error:  # nothing visible, or a handful of splats that are hardly seen
        return small, None, (f"The result was not fitted: {error}",)


def _group(build: Build, groups: int, clock: StageClock, progress: Tracker) -> Splats:
    """The model of the cut that the parameters ask for."""
    progress.begin("cut")
    with clock.time("cut"):
        labels = _regroup(build, cut(build.forest, groups, build.parameters.balance), groups)
    progress.begin("store")
    with clock.time("store"):
        return _model(build, labels, build.parameters.growth, sheets=True)


def _choose(
    build: Build, groups: int, views: OriginalViews, progress: Tracker
) -> tuple[Candidate, tuple[CandidateReport, ...]]:
    """What does best on views of the original, and how the others did."""
    return choose_model(
        lambda labels: _regroup(build, labels, groups),
        lambda balance: cut(build.forest, groups, balance),
        lambda labels, growth: _model(build, labels, growth, sheets=False),
        lambda small: judge(small, views),
        sorted({*BALANCES, build.parameters.balance} - {USUAL_BALANCE}),
        build.parameters.growth,
        progress.part,
    )


def _recolour(
    build: Build, chosen: Candidate, views: OriginalViews, progress: Tracker
) -> tuple[Splats, RecolourReport | None]:
    """The chosen model with its colours fitted, where that brings it nearer."""
    _, _, merged = stored_order(build.leaves, chosen.labels, len(chosen.model))
    before = chosen.report.psnr, chosen.report.ssim
    return recolour(chosen.model, merged, views, before, progress.part)


def _regroup(build: Build, labels: I32, groups: int) -> I32:
    return reassign(build.leaves, labels, groups, build.parameters.rounds, build.threads)


def _model(build: Build, labels: I32, growth: float, *, sheets: bool) -> Splats:
    return store_groups(
        build.leaves, labels, build.splats, build.origin, build.dilation, growth, sheets=sheets
    )  # fmt: skip
