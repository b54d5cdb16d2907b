"""Levels of detail as one tree, with rows in the order that Spark expects.

Above the coarsest level, neighbouring splats are merged four by four until one is left, the root. A
viewer draws a cut through the tree that fits its budget of splats, so splats of different levels
are next to each other. For these to match, each inner splat is computed from the moments of all
leaves below it, not taken from its level, whose splats were fitted as a whole.

Coarser rows come first. Within a level, rows are sorted by position, and children of one parent are
contiguous: a viewer that fetches chunks of rows gets the whole scene with the first one, and then
needs few more for each region.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from nanogs._types import F64, I32, I64, Array
from nanogs.block_layouts import TOGETHER
from nanogs.errors import ManyChildrenError
from nanogs.io.in_order import in_order
from nanogs.lod.links import Shapes, parents_of, shapes_of
from nanogs.method.growth import effective_counts
from nanogs.method.nodes import (
    LIGHTEST,
    Nodes,
    activate_nodes,
    gather,
    thinnest_axis,
    typical_weight,
    without_features,
)
from nanogs.method.order import morton_codes, morton_order
from nanogs.method.store import store_groups
from nanogs.method.viewers import Dilation, estimate_dilation
from nanogs.source import InMemory, Joined, Source
from nanogs.splats import Splats, concatenate

MOST_CHILDREN = (1 << 16) - 1
# Size in pixels of a splat's surroundings for `estimate_dilation`. Coarse splats are drawn far
# away: the fewer pixels they are merged for, the rounder they become. With 128 to 256, and axes
# that may grow by a factor of two, three scenes looked best.
_PIXELS = 160
_GROWTH = 2.0
_SAMPLE = 1 << 16  # about the number of leaves from which `TreeUnits` are computed
_ROWS = 1 << 15  # rows merged at a time; more if one parent has more children


@dataclass(frozen=True, slots=True)
class Layer:
    """A layer of the tree: the positions of its nodes and the links to their parents.

    Attributes:
        means: (N, 3) float64 centres of its splats, by which rows are sorted, scene units.
        parents: (N,) int64, row of each one's parent in the next coarser layer; empty for the last.
    """

    means: F64
    parents: I64


class Linking:
    """An incremental builder of layers that links each level to the previous one.

    Of the levels, only the `Shapes` of the last and the `Layer` of others are held.

    Args:
        first: The number of the first level, for messages.
    """

    def __init__(self, first: int = 0) -> None:
        self._layers: list[Layer] = []
        self._first = first
        self._shapes: Shapes | None = None

    def add(self, level: Source) -> None:
        """Link the last level to the next coarser one.

        If that has more splats, as can happen for a block of a scene, the last level is repeated in
        its place; the whole tree has fewer splats at that level then.

        Args:
            level: The next level, of one splat or more.

        Raises:
            ManyChildrenError: A splat would have more than `MOST_CHILDREN`.
        """
        coarse, fine = shapes_of(level), self._shapes
        self._shapes = coarse
        if fine is None:
            return
        if level.count > len(fine.means):
            parents, self._shapes = np.arange(len(fine.means)), fine
        else:
            parents = parents_of(fine, coarse)
        refuse_many(np.bincount(parents), self._first + len(self._layers))
        self._layers.append(Layer(fine.means, parents))

    def finished(self, steps: int | None = None) -> list[Layer]:
        """Return the layers of all levels, and those above the last; no more can be added.

        Args:
            steps: As `above` takes it.
        """
        assert self._shapes is not None, "there is one level at least"  # noqa: S101
        means, self._shapes = self._shapes.means, None
        return [*self._layers, *above(means, steps)]


def refuse_many(children: I64, level: int) -> None:
    """Refuse numbers of children that exceed `MOST_CHILDREN`, the limit of a `.rad` file.

    Args:
        children: Number of children in a level of each splat of the next coarser level.
        level: Number of the level of the children.

    Raises:
        ManyChildrenError: One of these is too large.
    """
    if (most := int(children.max())) > MOST_CHILDREN:
        raise ManyChildrenError(
            f"A splat of level {level + 1} would stand for {most:,} of level {level}, and a .rad"
            f" file holds {MOST_CHILDREN:,}; give more levels between the two."
        )


def layers_of(levels: Sequence[Source], *, first: int = 0, steps: int | None = None) -> list[Layer]:
    """Link levels to each other, add the layers above them, and return all layers.

    Args:
        levels: From the finest to the coarsest, each of 1 splat or more.
        first: As `Linking` takes it.
        steps: As `above` takes it.

    Raises:
        ManyChildrenError: A splat would have more than `MOST_CHILDREN`.
    """
    linking = Linking(first)
    for level in levels:
        linking.add(level)
    return linking.finished(steps)


def above(means: F64, steps: int | None = None) -> list[Layer]:
    """Return the layers of the coarsest level and above it, by grouping rows in Morton order.

    Args:
        means: (N, 3) centres of the coarsest level, scene units.
        steps: Number of layers above it, however few splats they have; by default as many as it
            takes to reach one splat.
    """
    found: list[Layer] = []
    while len(means) > 1 if steps is None else len(found) < steps:
        parents = np.empty(len(means), np.int64)
        parents[morton_order(means)] = np.arange(len(means)) // TOGETHER
        found.append(Layer(means, parents))
        sizes = np.bincount(parents)
        sums = [np.bincount(parents, means[:, axis]) for axis in range(3)]
        means = np.stack(sums, axis=1) / sizes[:, None]
    return [*found, Layer(means, np.empty(0, np.int64))]


@dataclass(frozen=True, slots=True)
class Tree:
    """The links of a tree from parents to children, with rows in the order of the file.

    Attributes:
        counts: (N,) number of children of each row, 0 for leaves.
    """

    counts: I64

    def children(self, start: int, stop: int) -> I64:
        """Return the number of children of rows `start` to `stop`."""
        return self.counts[start:stop]


def as_rows(leaves: Source, layers: Sequence[Layer]) -> tuple[Source, Tree]:
    """Build a tree; return all its splats as rows, the root first, and the links between them.

    Args:
        leaves: The finest level.
        layers: From that to the root, as `layers_of` returns them.
    """
    made = build(leaves, layers, tree_units_of(leaves))
    return Joined(made.layers[::-1]), Tree(np.concatenate(made.children[::-1]))


COLUMNS = ("weights", "coverages", "means", "covariances")  # of nodes without features


class Moments(NamedTuple):
    """The moments of all leaves below each of N inner splats.

    Attributes:
        nodes: N nodes, without features.
        counts: (N,) float64, as `effective_counts` gives them; 1 for leaves.
    """

    nodes: Nodes
    counts: F64

    @staticmethod
    def of(columns: Mapping[str, Array], counts: F64) -> "Moments":
        """Make moments of the nodes' `COLUMNS`, by name."""
        none, rows = np.empty((0, 0), np.float32), np.empty(0, np.int32)
        return Moments(Nodes(**columns, features=none, rows=rows), counts)

    def take(self, rows: I64) -> "Moments":
        """Return those of some rows."""
        return Moments(without_features(self.nodes, rows), self.counts[rows])

    @staticmethod
    def joined(parts: Sequence["Moments"]) -> "Moments":
        """Concatenate several of them."""
        columns = {
            name: np.concatenate([getattr(part.nodes, name) for part in parts]) for name in COLUMNS
        }
        return Moments.of(columns, np.concatenate([part.counts for part in parts]))


