"""How much memory a simplification takes, computed from what its stages allocate.

No Numba here: `--dry-run` uses it without compiling anything.
"""

from dataclasses import dataclass

# Pairs for each splat and neighbour: both directions of most neighbours coincide. Measured 0.55 to
# 0.66 on trained scenes at k = 8 to 16; the plan takes the upper end.
_PAIRS_PER_NEIGHBOUR = 0.66

_F4, _F8, _I4, _I8 = 4, 8, 4, 8
_GEOMETRY = 3 * _F8 + 3 * _F4 + 4 * _F4 + _F8 + _I8 + 1  # Gaussians without the features
_TREE = 2 * 3 * _F8 + _I4 + 12 + 1  # scaled centres, reordered ones and their rows, boxes, a flag


@dataclass(frozen=True, slots=True)
class MemoryPlan:
    """Bytes that a simplification keeps, stage by stage; Python and its libraries add about 150 MB.

    Attributes:
        input_columns: The model as loaded.
        working_set: Activated values of the splats.
        stages: What each stage holds beside these two.
        peak: Highest sum.
    """

    input_columns: int
    working_set: int
    stages: dict[str, int]
    peak: int


def plan_memory(count: int, sh_degree: int, extra_bytes: int, k: int) -> MemoryPlan:
    """Memory of `simplify` before pruning takes anything away.

    Args:
        count: Splats in the input.
        sh_degree: Degree of its spherical harmonics.
        extra_bytes: Bytes of extra columns for each splat.
        k: Neighbours in the graph.
    """
    features = 3 * (sh_degree + 1) ** 2 * _F4
    input_columns = count * (11 * _F4 + features + extra_bytes)
    working_set = count * (_GEOMETRY + features)
    pairs = _PAIRS_PER_NEIGHBOUR * min(k, max(count - 1, 0))
    neighbours = min(k, max(count - 1, 0)) * _I4
    marked = neighbours + min(k, max(count - 1, 0))  # and a flag for each neighbour
    held = 2 * _I4 * pairs + _F4 * pairs + _F8  # pairs, costs and masses
    stages = {
        "activate": count * (11 * _F4 + features + extra_bytes + 4 * _F8),
        "graph": int(count * max(_TREE + neighbours, marked + 2 * _I8 + 2 * _I4 * pairs)),
        "cost": int(count * (held + 2 * _F8)),
        "match": int(count * (held + 2 * _I8 * pairs + _I8 + 1)),
        # The result of a merge has at least half the splats.
        "merge": int(count * held + working_set),
    }
    peak = input_columns + working_set + max(stages.values())
    return MemoryPlan(input_columns, working_set, stages, peak)
