"""The preset `paper` (arXiv 2603.16103): prune, activate, merge pass by pass, store."""

from nanogs._types import I32
from nanogs.clock import StageClock
from nanogs.method.activation import scene_origin
from nanogs.method.paper.gaussians import activate, store
from nanogs.method.paper.parameters import PaperParameters
from nanogs.method.paper.passes import merge_to_count
from nanogs.method.paper.prune import prune
from nanogs.pipeline.outcome import Outcome
from nanogs.progress import Tracker
from nanogs.splats import Splats


def simplify_as_published(
    splats: Splats,
    rows: I32,
    parameters: PaperParameters,
    target: int,
    clock: StageClock,
    progress: Tracker,
) -> Outcome:
    """Simplify a model as published: prune, activate, merge to the count, store.

    Args:
        splats: The model.
        rows: (M,) its usable rows, ascending.
        parameters: Of the method.
        target: Splats to deliver, from 1 to M.
        clock: Gets the seconds of each stage.
        progress: Notified of each stage.
    """
    progress.begin("prune")
    with clock.time("prune"):
        pruning = prune(splats.opacities()[rows], parameters.tau, target)
        kept = rows[pruning.keep]
        pruned, threshold, limited = len(rows) - len(kept), pruning.threshold, pruning.limited
        del pruning  # frees its rows before memory peaks below
    progress.begin("activate")
    with clock.time("activate"):
        origin = scene_origin(splats.means[kept])
        # A list, so that no name here keeps the full set alive while the passes shrink it.
        working = [activate(splats, kept, origin)]
        del kept
    progress.begin("merge")
    result = merge_to_count(working.pop(), target, parameters, progress.part)
    for one_pass in result.passes:
        clock.add(one_pass.seconds)
    progress.begin("store")
    with clock.time("store"):
        small = store(result.gaussians, splats, origin)
    return Outcome(
        splats=small,
        passes=result.passes,
        stop=result.stop,
        pruned=pruned,
        prune_threshold=threshold,
        prune_limited=limited,
    )