class Built(NamedTuple):
    """The layers of a tree with their splats, each in the order of the file.

    Attributes:
        layers: The splats of each layer, the finest first.
        children: For each layer, (N,) int64, number of children of each row in the next finer one.
        order: (N,) int64, the leaves' rows in the input, in the order of the file.
        moments: Of the last layer.
    """

    layers: Sequence[Source]
    children: Sequence[I64]
    order: I64
    moments: Moments


def build(
    leaves: Source, layers: Sequence[Layer], units: "TreeUnits", below: Moments | None = None
) -> Built:
    """Sort all layers and compute the inner splats from the moments of all leaves below them.

    Args:
        leaves: The finest layer.
        layers: From that to the last; the last may have several rows.
        units: Values for converting splats to nodes.
        below: Moments of the leaves, if these are inner splats of other trees.
    """
    orders, children = _places(layers)
    order = orders[0]
    made: list[Source] = [in_order(leaves, order)]
    moments = None if below is None else below.take(order)
    for each in children[1:]:
        splats, moments = _merged_layer(made[-1], moments, each, units)
        made.append(InMemory(splats))
    if moments is None:
        alone = _nodes(made[0].load(), None, slice(None), units)
        moments = Moments(without_features(alone, slice(None)), np.ones(len(alone)))
    return Built(made, children, order, moments)


