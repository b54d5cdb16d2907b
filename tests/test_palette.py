"""Palettes: the nearest entries are found by one sum, and in doubt by another, which counts."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from nanogs.io.palette import _Search
from nanogs.kernels.closest import LANES, TOGETHER, closest
from nanogs.kernels.kmeans import nearest_entries, squared_errors
from nanogs.kernels.policy import kernel
from nanogs.threads import use_threads


@kernel
def closest_compiled(factors, columns, squares, tiles, least, second, places):
    closest(factors, columns, squares, tiles, least, second, places)


@pytest.mark.parametrize("find", [closest, closest_compiled])
def test_the_two_least_sums_of_each_lane(find):
    rng = np.random.default_rng(1)
    factors = rng.normal(size=(TOGETHER, 9)).astype(np.float32)
    columns = rng.normal(size=(9, 5 * LANES)).astype(np.float32)
    squares = rng.normal(size=5 * LANES).astype(np.float32)
    for tiles in (1, 2, 5):
        least, second = np.empty((2, TOGETHER, LANES), np.float32)
        places = np.zeros((TOGETHER, LANES), np.int32)
        find(factors, columns, squares, tiles, least, second, places)
        sums = (squares + factors.astype(float) @ columns).reshape(TOGETHER, 5, LANES)[:, :tiles]
        assert np.array_equal(places, sums.argmin(axis=1))
        sums.sort(axis=1)
        assert least == pytest.approx(sums[:, 0], abs=1e-5)
        assert second == pytest.approx(sums[:, 1] if tiles > 1 else np.inf, abs=1e-5)


def searched(seed, step, scale, cells=3, points=400, dimensions=9):
    """A search after one round in which each point looks into all cells; entries have twins."""
    rng = np.random.default_rng(seed)

    def some(count):
        values = rng.normal(size=(count, dimensions))
        return ((np.rint(values / step) * step if step else values) * scale).astype(np.float32)

    shares = rng.integers(1, 90, cells)
    entries = some(shares.sum())
    entries[1::2] = entries[: 2 * (len(entries) // 2) : 2]
    around = np.argsort(rng.random((points, cells)), axis=1).astype(np.int32)
    bounds = np.concatenate([[0], np.cumsum(shares)])
    search = _Search(some(points), np.ones(points, np.float32), entries, around, bounds)
    search.assign(cells)
    return search


def counting(search, probes):
    """Labels by the sums that count, all of them."""
    labels = np.empty_like(search.labels)
    nearest_entries(
        np.arange(len(labels)), search.points, search.cells, probes, search.bounds, search.columns,
        search.squares, labels,
    )  # fmt: skip
    return labels


@given(st.integers(0, 99), st.sampled_from([0, 0.5, 2]), st.sampled_from([1, 1e-21, 1e-15, 1e17]))
@example(0, 2, 1)
@settings(deadline=None, max_examples=40)
def test_labels_are_those_of_the_sums_that_count(seed, step, scale):
    """Where distances are equal, or all but equal, as where they are not."""
    search = searched(seed, step, scale)
    assert np.array_equal(search.labels, counting(search, search.cells.shape[1]))


@given(st.integers(0, 99), st.sampled_from([0, 2]))
@settings(deadline=None, max_examples=20)
def test_rounds_that_look_at_moved_entries_alone_find_the_same(seed, step):
    search = searched(seed, step, 1, points=300)
    for probes in (1, 1, 1, 2, 3, 3, 3, 1):
        search.move()
        search.assign(probes)
        assert np.array_equal(search.labels, counting(search, probes))


@pytest.mark.parametrize("threads", [1, 2])
def test_entries_in_all_cells_are_the_nearest(threads):
    with use_threads(threads):
        search = searched(3, 0, 1, points=2000)
    points, entries = search.points.astype(float), search.centres
    every = ((points[:, None] - entries) ** 2).sum(axis=-1)
    found = every[np.arange(len(points)), search.labels]
    assert found == pytest.approx(every.min(axis=1), rel=1e-5)
    errors = np.empty(len(points), np.float32)
    squared_errors(search.points, search.columns, search.labels, errors)
    assert errors == pytest.approx(found, rel=1e-4)
