"""Nearest neighbours compared with their definition: all others sorted by (distance, row)."""

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

import reference_kernels as reference
from nanogs.kernels import lanes
from nanogs.neighbours import nearest_neighbours, nearest_to
from nanogs.threads import use_threads


def outliers(rng, n):
    means = rng.normal(size=(n, 3))
    means[rng.random(n) < 0.1] *= 1e6
    return means


PLACES = {
    "uneven": lambda rng, n: rng.normal(size=(n, 3)) * np.exp(3 * rng.normal(size=(n, 1))),
    "grid": lambda rng, n: rng.integers(0, 4, (n, 3)) * 0.1,
    "line": lambda rng, n: rng.integers(0, n, (n, 1)) * np.array([[0.1, 0.2, -0.3]]),
    "coincident": lambda rng, n: rng.normal(size=(4, 3))[rng.integers(0, 4, n)],
    "one place": lambda rng, n: np.full((n, 3), 0.3),
    "outliers": outliers,
    "offset": lambda rng, n: 1e8 + rng.normal(size=(n, 3)),
    "tiny": lambda rng, n: 1e-30 * rng.normal(size=(n, 3)),
    "huge": lambda rng, n: 1e200 * rng.normal(size=(n, 3)),
}


@given(
    st.sampled_from(list(PLACES)),
    st.integers(1, 150),
    st.integers(1, 20),
    st.integers(0, 2**32 - 1),
)
def test_neighbours_are_the_first_by_distance_and_row(places, n, k, seed):
    means = PLACES[places](np.random.default_rng(seed), n)
    scale = 2.0 ** {"tiny": 100, "huge": -600}.get(places, 0)
    expected = reference.nearest_neighbours(means * scale, k)
    assert nearest_neighbours(means, k).tolist() == expected


def test_distances_agree_with_scipy():
    rng = np.random.default_rng(2)
    means = rng.normal(size=(20_000, 3)) * np.exp(2 * rng.normal(size=(20_000, 1)))
    found = nearest_neighbours(means, 16)
    distances = np.linalg.norm(means[found] - means[:, None], axis=2)
    expected, _ = cKDTree(means).query(means, 17)
    assert np.allclose(distances, expected[:, 1:], rtol=1e-12)


@given(
    st.sampled_from(sorted(PLACES.keys() - {"huge"})),
    st.integers(1, 150),
    st.integers(0, 40),
    st.integers(0, 2**32 - 1),
)
def test_the_nearest_to_other_points_is_the_first_by_distance_and_row(places, n, others, seed):
    rng = np.random.default_rng(seed)
    means, other = PLACES[places](rng, n), PLACES[places](rng, others)
    x, y, z = np.moveaxis(other[:, None] - means, 2, 0)
    squares = x * x + y * y + z * z
    distances, nearest = nearest_to(other, means)
    assert np.array_equal(distances, np.sqrt(squares.min(axis=1)))
    assert np.array_equal(nearest, squares.argmin(axis=1))


def test_distances_to_other_points_agree_with_scipy():
    rng = np.random.default_rng(6)
    means = rng.normal(size=(20_000, 3)) * np.exp(2 * rng.normal(size=(20_000, 1)))
    points = rng.normal(size=(5_000, 3)) * np.exp(2 * rng.normal(size=(5_000, 1)))
    expected = cKDTree(means).query(points)
    for threads in range(1, min(2, numba.config.NUMBA_NUM_THREADS) + 1):
        with use_threads(threads):
            found = nearest_to(points, means)
        assert np.array_equal(found[0], expected[0])
        assert np.array_equal(found[1], expected[1])


@pytest.mark.parametrize("layout", ["uneven", "grid", "coincident"])
def test_the_thread_count_changes_nothing(layout):
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("needs two threads")
    means = PLACES[layout](np.random.default_rng(3), 5000)
    found = []
    for threads in (1, 2):
        with use_threads(threads):
            found.append(nearest_neighbours(means, 8))
    assert np.array_equal(*found)


def test_neighbours_of_coincident_centres_are_the_next_rows_of_their_group():
    means = np.random.default_rng(4).normal(size=(60_000, 3))
    group = np.sort(np.random.default_rng(5).permutation(60_000)[:50_000])
    means[group] = means[0]
    group = np.flatnonzero((means == means[0]).all(axis=1))
    found = nearest_neighbours(means, 8)
    next_ones = (np.arange(len(group))[:, None] + np.arange(1, 9)) % len(group)
    assert np.array_equal(found[group], group[next_ones])
    alone = np.setdiff1d(np.arange(60_000), group)[:50]
    for row in alone:
        squares = ((means - means[row]) ** 2).sum(axis=1)
        squares[row] = np.inf
        nearest = np.sort(squares)[:8]
        assert np.allclose(((means[found[row]] - means[row]) ** 2).sum(axis=1), nearest)


def test_centres_whose_squared_distances_underflow_still_have_neighbours():
    means = np.zeros((40, 3))
    means[:, 0] = np.arange(40) * 5e-324
    means[0] = 1.0
    found = nearest_neighbours(means, 4)
    assert all(len({row, *others}) == 5 for row, others in enumerate(found.tolist()))


@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_compiled_lanes_do_the_same_as_plain_python(seed, k):
    rng = np.random.default_rng(seed)
    points, boxes = rng.normal(size=48), np.sort(rng.normal(size=(2, 2, 3)), axis=1).reshape(2, 6)
    lists = np.sort(rng.integers(0, 1 << 31, (k, 16)).astype(np.int32), axis=0)[::-1].ravel()
    results = []
    for run in (all_operations, all_compiled):
        keys, own = np.zeros(48, np.int32), lists.copy()
        masks = np.zeros(3, np.int64)
        run(points, boxes, keys, own, masks, k)
        results.append((keys.tolist(), own.tolist(), masks.tolist()))
    assert results[0] == results[1]
    assert results[0][0][16] == (points[0::16] ** 2).sum().view(np.int64) >> 32


def all_operations(points, boxes, keys, lists, masks, k):
    lanes.distance_keys(points, 0.0, 0.0, 0.0, keys, 16)
    lanes.distance_keys(points, 0.5, -0.1, 0.2, keys, 32)
    lanes.box_keys(points, boxes, 1, keys)
    masks[0] = lanes.within(keys, 16, keys)
    masks[1] = lanes.within(keys, 16, lists)
    masks[2] = lanes.lowest_bit(masks[0] | 1 << 9)
    lanes.insert(lists, keys, 16, k)
    lanes.insert(lists, keys, 32, k)


all_compiled = numba.njit(all_operations)
