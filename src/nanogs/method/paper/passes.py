"""The passes of the published method (arXiv 2603.16103), with the stages as published."""

from collections.abc import Callable
from dataclasses import dataclass

from nanogs.clock import StageClock
from nanogs.method.graph import neighbour_pairs, random_pairs
from nanogs.method.match import match
from nanogs.method.paper.cost import log_masses, pair_costs
from nanogs.method.paper.gaussians import Gaussians
from nanogs.method.paper.merge import merge
from nanogs.method.paper.parameters import PaperParameters
from nanogs.progress import PartProgress
from nanogs.report import PassReport, StopReason


@dataclass(frozen=True, slots=True, eq=False)
class Merged:
    """The splats after the passes, the report of each pass, and the reason for stopping."""

    gaussians: Gaussians
    passes: tuple[PassReport, ...]
    stop: StopReason


def merge_to_count(
    gaussians: Gaussians,
    target: int,
    parameters: PaperParameters,
    on_progress: PartProgress,
) -> Merged:
    """Merge the cheapest disjoint pairs of neighbours, pass after pass, down to the target.

    Args:
        gaussians: The splats after pruning, in Morton order.
        target: Number of splats to deliver, at least 1.
        parameters: The method's parameters.
        on_progress: Progress callback for the merges done, and their number.
    """
    passes: list[PassReport] = []
    wanted = len(gaussians) - target
    while len(gaussians) > target:
        left = len(gaussians) - target
        limit = min(left, max(1, int(parameters.merge_cap * len(gaussians))))

        def on_share(share: float, left: int = left, limit: int = limit) -> None:
            on_progress(wanted - left + share * limit, wanted)

        gaussians, report = _one_pass(gaussians, limit, parameters, on_share)
        passes.append(report)
        if report.merged == 0:
            return Merged(gaussians, tuple(passes), report.stop)
    return Merged(gaussians, tuple(passes), StopReason.TARGET)


def _one_pass(
    gaussians: Gaussians,
    limit: int,
    parameters: PaperParameters,
    on_share: Callable[[float], None],
) -> tuple[Gaussians, PassReport]:
    """Run one pass: build the graph, score its pairs, match the cheapest and merge them.

    `on_share` is called with the share of the pass that is done.
    """
    count, clock = len(gaussians), StageClock()
    on_share(0)
    with clock.time("graph"):
        if parameters.graph == "random":
            pairs = random_pairs(count, parameters.k, parameters.seed)
        else:
            pairs = neighbour_pairs(gaussians.means, parameters.k)
    on_share(0.3)
    with clock.time("cost"):
        costs = pair_costs(gaussians, pairs, log_masses(gaussians), parameters)
    on_share(0.75)
    with clock.time("match"):
        plan = match(pairs, costs, count, limit)
    candidates = len(pairs)
    del pairs, costs  # the masses are computed again below, because memory peaks in the matching
    on_share(0.9)
    with clock.time("merge"):
        merged = merge(gaussians, plan, log_masses(gaussians))
    report = PassReport(
        count_before=count,
        candidates=candidates,
        without_cost=plan.without_cost,
        merged=len(plan),
        count_after=len(merged),
        highest_cost=float(plan.costs[-1]) if len(plan) else None,
        seconds=clock.seconds,
    )
    return merged, report
