"""Memory of the presets that grow a forest: bytes a splat, stage by stage."""

from nanogs.method.parameters import ForestParameters
from nanogs.pipeline.presets import renders
from nanogs.pipeline.weights import fit_parameters
from nanogs.protocol import PIXELS, VIEWS
from nanogs.slices import IN_HAND

_F4, _F8, _I4, _I8 = 4, 8, 4, 8
_BARE = _F8 + 3 * _F8 + 6 * _F8 + _I4  # weights, means, covariances, row: what growing needs
_NODE = _BARE + _F8  # and coverages
_MIXED = _I4 + 2 * _F8  # of a pair of splats, whose features are theirs: second row and shares
_MERGE = 2 * _I4 + _I4 + 2 * _F4  # children, level and increments, one a merge
_TREE = 3 * _F8 + _I4 + 12 + 1  # scaled centres and their rows, boxes, a flag
# Pairs for each splat and neighbour: both directions of most neighbours coincide. Measured 0.55 to
# 0.67 on trained scenes at k = 5 to 16; the plan takes the upper end.
_PAIRS_PER_NEIGHBOUR = 0.67
_LEFT = 0.55  # share of the nodes that a pass leaves; trained scenes: 0.52 to 0.56
_CUT = 2 * _F8 + _F8 + _F8 + 1  # sums and scores of all nodes, a copy for the median, flags
_TILES = 3  # tiles of a view of 560 pixels that a splat lies in, on average: 2.3 to 3.2
_IMAGES = VIEWS * PIXELS**2 * 3 * _F4  # pictures of the original, by which results are judged
PIXEL = 80  # bytes of a pixel of a view while it is drawn with contributions and depths
COMPARED = 64  # and while it is compared with the original's, or its pull is computed
_BATCH = 2 * _I4 + 2 * _F4 + 2 * _F8  # of a pair, in a batch of which the costs are computed
PREPARED = 9 * _F4 + 2 * _F4 + 1  # factors, alpha, reach and mask, as the rasteriser reads them
DRAWN = 8 * _F8 + 7 * _F4 + 4 * _I8 + _TILES * _I4  # one view's projection, order and lists
SHARES = 6 * _F8 + _TILES * _F4  # of every splat in a view and in all
_GROUPS = 12  # see `reassign.NEIGHBOURS`
# Tiles that a splat of the result lies in. In views of 560 pixels it is 3 to 8, for results of half
# and of a tenth of the splats. Measured, the rest of the plan is large enough to make up for that,
# but not in larger views.
_FIT_TILES = 2
# Of a splat that is drawn in a step: its projection, its sums, and those of its tiles.
FIT_STEP = 8 * _F8 + 8 * _F4 + 2 * _I8 + 25 * _F4 + _FIT_TILES * (25 * _F4 + _I4)
# Of a splat that is fitted: its curvatures, how many views it was in, its way.
_CURVATURES = (55 + 1 + 12) * _F4 + _I4


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
        judged: Whether results are held against the original on views held out.
    """
    looked = renders(parameters)
    drawn = looked or judged
    kept = count * (_I4 + (_F8 if looked else 0))  # which rows are used, what is visible of each
    pictures = parameters.views + parameters.pictured
    images = pictures * parameters.view_size**2 * 4 if looked else 0
    images += _IMAGES if judged else 0
    pixels = parameters.view_size**2 if looked else 0
    kept += images
    beside = kept + count * _F8  # the passes: the leaves' coverages
    leaves = kept + count * _NODE  # their features are the model's
    forest = leaves + count * _MERGE
    best = target * row if drawn else 0  # of those tried before
    draw = target * (PREPARED + DRAWN) + pixels * COMPARED if drawn else 0
    labels = 2 * count * _I4 if looked else count * _I4
    stages = {
        "measure": 2 * _IMAGES + count * (_I4 + PREPARED + DRAWN) if judged else 0,
        "look": images + pixels * PIXEL + count * (_I4 + PREPARED + DRAWN + SHARES)
        if looked
        else 0,
        "activate": leaves,
        **{stage: beside + held for stage, held in _growing(count, features, k).items()},
        "cut": forest + count * _CUT + labels + best,
        "reassign": forest + labels + best + _reassign(count, target, features)
        if parameters.rounds
        else 0,
        "store": forest + labels + best + target * row + max(draw, _store(count, target)),
        "fit": forest + best + pixels * COMPARED + _fit(count, target, features, parameters)
        if parameters.steps
        else 0,
    }
    return leaves, {stage: held for stage, held in stages.items() if held}


def graph_bytes(k: int) -> float:
    """Bytes a splat while the neighbours are searched for and made pairs."""
    pairs, neighbours = pairs_of(k), k * _I4
    starts = 2 * _I8
    return max(_TREE + neighbours, neighbours + starts + _I4 * pairs, _I8 + 2 * _I4 * pairs)


def match_bytes(k: int) -> float:
    """Bytes a splat of pairs, costs, flags, the cheapest pair of each row, and which were joined.

    What follows takes no more: batches of keys, and those of the matching in their order.
    """
    return pairs_of(k) * (2 * _I4 + _F4) + 1 + 2 * _I8


def pairs_of(k: int) -> float:
    """Pairs for each splat."""
    return _PAIRS_PER_NEIGHBOUR * k


def _growing(count: int, features: int, k: int) -> dict[str, int]:
    """The passes: splats; pairs of them, whose features are theirs; then nodes with their own."""
    nodes = (_BARE, _LEFT * (_BARE + _MIXED), _LEFT**2 * (_BARE + features))
    left = (1.0, _LEFT, _LEFT**2)
    # The order of the rows is a node's own in the first pass; then it is kept beside the nodes.
    held = [n + (1 - x) * _MERGE + (_I4 if x < 1 else 0) for n, x in zip(nodes, left, strict=True)]
    during = {
        "graph": graph_bytes(k),
        "cost": pairs_of(k) * (2 * _I4 + _F4) + _F8,
        "match": match_bytes(k) + _F8,
    }
    stages = {
        stage: max(h + x * more for h, x in zip(held, left, strict=True))
        for stage, more in during.items()
    }
    # What was chosen and what is kept of it, numbers, labels and flags of the nodes, and members.
    lists = (1 - _LEFT) * (6 * _I4 + 2 * _F4) + 3 * _I4 + 1 + _LEFT * 2 * _I8
    stages["merge"] = max(
        h + x * lists + n for h, x, n in zip(held, left, nodes[1:], strict=False)
    )  # fmt: skip
    whole = {stage: int(count * most) for stage, most in stages.items()}
    whole["cost"] += min(int(count * pairs_of(k)), IN_HAND) * _BATCH
    return whole


def _reassign(count: int, target: int, features: int) -> int:
    merged = target * (_NODE + features + 7 * _F8 + _GROUPS * _I4 + _TREE + _I8)
    return merged + count * (_I4 + 2 * _F8 + _F8 // 2)


def _store(count: int, target: int) -> int:
    """Labels in the order of the result and members; nodes, whose features the result takes."""
    return count * (2 * _I4 + _I8) + target * (_NODE + 2 * 6 * _F8 + 7 * _F4 + 3 * _I8)


def _fit(count: int, target: int, features: int, parameters: ForestParameters) -> int:
    """The state and what a step takes; and the original, where its views are drawn now."""
    held, step = fit_state(target, features, parameters), target * FIT_STEP
    if not parameters.further or parameters.pictured:
        return held + step
    return held + step + count * (PREPARED + DRAWN)


def fit_state(target: int, features: int, parameters: ForestParameters) -> int:
    """The state, its mean, after a first round the best so far, and curvatures."""
    states = 2 + (fit_parameters(parameters).rounds > 1)
    return target * (states * (features + 11 * _F8 + 1) + 22 * _F4 + _CURVATURES)
