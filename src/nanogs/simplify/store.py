"""Groups of splats as stored splats, a block of groups at a time."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from nanogs._types import F64, I32, I64
from nanogs.simplify.blocks import BLOCK_GROUPS, BLOCK_MEMBERS
from nanogs.simplify.nodes import Nodes, gather, member_lists, store_nodes, stored_order
from nanogs.splats import Splats


def store_groups(
    leaves: Nodes,
    labels: I32,
    splats: Splats,
    origin: F64,
    pixel: float,
    growth: float,
) -> Splats:
    """The model that groups make, as `gather` and `store_nodes` do; only the model is held whole.

    Args:
        leaves: N nodes, one a splat.
        labels: (N,) the group of each; no group is empty.
        splats: As `store_nodes` takes them, and so what follows.
        origin: (3,) scene units.
        pixel: Scene units.
        growth: Most that an axis may grow.
    """
    groups = int(labels.max()) + 1
    starts, members = member_lists(labels, groups)
    blocks = list(_blocks(starts))
    if len(blocks) == 1:
        merged = gather(leaves, labels, groups)
        return store_nodes(merged, leaves, labels, splats, origin, pixel, growth)
    _, order, _ = stored_order(leaves, labels, groups)
    places = np.empty_like(order)
    places[order] = np.arange(groups)
    result = _room(splats, groups)
    for block in blocks:
        sizes = np.diff(starts[block.start : block.stop + 1])
        some = leaves.take(members[starts[block.start] : starts[block.stop]])
        own = np.repeat(np.arange(len(sizes), dtype=np.int32), sizes)
        merged = gather(some, own, len(sizes))
        stored = store_nodes(merged, some, own, splats, origin, pixel, growth)
        _put(stored, result, np.sort(places[block]))  # both in the order of the input
    return result


def _blocks(starts: I64) -> Iterator[slice]:
    """Consecutive groups, with no more members than a block has, or one; starts: (G + 1,)."""
    groups, first = len(starts) - 1, 0
    while first < groups:
        full = int(np.searchsorted(starts, starts[first] + BLOCK_MEMBERS, side="right")) - 1
        end = min(max(full, first + 1), first + BLOCK_GROUPS, groups)
        yield slice(first, end)
        first = end


def _room(splats: Splats, count: int) -> Splats:
    """A model of so many splats with the columns of another one, not filled yet."""

    def like(column: np.ndarray) -> np.ndarray:
        return np.empty((count, *column.shape[1:]), column.dtype)

    return replace(
        splats,
        means=like(splats.means),
        log_scales=like(splats.log_scales),
        quats=like(splats.quats),
        opacity_logits=like(splats.opacity_logits),
        sh=like(splats.sh),
        extras={name: like(column) for name, column in splats.extras.items()},
    )


def _put(part: Splats, whole: Splats, rows: I64) -> None:
    whole.means[rows] = part.means
    whole.log_scales[rows] = part.log_scales
    whole.quats[rows] = part.quats
    whole.opacity_logits[rows] = part.opacity_logits
    whole.sh[rows] = part.sh
    for name, column in part.extras.items():
        whole.extras[name][rows] = column
