"""Parallel sorting, compared with NumPy's stable sort."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nanogs import parallel, sorting
from nanogs.method.order import _quantiles
from nanogs.method.reassign import _ascending
from nanogs.sorting import stable_order
from nanogs.threads import use_threads


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("distinct_keys", [1, 2, 50, 1 << 63])
@pytest.mark.parametrize("count", [0, 1, 2, 1000, 3 << 16])
def test_the_order_is_that_of_a_stable_sort(count, distinct_keys, threads):
    keys = np.random.default_rng(count).integers(0, distinct_keys, count, dtype=np.uint64)
    with use_threads(threads):
        assert np.array_equal(stable_order(keys), np.argsort(keys, kind="stable"))


@given(st.lists(st.integers(0, 20) | st.integers(0, 2**64 - 1), max_size=200))
def test_few_keys_in_several_parts_are_sorted_stably(keys):
    array = np.array(keys, np.uint64)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sorting, "_LEAST", 8)
        with use_threads(2):
            assert np.array_equal(stable_order(array), np.argsort(array, kind="stable"))


@given(st.integers(1, 300), st.integers(0, 2**32 - 1), st.integers(-30, 30))
def test_quantiles_are_those_of_numpy_to_the_last_bit(count, seed, exponent):
    random = np.random.default_rng(seed)
    means = random.standard_normal((count, 3)) * 10.0**exponent
    means[random.random(count) < 0.2] = means[0]
    expected = np.quantile(means, (0.01, 0.99), axis=0)
    assert _quantiles(means, (0.01, 0.99)).tobytes() == expected.tobytes()


@given(
    st.lists(st.sampled_from([0.0, -0.0, 1.0, -3.0, np.nan, np.inf]) | st.floats(), max_size=60),
    st.integers(0, 70),
)
def test_ascending_gives_rows_by_value_and_ties_by_row(values, first):
    array = np.array(values)
    assert list(_ascending(array, first)) == np.argsort(array, kind="stable").tolist()


@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_for_each_does_each_part_once(count):
    parts = []
    with use_threads(2):
        parallel.for_each(range(count), parts.append)
    assert sorted(parts) == list(range(count))
