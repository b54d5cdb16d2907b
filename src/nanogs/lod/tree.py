"""Levels of detail as one tree, in the order in which Spark wants its rows.

From the coarsest level up, splats near each other are merged four by four until one is left, the
root. A viewer draws some of a level beside some of others, whatever fits its number of splats; so
that these fit each other, each splat that stands for others is made anew of all leaves below it, by
their moments: what was fitted for a level as a whole would not show so.

Coarser rows come first, and within a level those near in space are near each other, children of one
parent side by side: so that a viewer that fetches chunks of rows sees the whole scene with the
first, and then what it needs of each region with few more.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from nanogs._types import I32, I64
from nanogs.errors import OptionError
from nanogs.io.in_order import in_order
from nanogs.io.rad.write import Tree
from nanogs.lod.links import parents_of, shapes_of
from nanogs.method.extent import Dilation, dilation
from nanogs.method.nodes import activate_nodes, stored_order
from nanogs.method.order import morton_codes, morton_order
from nanogs.method.store import store_groups
from nanogs.source import InMemory, Joined, Source
from nanogs.splats import Splats

MOST_CHILDREN = (1 << 16) - 1
_TOGETHER = 4  # splats that are merged above the coarsest level
_NO_PIXEL = Dilation(np.zeros((1, 3)), np.zeros(1), 0.0)
# Coarse splats are drawn where the scene is far away: the fewer pixels they are merged for, the
# rounder. With 128 to 256 three scenes looked best, and with axes that may grow by two.
_PIXELS = 160
_GROWTH = 2.0


@dataclass(frozen=True, slots=True)
class Layer:
    """A level of the tree.

    Attributes:
        splats: N splats.
        parents: (N,) the row of each one's parent in the next coarser layer; none of the root.
    """

    splats: Source
    parents: I64


def layers_of(levels: Sequence[Source]) -> list[Layer]:
    """Link levels to each other, and add those up to the root.

    Args:
        levels: From the finest to the coarsest, each of 1 splat or more and of no more than the
            one before.

    Raises:
        OptionError: A splat would stand for more others than a row can.
    """
    layers, shapes = [], shapes_of(levels[0])
    for number, (finer, coarser) in enumerate(pairwise(levels)):
        coarse = shapes_of(coarser)
        parents = parents_of(shapes, coarse)
        most = int(np.bincount(parents).max())
        if most > MOST_CHILDREN:
            raise OptionError(
                f"A splat of level {number + 1} would stand for {most:,} of level {number}, and a"
                f" .rad file holds {MOST_CHILDREN:,}; give more levels between the two."
            )
        layers.append(Layer(finer, parents))
        shapes = coarse
    return [*layers, *_upper(levels[-1].load(), levels[-1])]


def _upper(splats: Splats, source: Source) -> list[Layer]:
    """The coarsest level and those above it, up to one splat."""
    found = []
    while len(splats) > 1:
        splats, labels = _merged(splats)
        found.append(Layer(source, labels))
        source = InMemory(splats)
    return [*found, Layer(source, np.empty(0, np.int64))]


def _merged(splats: Splats) -> tuple[Splats, I64]:
    """Splats near each other merged, and which of the merged ones each became."""
    means = splats.means.astype(np.float64)
    labels = np.empty(len(splats), np.int32)
    labels[morton_order(means)] = np.arange(len(splats), dtype=np.int32) // _TOGETHER
    groups = int(labels.max()) + 1
    rows: I32 = np.arange(len(splats), dtype=np.int32)
    origin = means.mean(axis=0)
    nodes = activate_nodes(splats, rows, origin, _NO_PIXEL)
    stored = store_groups(nodes, labels, splats, origin, _NO_PIXEL, sheets=False)
    _, order, _ = stored_order(nodes, labels, groups)
    places = np.empty(groups, np.int64)
    places[order] = np.arange(groups)
    return stored.grown(np.inf), places[labels]


def remade(layers: Sequence[Layer]) -> list[Layer]:
    """Make each splat that stands for others anew of all leaves below it, all held in memory.

    Args:
        layers: As `layers_of` gives them.
    """
    leaves = layers[0].splats.load()
    means = leaves.means.astype(np.float64)
    origin = means.mean(axis=0)
    added = dilation(means - origin, leaves.opacities(), leaves.render_mode, _PIXELS)
    nodes = activate_nodes(leaves, np.arange(len(leaves), dtype=np.int32), origin, added)
    found = []
    source, places = layers[0].splats, np.arange(len(leaves))
    below = np.arange(len(leaves))  # of each leaf, the row in the layer that it belongs to
    for layer, coarser in pairwise(layers):
        below = layer.parents[below]
        labels, groups = below.astype(np.int32), coarser.splats.count
        stored = store_groups(nodes, labels, leaves, origin, added, sheets=False)
        _, order, _ = stored_order(nodes, labels, groups)
        above = np.empty(groups, np.int64)
        above[order] = np.arange(groups)
        parents = np.empty(len(places), np.int64)
        parents[places] = above[layer.parents]
        found.append(Layer(source, parents))
        source, places = InMemory(stored.grown(_GROWTH)), above
    return [*found, Layer(source, layers[-1].parents)]


def as_rows(layers: Sequence[Layer]) -> tuple[Source, Tree]:
    """All splats of a tree as rows, the root first, and what says which stand for which.

    Args:
        layers: From the finest to the root, as `layers_of` gives them.
    """
    count = sum(layer.splats.count for layer in layers)
    counts, starts = np.zeros(count, np.int64), np.zeros(count, np.int64)
    parts: list[Source] = [layers[-1].splats]
    order, base = np.zeros(1, np.int64), 0
    for layer in reversed(layers[:-1]):
        places = np.empty(len(order), np.int64)
        places[order] = np.arange(len(order))
        above = places[layer.parents]
        children = np.bincount(above, minlength=len(order))
        rows, first = slice(base, base + len(order)), base + len(order)
        counts[rows] = children
        starts[rows] = first + np.cumsum(children) - children
        means = np.concatenate([block.means for block in layer.splats.blocks()])
        order = np.lexsort((morton_codes(means.astype(np.float64)), above))
        parts.append(in_order(layer.splats, order))
        base = first
    return Joined(parts), Tree(counts, starts)
