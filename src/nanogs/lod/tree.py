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
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from nanogs._types import F64, I32, I64
from nanogs.errors import OptionError
from nanogs.io.in_order import Kept, in_order
from nanogs.io.rad.write import Tree
from nanogs.lod.links import parents_of, shapes_of
from nanogs.method.extent import Dilation, dilation
from nanogs.method.nodes import Nodes, activate_nodes, gather, thinnest_axis
from nanogs.method.order import morton_codes, morton_order
from nanogs.method.store import store_groups
from nanogs.source import InMemory, Joined, Source
from nanogs.splats import Splats, concatenate

MOST_CHILDREN = (1 << 16) - 1
_TOGETHER = 4  # splats that are merged above the coarsest level
# Coarse splats are drawn where the scene is far away: the fewer pixels they are merged for, the
# rounder. With 128 to 256 three scenes looked best, and with axes that may grow by two.
_PIXELS = 160
_GROWTH = 2.0
_SAMPLE = 1 << 16  # leaves that say what is usual
_ROWS = 1 << 15  # that are merged at a time, but for those of one parent
_LEAST_WEIGHT = 1e-9
_NO_FEATURES, _NO_ROWS = np.empty((0, 0), np.float32), np.empty(0, np.int32)


@dataclass(frozen=True, slots=True)
class Layer:
    """A level of the tree.

    Attributes:
        means: (N, 3) float64 centres of its splats, which say what lies near what, scene units.
        parents: (N,) the row of each one's parent in the next coarser layer; none of the root.
    """

    means: F64
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
    for number, coarser in enumerate(levels[1:]):
        coarse = shapes_of(coarser)
        parents = parents_of(shapes, coarse)
        most = int(np.bincount(parents).max())
        if most > MOST_CHILDREN:
            raise OptionError(
                f"A splat of level {number + 1} would stand for {most:,} of level {number}, and a"
                f" .rad file holds {MOST_CHILDREN:,}; give more levels between the two."
            )
        layers.append(Layer(shapes.means, parents))
        shapes = coarse
    return [*layers, *_upper(shapes.means)]


def _upper(means: F64) -> list[Layer]:
    """The coarsest level and those above it, each of groups in the order of space, up to one."""
    found = []
    while len(means) > 1:
        parents = np.empty(len(means), np.int64)
        parents[morton_order(means)] = np.arange(len(means)) // _TOGETHER
        found.append(Layer(means, parents))
        sizes = np.bincount(parents)
        sums = [np.bincount(parents, means[:, axis]) for axis in range(3)]
        means = np.stack(sums, axis=1) / sizes[:, None]
    return [*found, Layer(means, np.empty(0, np.int64))]


def as_rows(leaves: Source, layers: Sequence[Layer]) -> tuple[Source, Tree]:
    """All splats of a tree as rows, the root first, and what says which stand for which.

    Those that stand for others are made anew, by the moments of all leaves below them; but for some
    rows at a time, only these moments are held.

    Args:
        leaves: The finest level.
        layers: From that to the root, as `layers_of` gives them.

    Raises:
        OSError: A temporary file cannot be written, where the leaves are not in memory.
    """
    orders, children = _places(layers)
    parts = [in_order(leaves, orders[0])]
    frame, moments, held = _frame_of(leaves), None, isinstance(leaves, InMemory)
    for counts in children[1:]:
        made, moments = _standing_for(parts[-1], moments, counts, frame, held=held)
        parts.append(made)
    counts = np.concatenate(children[::-1])
    starts = np.cumsum(counts) - counts + 1  # children come in the order of their parents
    return Joined(parts[::-1]), Tree(counts, np.where(counts > 0, starts, 0))


def _places(layers: Sequence[Layer]) -> tuple[list[I64], list[I64]]:
    """Of each layer its rows in the order of the file, and how many children each of these has."""
    orders, children = [np.zeros(1, np.int64)], []
    for layer in reversed(layers[:-1]):
        places = np.empty(len(orders[-1]), np.int64)
        places[orders[-1]] = np.arange(len(places))
        above = places[layer.parents]
        children.append(np.bincount(above, minlength=len(places)))
        orders.append(np.lexsort((morton_codes(layer.means), above)))
    children.append(np.zeros(len(orders[-1]), np.int64))
    return orders[::-1], children[::-1]


class _Frame(NamedTuple):
    """What splats are made nodes with; see `activate_nodes`."""

    origin: F64
    added: Dilation
    thinnest: float
    usual: float  # coverage, square scene units


def _frame_of(leaves: Source) -> _Frame:
    """By some of the leaves."""
    some = leaves.take(np.arange(0, leaves.count, leaves.count // _SAMPLE + 1))
    means = some.means.astype(np.float64)
    origin = means.mean(axis=0)
    added = dilation(means - origin, some.opacities(), some.render_mode, _PIXELS)
    thinnest = thinnest_axis(some.scales(), means, added.least)
    rows: I32 = np.arange(len(some), dtype=np.int32)
    nodes = activate_nodes(some, rows, origin, added, thinnest)
    return _Frame(origin, added, thinnest, float(nodes.coverages.mean()) or 1.0)


def _standing_for(
    below: Source, moments: Nodes | None, counts: I64, frame: _Frame, *, held: bool
) -> tuple[Source, Nodes]:
    """The splats of a layer, of the rows of the next finer one.

    Args:
        below: That one, in the order of the file.
        moments: Its nodes, without features; None for leaves.
        counts: How many rows each of the splats stands for, one after the other.
        frame: See there.
        held: Whether the splats are held in memory.

    Returns:
        The splats, and their nodes without features.
    """
    ends = np.concatenate([[0], np.cumsum(counts)])
    cuts = np.unique([*np.searchsorted(ends, np.arange(0, ends[-1], _ROWS)), len(counts)])
    kept = None if held else Kept(below.columns)
    made, found = [], []
    for first, last in pairwise(cuts.tolist()):
        rows = slice(int(ends[first]), int(ends[last]))
        splats = below.read(rows.start, rows.stop)
        nodes = _nodes(splats, moments, rows, frame)
        labels = np.repeat(np.arange(last - first, dtype=np.int32), counts[first:last])
        stored = store_groups(nodes, labels, splats, frame.origin, frame.added, sheets=False)
        # Groups are stored in the order of their heaviest members, which is theirs here.
        own = replace(stored.grown(_GROWTH), notes=())
        made.append(own) if kept is None else kept.add(own)
        merged = gather(nodes, labels, last - first)
        found.append(replace(merged, features=_NO_FEATURES, rows=_NO_ROWS))
    names = ("weights", "coverages", "means", "covariances")
    columns = {name: np.concatenate([getattr(each, name) for each in found]) for name in names}
    return kept or InMemory(concatenate(made)), replace(found[0], **columns)


def _nodes(splats: Splats, moments: Nodes | None, rows: slice, frame: _Frame) -> Nodes:
    """Nodes of some rows, which weigh as much as they cover: then moments of moments are right."""
    own: I32 = np.arange(len(splats), dtype=np.int32)
    if moments is None:
        leaves = activate_nodes(splats, own, frame.origin, frame.added, frame.thinnest)
        return replace(leaves, weights=np.maximum(leaves.coverages / frame.usual, _LEAST_WEIGHT))
    return replace(
        moments,
        weights=moments.weights[rows],
        coverages=moments.coverages[rows],
        means=moments.means[rows],
        covariances=moments.covariances[rows],
        features=np.ascontiguousarray(splats.sh).reshape(len(splats), -1),
        rows=own,
    )
