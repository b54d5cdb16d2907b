"""Estimate of the memory of a simplification, from the arrays that its stages allocate.

This module does not import Numba: `--dry-run` uses it without compiling anything.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from nanogs.block_layouts import PLACED, Chunked, Linked
from nanogs.io.format import Format
from nanogs.method.paper.parameters import PaperParameters
from nanogs.pipeline.estimates.memory_forest import (
    F4,
    F8,
    I4,
    I8,
    LEFT,
    forest_stages,
    graph_bytes,
    match_bytes,
    pairs_of,
)
from nanogs.pipeline.options.presets import Parameters
from nanogs.pipeline.options.target import Goal
from nanogs.slices import pairs_in_flight

LEAST_BYTES = 8  # fewest bytes of a splat in a packed file
_GEOMETRY = 3 * F8 + 3 * F4 + 4 * F4 + F8 + I4 + 1  # a Gaussian; features are in the model
_DRAWN = 2 * I8 + 1  # a random pair: packed, whether it is new, and packed once more if so
# A random pair while it is matched: nearly all join rows of two stretches, and are sorted by one.
_CROSSING = 2 * I4 + 2 + 2 * I8


@dataclass(frozen=True, slots=True)
class MemoryPlan:
    """Bytes that a simplification holds in each stage, without the libraries themselves.

    Attributes:
        input_columns: Bytes of the model as loaded.
        working_set: Bytes of the activated values of the splats.
        stages: Bytes held in each stage, including the model.
        peak: The largest of these.
    """

    input_columns: int
    working_set: int
    stages: dict[str, int]
    peak: int

    def with_stage(self, name: str, held: int) -> "MemoryPlan":
        """Return the plan with a further stage, which holds `held` bytes."""
        return replace(self, stages=self.stages | {name: held}, peak=max(self.peak, held))


def plan_memory(
    count: int,
    sh_degree: int,
    extra_bytes: int,
    parameters: Parameters,
    target: int,
    *,
    judged: bool = False,
) -> MemoryPlan:
    """Estimate the memory of `simplify` from the size of the input.

    Args:
        count: Number of splats in the input.
        sh_degree: Degree of its spherical harmonics.
        extra_bytes: Bytes of extra columns for each splat.
        parameters: Parameters of the method.
        target: Number of splats in the largest result.
        judged: Whether results are compared with the original on held-out views.
    """
    features = 3 * (sh_degree + 1) ** 2 * F4
    row = 11 * F4 + features + extra_bytes
    neighbours = min(parameters.k, max(count - 1, 0))
    if isinstance(parameters, PaperParameters):
        working_set = count * (I4 + _GEOMETRY)
        random = parameters.graph == "random"
        held = _paper_stages(count, row, features, neighbours, target, random=random)
    else:
        working_set, held = forest_stages(
            count, row, features, neighbours, parameters, target, judged=judged
        )
    stages = {stage: count * row + more for stage, more in held.items()}
    return MemoryPlan(count * row, working_set, stages, max(stages.values()))


def plan_writing(plan: MemoryPlan, splats: int, target: int, known: Format) -> MemoryPlan:
    """Add the memory of writing a file whose writer holds the whole result.

    Args:
        plan: Plan of making the result.
        splats: Number of splats of the model.
        target: Number of splats of the result.
        known: Format of the file.
    """
    small = plan.input_columns // max(splats, 1) * target
    return plan.with_stage("write", plan.input_columns + small + known.extra_memory(small))


def plan_search(plan: MemoryPlan, splats: int, goal: Goal, known: Format) -> MemoryPlan:
    """Add the memory of encoding results in a search, beside the data for further cuts.

    Args:
        plan: Plan of making the results.
        splats: Number of splats of the model.
        goal: The target of the search. If it is a size, it limits the splats of a result.
        known: Format of the file.
    """
    if known.file_bytes is not None:  # written by rows, if at all
        return plan
    most = splats if goal.size is None else min(splats, goal.size // LEAST_BYTES)
    small = plan.input_columns // max(splats, 1) * most
    # `cut` counts a best candidate; here it is the best result so far, which is kept.
    held = plan.stages.get("cut", plan.input_columns) + small + known.extra_memory(small)
    return plan.with_stage("encode", held)


def plan_levels(
    plan: MemoryPlan,
    splats: int,
    degree: int,
    target: int,
    ratios: Sequence[float],
    block_layout: Chunked | Linked,
) -> MemoryPlan:
    """Add the memory of encoding levels as chunks or as a tree.

    Args:
        plan: Plan of making the levels.
        splats: Number of splats of the model.
        degree: Degree of its spherical harmonics.
        target: Number of splats of the finest level.
        ratios: Ratios of the levels.
        block_layout: The layout that divides or links them.
    """
    row = plan.input_columns // max(splats, 1)
    if isinstance(block_layout, Linked):
        return plan.with_stage("tree", plan.input_columns + target * block_layout.whole(row))
    file = block_layout.encoding(row, degree, splats, ratios).file
    # Each level is encoded before the next one is cut, while the data for cuts stays in memory.
    held = plan.stages.get("cut", plan.input_columns) + target * (row + PLACED) + file
    return plan.with_stage("encode", int(held))


def _paper_stages(
    count: int, row: int, features: int, k: int, target: int, *, random: bool
) -> dict[str, int]:
    pairs = float(k) if random else pairs_of(k)  # random pairs are hardly ever mutual
    masses = 6 * F8  # including logarithms of scales and opacity
    # Second pass: merged pairs, which refer to features of the model; third: with own features.
    second = LEFT * (_GEOMETRY + 2 * I4 + 2 * F8)
    third = LEFT**2 * (_GEOMETRY + I4 + features)
    lists = 3 * I4 + I8 + 1 + 2 * F8
    splats = {
        "activate": max(_GEOMETRY, 9 * F8),
        "graph": _GEOMETRY + (_DRAWN * pairs if random else graph_bytes(k)),
        "cost": _GEOMETRY + 2 * I4 * pairs + max(F4 * pairs + F8, masses),
        "match": _GEOMETRY + match_bytes(pairs) + (_CROSSING * pairs if random else 0),
        "merge": max(_GEOMETRY + masses + lists + second, second + LEFT * lists + third),
    }
    held = {stage: int(count * (I4 + bytes_each)) for stage, bytes_each in splats.items()}
    held["cost"] += min(int(count * pairs), pairs_in_flight()) * 2 * I4
    return held | {"store": count * I4 + target * (_GEOMETRY + features + row + 2 * I8)}
