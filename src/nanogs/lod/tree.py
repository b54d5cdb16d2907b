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
from nanogs.io.in_order import in_order
from nanogs.lod.links import Shapes, parents_of, shapes_of
from nanogs.method.extent import Dilation, dilation
from nanogs.method.nodes import (
    LIGHTEST,
    Nodes,
    activate_nodes,
    gather,
    thinnest_axis,
    without_features,
)
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


@dataclass(frozen=True, slots=True)
class Layer:
    """A level of the tree.

    Attributes:
        means: (N, 3) float64 centres of its splats, which say what lies near what, scene units.
        parents: (N,) the row of each one's parent in the next coarser layer; none of the last.
    """

    means: F64
    parents: I64


class Linking:
    """Links levels to each other as they come, of which only their shapes are held.

    Args:
        threads: To search with; None for all.
        first: The number of the first level, for messages.
    """

    def __init__(self, threads: int | None = None, first: int = 0) -> None:
        self._layers: list[Layer] = []
        self._threads, self._first = threads, first
        self._shapes: Shapes | None = None

    def add(self, level: Source) -> None:
        """Link the next coarser level to the last one.

        Where it has more splats than that, as a part of a scene can, that is taken once more.

        Args:
            level: One splat or more.

        Raises:
            OptionError: A splat would stand for more others than a row can.
        """
        coarse, fine = shapes_of(level), self._shapes
        self._shapes = coarse
        if fine is None:
            return
        if level.count > len(fine.means):
            parents, self._shapes = np.arange(len(fine.means)), fine
        else:
            parents = parents_of(fine, coarse, self._threads)
        refuse_many(np.bincount(parents), self._first + len(self._layers))
        self._layers.append(Layer(fine.means, parents))

    def finished(self, steps: int | None = None) -> list[Layer]:
        """All levels, and those above the last one; no more can be added.

        Args:
            steps: As `above` takes it.
        """
        assert self._shapes is not None, "there is one level at least"  # noqa: S101
        means, self._shapes = self._shapes.means, None
        return [*self._layers, *above(means, steps)]


def refuse_many(children: I64, level: int) -> None:
    """Refuse what a row of a file cannot hold.

    Args:
        children: How many splats of a level each of the next one stands for.
        level: Its number.

    Raises:
        OptionError: One of these is too large.
    """
    if (most := int(children.max())) > MOST_CHILDREN:
        raise OptionError(
            f"A splat of level {level + 1} would stand for {most:,} of level {level}, and a .rad"
            f" file holds {MOST_CHILDREN:,}; give more levels between the two."
        )


def layers_of(
    levels: Sequence[Source],
    threads: int | None = None,
    *,
    first: int = 0,
    steps: int | None = None,
) -> list[Layer]:
    """Link levels to each other, and add those above.

    Args:
        levels: From the finest to the coarsest, each of 1 splat or more.
        threads: As `Linking` takes it.
        first: As `Linking` takes it.
        steps: As `above` takes it.

    Raises:
        OptionError: A splat would stand for more others than a row can.
    """
    linking = Linking(threads, first)
    for level in levels:
        linking.add(level)
    return linking.finished(steps)


def above(means: F64, steps: int | None = None) -> list[Layer]:
    """The coarsest level and those above it, each of groups in the order of space.

    Args:
        means: (N, 3) centres of the coarsest level, scene units.
        steps: How many there are above it, however few splats they have; by default up to one
            splat.
    """
    found: list[Layer] = []
    while len(means) > 1 if steps is None else len(found) < steps:
        parents = np.empty(len(means), np.int64)
        parents[morton_order(means)] = np.arange(len(means)) // _TOGETHER
        found.append(Layer(means, parents))
        sizes = np.bincount(parents)
        sums = [np.bincount(parents, means[:, axis]) for axis in range(3)]
        means = np.stack(sums, axis=1) / sizes[:, None]
    return [*found, Layer(means, np.empty(0, np.int64))]


@dataclass(frozen=True, slots=True)
class Tree:
    """Which rows stand for which, of rows in the order of the file.

    Attributes:
        counts: (N,) children of each, 0 of leaves.
    """

    counts: I64

    @property
    def starts(self) -> I64:
        """(N,) the first child of each; 0 of leaves."""
        starts = np.cumsum(self.counts) - self.counts + 1  # they come in the order of their parents
        return np.where(self.counts > 0, starts, 0)

    def children(self, start: int, stop: int) -> I64:
        """How many children rows have."""
        return self.counts[start:stop]


def as_rows(leaves: Source, layers: Sequence[Layer]) -> tuple[Source, Tree]:
    """All splats of a tree as rows, the root first, and what says which stand for which.

    Args:
        leaves: The finest level.
        layers: From that to the root, as `layers_of` gives them.
    """
    made = build(leaves, layers, units_of(leaves))
    return Joined(made.layers[::-1]), Tree(np.concatenate(made.children[::-1]))


