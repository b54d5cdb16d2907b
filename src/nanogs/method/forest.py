"""The merge forest: matching passes that merge pairs down to one node, with every merge recorded.

One forest serves every count: `cut` selects the merges to do.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from nanogs import parallel
from nanogs._types import F32, F64, I32, I64
from nanogs.clock import StageClock
from nanogs.kernels.forest import log_determinants, merge_increments
from nanogs.kernels.nodes import join_pairs_of_nodes
from nanogs.method.graph import neighbour_pairs
from nanogs.method.match import MergePlan, match
from nanogs.method.nodes import Nodes, gather_groups, gather_pairs
from nanogs.method.parameters import ForestParameters
from nanogs.progress import PartProgress
from nanogs.report import PassReport, StopReason
from nanogs.slices import SLICE_PAIRS, slices


@dataclass(frozen=True, slots=True, eq=False)
class Forest:
    """The merges of N splats. Node r below N is splat r; node N + m is the result of merge m.

    Attributes:
        splats: N.
        children: (M, 2) int32, the two nodes of each merge; children come before parents.
        levels: (M,) int32, the pass that made the merge, from 1.
        increments: (M, 2) float32, increase of the colour error and of the geometry error by it.
        passes: Report of each pass.
        stop: `TARGET` if one node is left, else the reason why not.
    """

    splats: int
    children: I32
    levels: I32
    increments: F32
    passes: tuple[PassReport, ...]
    stop: StopReason

    @property
    def fewest(self) -> int:
        """Number of splats left when every merge is done."""
        return self.splats - len(self.children)


def grow_forest(leaves: Nodes, parameters: ForestParameters, on_progress: PartProgress) -> Forest:
    """Grow a forest: match nearly all nodes with a neighbour and merge them, until one is left.

    Args:
        leaves: N nodes, one for each splat.
        parameters: k and lambda_app are used.
        on_progress: Progress callback for the merges done.
    """
    count = made = len(leaves)
    nodes, ids = leaves, np.arange(count, dtype=np.int32)
    del leaves  # frees memory for the passes if the caller does not keep them
    parts: list[tuple[I32, F32]] = []
    passes: list[PassReport] = []
    stop = StopReason.TARGET
    while len(nodes) > 1:
        on_share = partial(_report_within, on_progress, count, len(nodes))
        plan, increments, report = _one_pass(nodes, parameters, on_share)
        if len(plan) == 0:
            stop = report.stop
            passes.append(report)
            break
        clock = StageClock()
        with clock.time("merge"):
            children, ids, starts, members = _joined_pairs(plan.pairs, ids, made)
            parts.append((children, increments))
            made += len(plan)
            del plan  # frees memory for the next nodes
            # Features of pairs of splats, half a model, are not stored but averaged when needed.
            on_share(0.9)
            nodes = (gather_groups if passes else gather_pairs)(nodes, starts, members)
        passes.append(replace(report, seconds=report.seconds | clock.seconds))
    children, levels, errors = _joined(parts)
    return Forest(count, children, levels, errors, tuple(passes), stop)


def _joined_pairs(pairs: I32, ids: I32, made: int) -> tuple[I32, I32, I64, I32]:
    """Merge pairs of nodes.

    Args:
        pairs: (P, 2) rows of the nodes to merge.
        ids: (n,) node numbers of the rows.
        made: Number of nodes so far: that of the first merge.

    Returns:
        (P, 2) node numbers of the merges' children; (n - P,) node numbers of the rows that are
        left; and their members as in `member_lists`.
    """
    children, left = np.empty_like(pairs), len(ids) - len(pairs)
    merges = np.full(len(ids), -1, dtype=np.int32)
    starts, members = np.empty(left + 1, dtype=np.int64), np.empty(len(ids), dtype=np.int32)
    join_pairs_of_nodes(pairs, made, ids, merges, children, starts, members)
    return children, ids[:left].copy(), starts, members


def _report_within(on_progress: PartProgress, splats: int, nodes: int, share: float) -> None:
    """Report the number of a forest's merges done, within a pass that halves the nodes."""
    on_progress(splats - nodes * (1 - share / 2), splats)


def _one_pass(
    nodes: Nodes, parameters: ForestParameters, on_share: Callable[[float], None]
) -> tuple[MergePlan, F32, PassReport]:
    """Run graph, cost and match; return the plan, its pairs' increments, and the pass's report."""
    count, clock = len(nodes), StageClock()
    on_share(0)
    with clock.time("graph"):
        pairs = neighbour_pairs(nodes.means, parameters.k)
    on_share(0.5)
    with clock.time("cost"):
        log_dets = np.empty(count)
        log_determinants(nodes.covariances, log_dets)
        costs = _costs(pairs, nodes, log_dets, parameters)
    on_share(0.65)
    with clock.time("match"):
        plan = match(pairs, costs, count, count // 2)
        chosen = _increments(merge_increments, plan.pairs, nodes, log_dets)
    report = PassReport(
        count_before=count,
        candidates=len(pairs),
        without_cost=plan.without_cost,
        merged=len(plan),
        count_after=count - len(plan),
        highest_cost=float(plan.costs[-1]) if len(plan) else None,
        seconds=clock.seconds,
    )
    return plan, chosen, report


def _costs(pairs: I32, nodes: Nodes, log_dets: F64, parameters: ForestParameters) -> F32:
    """Compute (E,) float32 costs, weighted sums of the increments.

    Done in slices, because all increments would take twice the memory.
    """
    costs = np.empty(len(pairs), dtype=np.float32)

    def weigh(part: slice) -> None:
        some = np.ascontiguousarray(pairs[part])
        increments = _increments(merge_increments.here, some, nodes, log_dets)
        with np.errstate(over="ignore"):  # a cost beyond float32 is infinite and comes last
            increments[:, 0] *= np.float32(parameters.lambda_app)
            np.add(increments[:, 0], increments[:, 1], out=costs[part])

    parallel.for_each(slices(len(pairs), SLICE_PAIRS), weigh)
    return costs


def _increments(call: Callable[..., None], pairs: I32, nodes: Nodes, log_dets: F64) -> F32:
    """Compute the (P, 2) float32 increments of pairs.

    `call` is `merge_increments` on all threads, or its `here` on this thread alone.
    """
    increments = np.empty((len(pairs), 2), dtype=np.float32)
    call(
        pairs, nodes.weights, nodes.means, nodes.covariances, log_dets,
        nodes.features, nodes.rows, nodes.second_rows, nodes.shares, increments,
    )  # fmt: skip
    return increments


def _joined(parts: list[tuple[I32, F32]]) -> tuple[I32, I32, F32]:
    if not parts:
        empty = np.empty((0, 2), dtype=np.int32)
        return empty, empty[:, 0], empty.astype(np.float32)
    children, increments = zip(*parts, strict=True)
    levels = np.repeat(np.arange(1, len(parts) + 1, dtype=np.int32), list(map(len, children)))
    return np.concatenate(children), levels, np.concatenate(increments)
