"""Memory of the presets that grow a forest: bytes a splat, stage by stage."""

from nanogs.simplify.presets import ForestParameters

_F4, _F8, _I4, _I8 = 4, 8, 4, 8
_NODE = 2 * _F8 + 3 * _F8 + 6 * _F8 + _I4  # weights and coverages, means, covariances, row
_MERGE = 2 * _I4 + _I4 + 2 * _F4  # children, level and increments, one a merge
TREE = 2 * 3 * _F8 + _I4 + 12 + 1  # scaled centres, reordered ones and their rows, boxes, a flag
# Pairs for each splat and neighbour: both directions of most neighbours coincide. Measured 0.55 to
# 0.66 on trained scenes at k = 8 to 16; the plan takes the upper end.
PAIRS_PER_NEIGHBOUR = 0.66
_LEFT = 0.55  # share of the nodes that a pass leaves; trained scenes: 0.52 to 0.56
_TILES = 3  # tiles of a 256-pixel view that a splat lies in, on average at most
_PREPARED = 9 * _F4 + _F4 + 1  # factors, alpha and mask, as the rasteriser reads them
_DRAWN = 8 * _F8 + 4 * _F4 + 4 * _I8 + _TILES * _I4  # one view's projection, order and lists
_GROUPS = 12  # see `reassign.NEIGHBOURS`
_FIT_VIEWS, _FIT_PIXELS, _FIT_TILES = 38, 512 * 512, 6  # see `forest_pipeline.REFIT`
_FIT_SUMS = 10 + 55 + 1  # of each splat in double precision, twice, beside its colour


def forest_stages(
    count: int,
    row: int,
    features: int,
    k: int,
    parameters: ForestParameters,
    target: int,
    *,
    judged: bool,
) -> tuple[int, dict[str, int]]:
    """Bytes held from activation to delivery, and what each stage holds, these among it.

    Args:
        count: Splats in the input.
        row: Bytes of a stored splat.
        features: Bytes of its harmonics.
        k: Neighbours in the graph.
        parameters: Of the method.
        target: Splats in the largest result.
        judged: Whether results are rendered whatever the preset.
    """
    node, grown = _NODE + features, count * _MERGE
    rows = count * (_I8 + _F8)  # of the model, in the leaves' order, and what is visible of each
    leaves = rows + count * _NODE  # their features are the model's
    looked = parameters.measure or judged
    look = count * (_PREPARED + _DRAWN + 13 * _F8 + _TILES * _F4) if looked else 0
    # The passes after the first have fewer nodes, but features of their own.
    second = rows + int(_LEFT * (node + _MERGE) * count)
    result = target * (node + row + 4 * _F8)
    drawing = target * (row + _PREPARED + _DRAWN) if looked else 0
    best = target * row if looked else 0  # of those tried before
    match = int(count * (PAIRS_PER_NEIGHBOUR * k * (2 * _I4 + 2 * _F4 + _F4 + _F8) + 2 * _F8))
    graph = _graph(count, k)
    growing = {
        "graph": max(leaves + graph, second + int(_LEFT * graph)),
        "match": max(leaves + match, second + int(_LEFT * match)),
        "merge": max(leaves + second, second + int(_LEFT * second)),
    }
    fitted = 8 * _F8 + 4 * _TILES * _F4 + features if parameters.measure else 0
    beside = {
        "cut": grown + count * (6 * _F8 + 4 * _I4 + 2 * _I8),
        "reassign": _reassign(count, target, node, grown) if parameters.rounds else 0,
        "store": grown + count * (5 * _I4) + best + max(result, drawing),
        "recolour": grown + drawing + best + target * fitted if fitted else 0,
        "refit": grown + _refit(count, target, features) if parameters.refit else 0,
    }
    stages = {"look": look, "activate": rows + count * (_NODE + 17 * _F8)} | growing
    stages |= {stage: leaves + held for stage, held in beside.items() if held}
    return leaves, {stage: held for stage, held in stages.items() if held}


def _graph(count: int, k: int) -> int:
    pairs = PAIRS_PER_NEIGHBOUR * k
    return int(count * max(TREE + k * _I4, k * (_I4 + 1) + 2 * _I8 + 2 * _I4 * pairs))


def _reassign(count: int, target: int, node: int, grown: int) -> int:
    merged = target * (node + 7 * _F8 + _GROUPS * _I4 + TREE)
    return grown + merged + count * (5 * _I4 + 3 * _F8)


def _refit(count: int, target: int, features: int) -> int:
    images = _FIT_VIEWS * _FIT_PIXELS * 4 * 2
    drawing = count * (_PREPARED + _DRAWN + 8 * _F8)
    state = 2 * (11 * _F8 + features) + 2 * (_FIT_SUMS * _F8 + 2 * features)
    pulls = 25 * _F8 + _FIT_TILES * 25 * _F4 + 10 * _F8 + 2 * features
    return images + max(drawing, target * (_PREPARED + _DRAWN + features + state + pulls))