class Built(NamedTuple):
    """Layers whose splats are there, each in the order of the file.

    Attributes:
        layers: The splats of each, the finest first.
        children: Of each, how many rows of the layer before each row stands for.
        order: (N,) the row of the leaves, as they were given, that comes first, and so on.
        nodes: Of the last layer, without features.
    """

    layers: Sequence[Source]
    children: Sequence[I64]
    order: I64
    nodes: Nodes


def build(
    leaves: Source, layers: Sequence[Layer], units: "Units", nodes: Nodes | None = None
) -> Built:
    """Make the splats that stand for others, by the moments of all leaves below them.

    Args:
        leaves: The finest layer.
        layers: From that to the last; the last may have several rows.
        units: What nodes are made with.
        nodes: Of the leaves, without features, if they stand for others themselves.
    """
    orders, children = _places(layers)
    order = orders[0]
    made: list[Source] = [in_order(leaves, order)]
    moments = None if nodes is None else without_features(nodes, order)
    for counts in children[1:]:
        splats, moments = _standing_for(made[-1], moments, counts, units)
        made.append(InMemory(splats))
    if moments is None:
        alone = _nodes(made[0].load(), None, slice(None), units)
        moments = without_features(alone, slice(None))
    return Built(made, children, order, moments)


def _places(layers: Sequence[Layer]) -> tuple[list[I64], list[I64]]:
    """Of each layer its rows in the order of the file, and how many children each of these has."""
    orders, children = [morton_order(layers[-1].means)], []
    for layer in reversed(layers[:-1]):
        places = np.empty(len(orders[-1]), np.int64)
        places[orders[-1]] = np.arange(len(places))
        own = places[layer.parents]
        children.append(np.bincount(own, minlength=len(places)))
        orders.append(np.lexsort((morton_codes(layer.means), own)))
    children.append(np.zeros(len(orders[-1]), np.int64))
    return orders[::-1], children[::-1]


class Units(NamedTuple):
    """Values by which splats are made nodes; see `activate_nodes`."""

    origin: F64
    added: Dilation
    thinnest: float
    usual: float  # coverage, square scene units


def units_of(leaves: Source) -> Units:
    """By some of the leaves."""
    some = leaves.take(np.arange(0, leaves.count, leaves.count // _SAMPLE + 1))
    means = some.means.astype(np.float64)
    origin = means.mean(axis=0)
    added = dilation(means - origin, some.opacities(), some.render_mode, _PIXELS)
    thinnest = thinnest_axis(some.scales(), means, added.least)
    rows: I32 = np.arange(len(some), dtype=np.int32)
    nodes = activate_nodes(some, rows, origin, added, thinnest)
    return Units(origin, added, thinnest, float(nodes.coverages.mean()) or 1.0)


def _standing_for(
    below: Source, moments: Nodes | None, counts: I64, units: Units
) -> tuple[Splats, Nodes]:
    """The splats of a layer, of the rows of the next finer one.

    Args:
        below: That one, in the order of the file.
        moments: Its nodes, without features; None for leaves.
        counts: How many rows each of the splats stands for, one after the other.
        units: Values by which the rows are made nodes; see `activate_nodes`.

    Returns:
        The splats, and their nodes without features.
    """
    ends = np.concatenate([[0], np.cumsum(counts)])
    cuts = np.unique([*np.searchsorted(ends, np.arange(0, ends[-1], _ROWS)), len(counts)])
    made, found = [], []
    for first, last in pairwise(cuts.tolist()):
        rows = slice(int(ends[first]), int(ends[last]))
        splats = below.read(rows.start, rows.stop)
        nodes = _nodes(splats, moments, rows, units)
        labels = np.repeat(np.arange(last - first, dtype=np.int32), counts[first:last])
        stored = store_groups(nodes, labels, splats, units.origin, units.added)
        # Groups are stored in the order of their heaviest members, which is theirs here.
        made.append(replace(stored.grown(_GROWTH), notes=()))
        found.append(without_features(gather(nodes, labels, last - first), slice(None)))
    return concatenate(made), joined_nodes(found)


def joined_nodes(parts: Sequence[Nodes]) -> Nodes:
    """Nodes without features, one after the other."""
    names = ("weights", "coverages", "means", "covariances")
    columns = {name: np.concatenate([getattr(each, name) for each in parts]) for name in names}
    return replace(parts[0], **columns)


def _nodes(splats: Splats, moments: Nodes | None, rows: slice, units: Units) -> Nodes:
    """Nodes of some rows, which weigh as much as they cover: then moments of moments are right."""
    own: I32 = np.arange(len(splats), dtype=np.int32)
    if moments is None:
        leaves = activate_nodes(splats, own, units.origin, units.added, units.thinnest)
        return replace(leaves, weights=np.maximum(leaves.coverages / units.usual, LIGHTEST))
    features = np.ascontiguousarray(splats.sh).reshape(len(splats), -1)
    some = without_features(moments, rows)
    # Of many that cover nothing the least weights have added up, which `area_needs` tells them by.
    weights = np.where(some.coverages <= LIGHTEST * units.usual, LIGHTEST, some.weights)
    return replace(some, weights=weights, features=features, rows=own)
