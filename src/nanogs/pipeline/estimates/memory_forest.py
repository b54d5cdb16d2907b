"""Memory estimate of the presets that grow a forest: bytes per splat of each stage."""

from nanogs.method.parameters import ForestParameters
from nanogs.pipeline.options.presets import fit_parameters, renders
from nanogs.protocol import PIXELS, VIEWS
from nanogs.slices import pairs_in_flight

F4, F8, I4, I8 = 4, 8, 4, 8  # bytes of a float32, float64, int32 and int64
# Bytes of a node, a merge, a pair or a splat, unless a comment says otherwise:
_BARE = F8 + 3 * F8 + 6 * F8 + I4  # a node for growing: weight, mean, covariance, row
_NODE = _BARE + F8  # a node with its coverage
_MIXED = I4 + 2 * F8  # a pair in place of its features: its second row and the two shares
_MERGE = 2 * I4 + I4 + 2 * F4  # a merge: children, level and increments of error
_TREE = 3 * F8 + I4 + 12 + 1  # the nearest-neighbour tree: scaled centre, row, boxes, a flag
# Candidate pairs divided by splats times k: most neighbours are mutual and give one pair. Measured
# 0.55 to 0.67 on trained scenes at k = 5 to 16; the estimate takes the upper end.
_PAIRS_PER_NEIGHBOUR = 0.67
LEFT = 0.55  # share of the nodes that a pass leaves; trained scenes: 0.52 to 0.56
_CUT = 2 * F8 + F8 + F8 + 1  # sums and scores of all nodes, a copy for the median, flags
# Scores of all nodes, two copies of those of merges; sums and increments; two values of each splat;
# labels of all nodes.
_CORRECT = 2 * F8 + 2 * F8 + 2 * 2 * F8 + F8 + 2 * F8 + 2 * I4
_TILES = 3  # tiles that a splat overlaps in a view of 560 pixels, on average: 2.3 to 3.2
_IMAGES = VIEWS * PIXELS**2 * 3 * F4  # all images of the original by which results are scored
PIXEL = 80  # bytes of a pixel while a view is rendered with contributions and depths
COMPARED = 64  # bytes of a pixel while it is compared with the original's, or for its gradients
_BATCH = 2 * I4 + 2 * F4 + 2 * F8  # a pair in a batch whose costs are computed
PREPARED = 9 * F4 + 2 * F4 + 1  # rasteriser input: factors, alpha, reach (`reaches`), mask
DRAWN = 8 * F8 + 7 * F4 + 4 * I8 + _TILES * I4  # in one view: projection, order, tile lists
SHARES = 6 * F8 + _TILES * F4  # contributions of a splat in one view and in all
_GROUPS = 12  # see `reassign.NEIGHBOURS`
# Tiles that a splat of the result overlaps. In views of 560 pixels it is 3 to 8, for results of
# half and of a tenth of the splats. As measured, the rest of the estimate is large enough to make
# up for that, but not in larger views.
_FIT_TILES = 2
# A splat that is rendered in a step of the fit: its projection, its sums, and those of its tiles.
FIT_STEP = 8 * F8 + 8 * F4 + 2 * I8 + 25 * F4 + _FIT_TILES * (25 * F4 + I4)
# A splat that is fitted: Hessian entries, number of views it was in, `fit.state.displacements_of`.
_CURVATURES = (55 + 1 + 12) * F4 + I4


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
    """Estimate the bytes held from activation to delivery, and those held in each stage.

    The latter include the former.

    Args:
        count: Number of splats in the input.
        row: Bytes of a stored splat.
        features: Bytes of its harmonics.
        k: Number of neighbours in the graph.
        parameters: Parameters of the method.
        target: Number of splats in the largest result.
        judged: Whether results are compared with the original on held-out views.
    """
    looked = renders(parameters)
    drawn = looked or judged
    kept = count * (I4 + (F8 if looked else 0))  # the usable rows, the visibility of each splat
    pictures = parameters.views + parameters.pictured
    images = pictures * parameters.view_size**2 * 4 if looked else 0
    images += _IMAGES if judged else 0
    pixels = parameters.view_size**2 if looked else 0
    kept += images
    beside = kept + count * F8  # coverages of the leaves, kept during the passes
    leaves = kept + count * _NODE  # without features, which are those of the model
    forest = leaves + count * _MERGE
    best = target * row if drawn else 0  # the best candidate so far
    draw = target * (PREPARED + DRAWN) + pixels * COMPARED if drawn else 0
    corrections = parameters.corrections if parameters.guided else 0
    labels = (2 + corrections) * count * I4 if looked else count * I4
    labels += count * F8 if corrections else 0  # scores of the latest correction
    stages = {
        "measure": 2 * _IMAGES + count * (I4 + PREPARED + DRAWN) if judged else 0,
        "look": images + pixels * PIXEL + count * (I4 + PREPARED + DRAWN + SHARES) if looked else 0,
        "activate": leaves,
        **{stage: beside + held for stage, held in _growing(count, features, k).items()},
        "cut": forest + count * _CUT + labels + best,
        "correct": forest + count * _CORRECT + labels + best + draw if corrections else 0,
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
    """Return the bytes per splat of finding the nearest neighbours and making pairs of them."""
    pairs, neighbours = pairs_of(k), k * I4
    starts = 2 * I8
    return max(_TREE + neighbours, neighbours + starts + I4 * pairs, I8 + 2 * I4 * pairs)


def match_bytes(pairs: float) -> float:
    """Return the bytes per splat of matching its candidate pairs.

    These are the pairs with their costs, and for each row a flag, its cheapest pair and the one it
    was joined in. The steps after that, with sorted batches of keys and the matched pairs, take no
    more.
    """
    return pairs * (2 * I4 + F4) + 1 + 2 * I8


def pairs_of(k: int) -> float:
    """Return the number of candidate pairs per splat for `k` neighbours."""
    return _PAIRS_PER_NEIGHBOUR * k


def _growing(count: int, features: int, k: int) -> dict[str, int]:
    """Return the bytes of each stage of the passes: the most of the first three passes.

    In the first pass nodes are splats and in the second pairs of splats, both of which refer to
    features of the model; in the third, nodes have features of their own.
    """
    nodes = (_BARE, LEFT * (_BARE + _MIXED), LEFT**2 * (_BARE + features))
    left = (1.0, LEFT, LEFT**2)
    # In the first pass the row order is part of the nodes; later it is kept beside them.
    held = [n + (1 - x) * _MERGE + (I4 if x < 1 else 0) for n, x in zip(nodes, left, strict=True)]
    during = {
        "graph": graph_bytes(k),
        "cost": pairs_of(k) * (2 * I4 + F4) + F8,
        "match": match_bytes(pairs_of(k)) + F8,
    }
    stages = {
        stage: max(h + x * more for h, x in zip(held, left, strict=True))
        for stage, more in during.items()
    }
    # The chosen pairs and their merges; numbers, labels and flags of the nodes; member lists.
    lists = (1 - LEFT) * (6 * I4 + 2 * F4) + 3 * I4 + 1 + LEFT * 2 * I8
    stages["merge"] = max(
        h + x * lists + n for h, x, n in zip(held, left, nodes[1:], strict=False)
    )  # fmt: skip
    whole = {stage: int(count * most) for stage, most in stages.items()}
    whole["cost"] += min(int(count * pairs_of(k)), pairs_in_flight()) * _BATCH
    return whole


def _reassign(count: int, target: int, features: int) -> int:
    merged = target * (_NODE + features + 7 * F8 + _GROUPS * I4 + _TREE + I8)
    return merged + count * (I4 + F4 + 2 * F8 + F8 // 2)


def _store(count: int, target: int) -> int:
    """Return the bytes of storing: ordered labels, members, and nodes without features."""
    return count * (2 * I4 + I8) + target * (_NODE + 2 * 6 * F8 + 7 * F4 + 3 * I8)


def _fit(count: int, target: int, features: int, parameters: ForestParameters) -> int:
    """Return the bytes of the fit: its state, a step, and the original if it is rendered."""
    held, step = fit_state(target, features, parameters), target * FIT_STEP
    if not parameters.further or parameters.pictured:
        return held + step
    return held + step + count * (PREPARED + DRAWN)


def fit_state(target: int, features: int, parameters: ForestParameters) -> int:
    """Return the bytes of the fit's state: state, mean, best state so far, Hessian entries.

    The best state so far is only kept if there is more than one round.
    """
    states = 2 + (fit_parameters(parameters).rounds > 1)
    return target * (states * (features + 11 * F8 + 1) + 22 * F4 + _CURVATURES)