def _places(layers: Sequence[Layer]) -> tuple[list[I64], list[I64]]:
    """Return, for each layer, its rows in the order of the file, and their numbers of children."""
    orders, children = [morton_order(layers[-1].means)], []
    for layer in reversed(layers[:-1]):
        places = np.empty(len(orders[-1]), np.int64)
        places[orders[-1]] = np.arange(len(places))
        own = places[layer.parents]
        children.append(np.bincount(own, minlength=len(places)))
        orders.append(np.lexsort((morton_codes(layer.means), own)))
    children.append(np.zeros(len(orders[-1]), np.int64))
    return orders[::-1], children[::-1]


class TreeUnits(NamedTuple):
    """The values with which splats are converted to nodes; see `activate_nodes`.

    Attributes:
        origin: (3,) float64, subtracted from the centres, scene units.
        dilation: The rasteriser's dilation by position, relative to the origin.
        thinnest: Shortest axis of any node, scene units.
        usual: Coverage of a typical splat, square scene units; see `typical_weight`.
    """

    origin: F64
    dilation: Dilation
    thinnest: float
    usual: float


def tree_units_of(leaves: Source) -> TreeUnits:
    """Compute `TreeUnits` from a sample of the leaves."""
    some = leaves.take(np.arange(0, leaves.count, leaves.count // _SAMPLE + 1))
    means = some.means.astype(np.float64)
    origin = means.mean(axis=0)
    dilation = estimate_dilation(means - origin, some.opacities(), some.render_mode, _PIXELS)
    thinnest = thinnest_axis(some.scales(), means, dilation.least)
    rows: I32 = np.arange(len(some), dtype=np.int32)
    nodes = activate_nodes(some, rows, origin, dilation, thinnest)
    return TreeUnits(origin, dilation, thinnest, typical_weight(nodes.coverages) or 1.0)


def _merged_layer(
    below: Source, moments: Moments | None, children: I64, units: TreeUnits
) -> tuple[Splats, Moments]:
    """Compute the splats of a layer by merging the rows of the next finer one.

    Args:
        below: The finer layer, in the order of the file.
        moments: Its moments; None for leaves.
        children: Number of children of each splat; children of one parent are contiguous.
        units: Values for converting rows to nodes; see `activate_nodes`.

    Returns:
        The splats, and their moments.
    """
    ends = np.concatenate([[0], np.cumsum(children)])
    cuts = np.unique([*np.searchsorted(ends, np.arange(0, ends[-1], _ROWS)), len(children)])
    made, found = [], []
    for first, last in pairwise(cuts.tolist()):
        rows = slice(int(ends[first]), int(ends[last]))
        splats = below.read(rows.start, rows.stop)
        nodes = _nodes(splats, moments, rows, units)
        counts = None if moments is None else moments.counts[rows]
        labels = np.repeat(np.arange(last - first, dtype=np.int32), children[first:last])
        stored = store_groups(nodes, labels, splats, units.origin, units.dilation, counts=counts)
        # `store_groups` sorts groups by their heaviest members: here this keeps their order.
        made.append(replace(stored.grown(_GROWTH), notes=()))
        bare = without_features(nodes, slice(None))  # the splats have the mean colours already
        merged = gather(bare, labels, last - first)
        like = effective_counts(nodes, labels, merged.coverages, counts)
        found.append(Moments(merged, like))
    return concatenate(made), Moments.joined(found)


def _nodes(splats: Splats, moments: Moments | None, rows: slice, units: TreeUnits) -> Nodes:
    """Return the nodes of some rows, with weights in proportion to their coverage.

    With these weights, moments that are merged from moments equal those merged from all leaves.
    """
    own: I32 = np.arange(len(splats), dtype=np.int32)
    if moments is None:
        leaves = activate_nodes(splats, own, units.origin, units.dilation, units.thinnest)
        return replace(leaves, weights=np.maximum(leaves.coverages / units.usual, LIGHTEST))
    features = np.ascontiguousarray(splats.sh).reshape(len(splats), -1)
    some = without_features(moments.nodes, rows)
    # `area_needs` recognises rows without coverage by the least weight; in merged rows, several
    # least weights have added up, so it is restored.
    weights = np.where(some.coverages <= LIGHTEST * units.usual, LIGHTEST, some.weights)
    return replace(some, weights=weights, features=features, rows=own)
