"""How much memory a simplification takes, computed from what its stages allocate.

No Numba here: `--dry-run` uses it without compiling anything.
"""

from dataclasses import dataclass

from nanogs.simplify.memory_forest import PAIRS_PER_NEIGHBOUR, TREE, forest_stages
from nanogs.simplify.presets import PaperParameters, Parameters

LIBRARIES = 215_000_000  # bytes, measured, of Python and its libraries, which the plan leaves out

_F4, _F8, _I4, _I8 = 4, 8, 4, 8
_GEOMETRY = 3 * _F8 + 3 * _F4 + 4 * _F4 + _F8 + _I8 + 1  # Gaussians without the features


@dataclass(frozen=True, slots=True)
class MemoryPlan:
    """Bytes that a simplification keeps, stage by stage; see `LIBRARIES` for what comes on top.

    Attributes:
        input_columns: The model as loaded.
        working_set: Activated values of the splats.
        stages: All that each stage holds, the model with it.
        peak: The most that any stage holds.
    """

    input_columns: int
    working_set: int
    stages: dict[str, int]
    peak: int


def plan_memory(
    count: int,
    sh_degree: int,
    extra_bytes: int,
    parameters: Parameters,
    target: int,
    *,
    judged: bool = False,
) -> MemoryPlan:
    """Memory of `simplify` before anything is pruned or merged.

    Args:
        count: Splats in the input.
        sh_degree: Degree of its spherical harmonics.
        extra_bytes: Bytes of extra columns for each splat.
        parameters: Of the method.
        target: Splats in the largest result.
        judged: Whether results are held against views of the original whatever the preset.
    """
    features = 3 * (sh_degree + 1) ** 2 * _F4
    row = 11 * _F4 + features + extra_bytes
    neighbours = min(parameters.k, max(count - 1, 0))
    if isinstance(parameters, PaperParameters):
        working_set = count * (_GEOMETRY + features)
        beside = _paper_stages(count, row, working_set, neighbours)
        held = {stage: working_set + more for stage, more in beside.items()}
    else:
        working_set, held = forest_stages(
            count, row, features, neighbours, parameters, target, judged=judged
        )
    stages = {stage: count * row + more for stage, more in held.items()}
    return MemoryPlan(count * row, working_set, stages, max(stages.values()))


def _paper_stages(count: int, row: int, working_set: int, k: int) -> dict[str, int]:
    pairs, neighbours = PAIRS_PER_NEIGHBOUR * k, k * _I4
    marked = neighbours + k  # and a flag for each neighbour
    held = 2 * _I4 * pairs + _F4 * pairs + _F8  # pairs, costs and masses
    return {
        "activate": count * (row + 4 * _F8),
        "graph": int(count * max(TREE + neighbours, marked + 2 * _I8 + 2 * _I4 * pairs)),
        "cost": int(count * (held + 2 * _F8)),
        "match": int(count * (held + 2 * _I8 * pairs + _I8 + 1)),
        # The result of a merge has at least half the splats.
        "merge": int(count * held + working_set),
    }
