"""The published method (arXiv 2603.16103), stage by stage, as it is written there."""

from collections.abc import Callable
from dataclasses import dataclass

from nanogs.report import PassReport, StageClock, StopReason
from nanogs.simplify.cost import log_masses, pair_costs
from nanogs.simplify.gaussians import Gaussians
from nanogs.simplify.graph import neighbour_pairs, random_pairs
from nanogs.simplify.match import match
from nanogs.simplify.merge import merge
from nanogs.simplify.presets import PaperParameters

Progress = Callable[[str, int], None]
"""Called before each stage with its name and the number of splats left."""


@dataclass(frozen=True, slots=True, eq=False)
class PipelineResult:
    """What the passes left, what each of them did, and why they ended."""

    gaussians: Gaussians
    passes: tuple[PassReport, ...]
    stop: StopReason


def merge_to_count(
    gaussians: Gaussians,
    target: int,
    parameters: PaperParameters,
    threads: int,
    progress: Progress,
) -> PipelineResult:
    """Merge the cheapest disjoint pairs of neighbours, pass after pass, down to the target.

    Args:
        gaussians: The splats that pruning left, in Morton order.
        target: Splats to deliver, at least 1.
        parameters: The method's parameters.
        threads: Threads for the nearest-neighbour query.
        progress: Told of each stage.
    """
    passes: list[PassReport] = []
    while len(gaussians) > target:
        gaussians, report = _one_pass(gaussians, target, parameters, threads, progress)
        passes.append(report)
        if report.merged == 0:
            none_left = report.candidates == report.without_cost
            stop = StopReason.NO_CANDIDATES if none_left else StopReason.NO_PROGRESS
            return PipelineResult(gaussians, tuple(passes), stop)
    return PipelineResult(gaussians, tuple(passes), StopReason.TARGET)


def _one_pass(
    gaussians: Gaussians,
    target: int,
    parameters: PaperParameters,
    threads: int,
    progress: Progress,
) -> tuple[Gaussians, PassReport]:
    """Build the graph, score its pairs, match the cheapest, merge them."""
    count, clock = len(gaussians), StageClock()
    progress("graph", count)
    with clock.time("graph"):
        if parameters.graph == "random":
            pairs = random_pairs(count, parameters.k, parameters.seed)
        else:
            pairs = neighbour_pairs(gaussians.means, parameters.k, threads)
    progress("cost", count)
    with clock.time("cost"):
        costs = pair_costs(gaussians, pairs, log_masses(gaussians), parameters)
    progress("match", count)
    with clock.time("match"):
        limit = min(count - target, max(1, int(parameters.merge_cap * count)))
        plan = match(pairs, costs, count, limit)
    candidates = len(pairs)
    del pairs, costs  # and the masses were not kept either: matching takes the most memory
    progress("merge", count)
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
