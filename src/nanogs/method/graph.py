"""The k nearest neighbours of every centre, as candidate pairs.

A stage of both methods; stage 2 of the published one.
"""

import numpy as np

from nanogs._types import F64, I32, I64, U32
from nanogs.kernels.pairs import count_pairs, fill_firsts, fill_seconds
from nanogs.neighbours import nearest_neighbours
from nanogs.slices import SLICE_PAIRS, slices


def neighbour_pairs(means: F64, k: int) -> I32:
    """List the pairs of rows of which one is among the k nearest neighbours of the other.

    Args:
        means: (N, 3) finite, scene units; nearby rows should be near in space.
        k: Neighbours of each row; the row itself is excluded by its index.

    Returns:
        (E, 2) int32, i < j in every row, each pair once, ascending; in column-major order in
        memory.
    """
    neighbours = nearest_neighbours(means, k)
    starts: I64 = np.empty(len(neighbours) + 1, dtype=np.int64)
    count_pairs(neighbours, starts)
    columns: I32 = np.empty((2, starts[-1]), dtype=np.int32)
    # 32 bits if the number of pairs allows: peak memory is reached here.
    width: type = np.uint32 if starts[-1] < 1 << 32 else np.int64
    nexts: U32 | I64 = starts[:-1].astype(width)
    fill_seconds(neighbours, starts, nexts, columns[1])
    del neighbours, nexts  # before the first column is written and takes memory
    fill_firsts(starts, columns[0])
    return columns.T


def random_pairs(n: int, k: int, seed: int) -> I32:
    """List random pairs of rows, to measure what choosing near neighbours is worth.

    Args:
        n: Number of rows.
        k: Partners that each row draws among the others, with replacement.
        seed: Seed of the draws.

    Returns:
        (E, 2) int32, i < j in every row, each pair once, ascending; in column-major order in
        memory.
    """
    if n < 2:
        return np.empty((0, 2), dtype=np.int32)
    generator = np.random.default_rng(seed)
    packed: I64 = np.empty(n * k, dtype=np.int64)
    for part in slices(len(packed), SLICE_PAIRS):
        rows = np.arange(part.start, part.stop) // k
        partners = generator.integers(0, n - 1, len(rows))
        partners += partners >= rows  # of the n - 1 others, the row itself left out
        packed[part] = np.minimum(rows, partners) << 32 | np.maximum(rows, partners)
    packed.sort()
    first = np.append(True, packed[1:] != packed[:-1])
    packed = packed[first]
    del first
    columns: I32 = np.empty((2, len(packed)), dtype=np.int32)
    np.right_shift(packed, 32, out=columns[0], casting="unsafe")
    np.bitwise_and(packed, 0xFFFFFFFF, out=columns[1], casting="unsafe")
    return columns.T
