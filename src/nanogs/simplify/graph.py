"""Stage 2, graph: the k nearest neighbours of every centre, and the pairs they make."""

import sys

import numpy as np
from scipy.spatial import cKDTree

from nanogs._types import F64, I32, I64, U64, Bool
from nanogs.kernels.pairs import count_pairs, fill_pairs
from nanogs.simplify.order import morton_codes

_BLOCK = 1 << 16  # rows a query: bounds what the query returns in 64-bit numbers


def neighbour_pairs(means: F64, k: int, threads: int) -> I32:
    """Pairs of rows of which one is among the k nearest neighbours of the other.

    Args:
        means: (N, 3) finite, scene units; nearby rows should be near in space.
        k: Neighbours of each row; the row itself is excluded by its index.
        threads: Threads for the query.

    Returns:
        (E, 2) int32, i < j in every row, each pair once, ascending.
    """
    neighbours = nearest_neighbours(means, k, threads)
    packed: U64 = np.empty(count_pairs(neighbours), dtype=np.uint64)
    fill_pairs(neighbours, packed)
    del neighbours
    packed.sort()
    return _unpack(packed)


def random_pairs(n: int, k: int, seed: int) -> I32:
    """Pairs of rows of which one drew the other: what the graph's nearness is measured against.

    Args:
        n: Number of rows.
        k: Partners that each row draws among the others, with replacement.
        seed: Seed of the draws.

    Returns:
        (E, 2) int32, i < j in every row, each pair once, ascending.
    """
    if n < 2:
        return np.empty((0, 2), dtype=np.int32)
    rows = np.repeat(np.arange(n), k)
    partners = np.random.default_rng(seed).integers(0, n - 1, n * k)
    partners += partners >= rows  # of the n - 1 others, the row itself left out
    low, high = np.minimum(rows, partners), np.maximum(rows, partners)
    return _unpack(np.unique(low.astype(np.uint64) << np.uint64(32) | high.astype(np.uint64)))


def _unpack(packed: U64) -> I32:
    """(E, 2) int32 of (E,) packed pairs, in the same memory."""
    pairs = packed.view(np.int32).reshape(-1, 2)
    if sys.byteorder == "little":
        for start in range(0, len(pairs), _BLOCK):
            block = pairs[start : start + _BLOCK]
            block[:] = block[:, ::-1].copy()
    return pairs


def nearest_neighbours(means: F64, k: int, threads: int) -> I32:
    """Exact nearest neighbours of every row among the others.

    Coincident centres are each other's neighbours at distance zero. Of a group of more than k, no
    query can want more than k, so the tree holds only so many: a tree cannot split them, and a
    query would visit all.

    Args:
        means: (N, 3) finite, scene units.
        k: Neighbours wanted; fewer where N - 1 is less.
        threads: Threads for the query.

    Returns:
        (N, min(k, N - 1)) int32 rows, nearest first, never the row itself.
    """
    n = len(means)
    k = min(k, n - 1)
    neighbours = np.empty((n, k), dtype=np.int32)
    if k == 0:
        return neighbours
    in_tree, to_query = np.ones(n, dtype=bool), np.ones(n, dtype=bool)
    for group in coincident_groups(means, k):
        in_tree[group[k:]] = False
        to_query[group] = False
        steps = np.arange(1, k + 1) + np.arange(len(group))[:, None]
        neighbours[group] = group[steps % len(group)]
    _query(means, in_tree, to_query, neighbours, threads)
    return neighbours


def coincident_groups(means: F64, larger_than: int) -> list[I64]:
    """Groups of more than `larger_than` rows with exactly the same centre.

    Args:
        means: (N, 3) finite.
        larger_than: Groups of this size or less are not returned.
    """
    codes = morton_codes(means)
    order = np.argsort(codes, kind="stable")
    starts = np.flatnonzero(np.diff(codes[order], prepend=codes[order[0]] + np.uint64(1)))
    groups = []
    for cell in (
        np.split(order, starts[1:]) if _has_long_run(starts, len(codes), larger_than) else []
    ):
        if len(cell) > larger_than:
            _, inverse, sizes = np.unique(
                means[cell], axis=0, return_inverse=True, return_counts=True
            )
            groups += [cell[inverse == unique] for unique in np.flatnonzero(sizes > larger_than)]
    return groups


def _has_long_run(starts: I64, count: int, larger_than: int) -> bool:
    return bool((np.diff(starts, append=count) > larger_than).any())


def _query(means: F64, in_tree: Bool, to_query: Bool, neighbours: I32, threads: int) -> None:
    """Fill the neighbours of the rows to query from the tree of the rows in it."""
    k = neighbours.shape[1]
    tree_rows = np.flatnonzero(in_tree)
    query_rows = np.flatnonzero(to_query)
    tree = cKDTree(means[tree_rows], leafsize=16)
    for start in range(0, len(query_rows), _BLOCK):
        rows = query_rows[start : start + _BLOCK]
        _, found = tree.query(means[rows], k + 1, workers=threads)
        found = tree_rows[found]
        # One column goes: the row itself, or the last where others at distance zero hide it
        # (centres that are not equal, but so close that squares underflow).
        drop = found == rows[:, None]
        drop[~drop.any(axis=1), -1] = True
        neighbours[rows] = found[~drop].reshape(-1, k)
