"""Palettes: points that are cheap to merge share an entry, then move to the nearest one nearby."""

import os
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nanogs.io import palette as palettes
from nanogs.io.cells import by_label, nearby_cells
from nanogs.io.palette import palette
from nanogs.io.ward import _Nodes, _Table, merge_points, settle
from nanogs.kernels.closest import LANES, TOGETHER, closest
from nanogs.kernels.kmeans import nearest_cells
from nanogs.kernels.policy import kernel
from nanogs.kernels.ward import NOBODY
from nanogs.progress import ignore_progress
from nanogs.threads import use_threads


@kernel
def closest_compiled(factors, columns, squares, tiles, least, second, entries):
    closest(factors, columns, squares, tiles, least, second, entries)


@pytest.mark.parametrize("find_closest", [closest, closest_compiled])
def test_the_two_smallest_sums_of_each_lane_are_found(find_closest):
    rng = np.random.default_rng(1)
    factors = rng.normal(size=(TOGETHER, 9)).astype(np.float32)
    columns = rng.normal(size=(9, 5 * LANES)).astype(np.float32)
    squares = rng.normal(size=5 * LANES).astype(np.float32)
    for tiles in (1, 2, 5):
        least, second = np.empty((2, TOGETHER, LANES), np.float32)
        entries = np.full((TOGETHER, LANES), -1, np.int32)
        find_closest(factors, columns, squares, tiles, least, second, entries)
        sums = (squares + factors.astype(float) @ columns).reshape(TOGETHER, 5, LANES)[:, :tiles]
        assert np.array_equal(entries, sums.argmin(axis=1))
        sums.sort(axis=1)
        assert least == pytest.approx(sums[:, 0], abs=1e-5)
        assert second == pytest.approx(sums[:, 1] if tiles > 1 else np.inf, abs=1e-5)
    squares[:] = np.inf  # no columns at all
    find_closest(factors, columns, squares, 5, least, second, entries)
    assert np.isinf([least, second]).all()
    assert not entries.any()


# ---- finding partners --------------------------------------------------------------------------


def some_points(seed, count, step=0.0, dimensions=9):
    """Random values from -1 to 1; with a step only few values, so that many distances are equal."""
    values = np.random.default_rng(seed).uniform(-1, 1, (count, dimensions))
    return (np.rint(values / step) * step if step else values).astype(np.float32)


def cells_in_any_order(seed, count, cells):
    order = np.random.default_rng(seed).random((count, cells)).argsort(axis=1)
    return order.astype(np.int32)


def costs_of(points, weights):
    """Return the (N, N) float64 costs of merging each pair; infinite on the diagonal."""
    wide = points.astype(float)
    squares = ((wide[:, None] - wide) ** 2).sum(axis=-1)
    v, w = weights[:, None].astype(float), weights.astype(float)
    costs = squares * v * w / (v + w)
    np.fill_diagonal(costs, np.inf)
    return costs


@given(st.integers(0, 99), st.sampled_from([0, 0.5]), st.integers(2, 300), st.integers(1, 4))
@settings(deadline=None, max_examples=40)
def test_the_nearest_point_in_all_cells_is_found(seed, step, count, cells):
    """Of several at equal or nearly equal distance, the one with the lowest index is found."""
    points, weights = some_points(seed, count, step), np.ones(count, np.float32)
    nodes = _Nodes(points, weights, cells_in_any_order(seed, count, cells))
    nodes.prepare(np.arange(count))
    nodes.look(np.arange(count))
    costs = costs_of(points, weights)
    found, cost = nodes.partners[:, 0], nodes.costs[:, 0]
    assert cost == pytest.approx(costs.min(axis=1), rel=1e-5, abs=1e-7)
    if step:  # sums of such numbers have no rounding
        assert np.array_equal(found, costs.argmin(axis=1))


def test_partners_have_exact_costs_and_the_cheapest_is_first():
    rng = np.random.default_rng(2)
    points, weights = some_points(2, 400), rng.uniform(0.1, 9, 400).astype(np.float32)
    nodes = _Nodes(points, weights, cells_in_any_order(2, 400, 3))
    nodes.prepare(np.arange(400))
    nodes.look(np.arange(400))
    costs = costs_of(points, weights)
    exact = np.take_along_axis(costs, nodes.partners.astype(int), axis=1)
    assert nodes.costs == pytest.approx(exact, rel=1e-5)
    assert (np.diff(nodes.costs, axis=1) >= 0).all()
    assert all(len(set(row)) == len(row) for row in nodes.partners.tolist())


def test_all_points_are_compared_if_rounding_hides_the_nearest():
    """In single precision, squared lengths near 30 lose differences of a thousandth."""
    points = np.float32(1.9) + some_points(15, 300) / np.float32(1000)
    nodes = _Nodes(points, np.ones(300, np.float32), np.zeros((300, 1), np.int32))
    nodes.prepare(np.arange(300))
    nodes.look(np.arange(300))
    costs = costs_of(points, np.ones(300))
    assert nodes.costs[:, 0] == pytest.approx(costs.min(axis=1), rel=1e-3)


def test_a_point_alone_in_its_cells_finds_no_partner():
    points, cells = some_points(3, 40), np.full((40, 1), 1, np.int32)
    cells[7] = 0
    nodes = _Nodes(points, np.ones(40, np.float32), cells)
    nodes.prepare(np.arange(40))
    nodes.look(np.arange(40))
    assert (nodes.partners[7] == NOBODY).all()
    assert not np.isfinite(nodes.costs[7]).any()
    assert not (nodes.partners == 7).any()


# ---- merging -----------------------------------------------------------------------------------


def plain_ward_error(points, weights, size):
    """Return the squared error of Ward's method with one merge at a time."""
    means, weights = list(points.astype(float)), list(weights.astype(float))
    total = 0.0
    while len(means) > size:
        costs = costs_of(np.array(means), np.array(weights))
        a, b = np.unravel_index(costs.argmin(), costs.shape)
        total += costs[a, b]
        v, w = weights[a], weights[b]
        means[a] = (v * means[a] + w * means[b]) / (v + w)
        weights[a] = v + w
        del means[b], weights[b]
    return total


def squared_error(points, weights, labels):
    error = 0.0
    for label in np.unique(labels):
        members, w = points[labels == label].astype(float), weights[labels == label].astype(float)
        error += (w[:, None] * (members - np.average(members, axis=0, weights=w)) ** 2).sum()
    return error


@pytest.mark.parametrize("size", [1, 5, 40, 100, 129])
def test_merging_many_at_a_time_is_nearly_as_good_as_one_by_one(size):
    rng = np.random.default_rng(4)
    points, weights = some_points(4, 130), rng.uniform(0.2, 5, 130).astype(np.float32)
    cells = np.zeros((130, 1), np.int32)
    labels, home = merge_points(points, weights, cells, size, ignore_progress)
    assert np.array_equal(np.unique(labels), np.arange(size))
    assert home.tolist() == [0] * size
    error = squared_error(points, weights, labels)
    assert error <= 1.1 * plain_ward_error(points, weights, size) + 1e-9


def test_merged_points_become_their_weighted_mean_in_the_heavier_ones_row():
    rng = np.random.default_rng(16)
    points, weights = some_points(16, 200), rng.uniform(0.2, 5, 200).astype(np.float32)
    nodes, rows = _Nodes(points, weights, np.zeros((200, 1), np.int32)), np.arange(200)
    nodes.prepare(rows)
    nodes.look(rows)
    merged = nodes.merge(rows, 40)
    assert 10 < len(merged) == len(set(merged.tolist())) <= 40
    for a in merged:
        [b] = np.flatnonzero((nodes.parents == a) & (rows != a))
        assert weights[a] >= weights[b]
        v, w = float(weights[a]), float(weights[b])
        mean = (v * points[a].astype(float) + w * points[b]) / (v + w)
        assert nodes.points[a] == pytest.approx(mean, abs=1e-6)
        assert nodes.weights[a] == pytest.approx(v + w)
        assert nodes.lengths[a] == pytest.approx((mean**2).sum(), rel=1e-5)
        block = nodes.table.values.reshape(9, -1)
        assert np.array_equal(block[:, nodes.table.places[a]], nodes.points[a])
        assert np.isinf(nodes.table.squares[nodes.table.places[b]])
    others = (nodes.parents == rows) & ~np.isin(rows, merged)
    assert np.array_equal(nodes.points[others], points[others])


@given(st.integers(0, 99), st.integers(1, 4), st.sampled_from([0, 0.5, 1]), st.floats(0.05, 0.99))
@settings(deadline=None, max_examples=40)
def test_the_number_of_groups_is_as_requested(seed, cells, step, share):
    """In cells of any shape, with many equal points; the progress ends at the total."""
    points = some_points(seed, 300, step, dimensions=3)
    size = max(int(share * 300), 8 * cells)
    around = cells_in_any_order(seed, 300, cells)[:, : max(cells - 1, 1)]
    progress = []
    labels, home = merge_points(
        points, np.ones(300, np.float32), around, size, lambda *parts: progress.append(parts)
    )
    assert np.array_equal(np.unique(labels), np.arange(size))
    assert progress[-1] == (300 - size, 300 - size)
    settled = settle(points, np.ones(300, np.float32), around, labels, home)
    assert np.array_equal(np.unique(settled), np.arange(size))


def test_points_go_to_the_nearest_mean_and_no_group_is_left_empty():
    points, weights = some_points(5, 500), np.ones(500, np.float32)
    cells = cells_in_any_order(5, 500, 2)
    labels = np.random.default_rng(5).integers(0, 20, 500).astype(np.int32)
    labels[:20] = np.arange(20)
    settled = settle(points, weights, cells, labels, np.arange(20, dtype=np.int32) % 2)
    means = np.array([points[labels == k].mean(axis=0, dtype=float) for k in range(20)])
    distances = ((points[:, None].astype(float) - means) ** 2).sum(axis=-1)
    assert distances[np.arange(500), settled] == pytest.approx(distances.min(axis=1), rel=1e-5)
    # Two groups of the same mean: the first takes the points of both, and the second keeps its own.
    twins = np.repeat(some_points(6, 2), 2, axis=0) * np.float32([[1], [-1]] * 2)
    settled = settle(
        twins, weights[:4], np.zeros((4, 1), np.int32), np.int32([0, 0, 1, 1]), np.int32([0, 0])
    )
    assert sorted(np.unique(settled)) == [0, 1]


def test_a_table_has_each_point_once():
    points = some_points(7, 100)
    home = np.random.default_rng(7).integers(0, 5, 50).astype(np.int32)
    rows = np.arange(0, 100, 2)
    lengths, weights = (points**2).sum(axis=1), np.arange(1, 101, dtype=np.float32)
    table = _Table(points, lengths, weights, rows, home, 6)
    entries = table.holders[table.holders != NOBODY]
    assert np.array_equal(np.sort(entries), rows)
    assert np.isinf(table.squares[table.holders == NOBODY]).all()
    assert np.array_equal(table.squares[table.places[rows]], lengths[rows])
    assert np.array_equal(table.masses[table.places[rows]], weights[rows])
    for row in rows:
        cell = home[row // 2]
        block = table.values[9 * table.bounds[cell] :][: 9 * table.widths[cell]]
        column = block.reshape(9, -1)[:, table.places[row] - table.bounds[cell]]
        assert np.array_equal(column, points[row])


# ---- palettes ----------------------------------------------------------------------------------


@pytest.mark.parametrize("exponent", [-100, -60, 60, 110])
def test_labels_do_not_depend_on_the_unit(exponent):
    points = some_points(8, 3000, dimensions=24)
    found = palette(points, 700)
    scaled = palette(np.ldexp(points, exponent), 700)
    assert np.array_equal(scaled.labels, found.labels)
    assert np.array_equal(scaled.entries, np.ldexp(found.entries, exponent))


def test_a_common_offset_does_not_change_the_errors():
    points = np.round(some_points(9, 3000) * 4096) / np.float32(4096)
    found, shifted = palette(points, 700), palette(points + np.float32(512), 700)
    errors = [
        np.square(points - (each.entries[each.labels] - offset)).sum()
        for each, offset in ((found, 0), (shifted, 512))
    ]
    assert errors[1] == pytest.approx(errors[0], rel=0.01)


def test_entries_are_the_means_of_their_points():
    rng = np.random.default_rng(10)
    points, weights = some_points(10, 2000, dimensions=45), rng.uniform(0.1, 5, 2000)
    found = palette(points, 300, weights)
    assert len(found.entries) == 300
    for label in range(0, 300, 7):
        members = found.labels == label
        mean = np.average(points[members].astype(float), axis=0, weights=weights[members])
        assert found.entries[label] == pytest.approx(mean, abs=1e-6)


@settings(deadline=None)
@given(seed=st.integers(0, 9), rows=st.integers(1, 60), kinds=st.integers(1, 4))
def test_distinct_rows_are_found_even_if_their_keys_collide(seed, rows, kinds):
    rng = np.random.default_rng(seed)
    points = rng.integers(-1, 2, (kinds, 3)).astype(np.float32)[rng.integers(0, kinds, rows)]
    points[::2] *= np.float32(-1) if seed % 2 else np.float32(1)  # -0 is 0
    _, first = np.unique(points + np.float32(0), axis=0, return_index=True)
    for keys in (palettes._keys, lambda rows: np.zeros(len(rows), np.uint64)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(palettes, "_keys", keys)
            distinct, places, counts = palettes._distinct(points)
        assert np.array_equal(distinct, points[np.sort(first)])
        assert np.array_equal(distinct[places], points)
        assert np.array_equal(counts, np.bincount(places))


def test_keys_differ_where_rows_do():
    steps = np.arange(-200, 200, dtype=np.float32) / np.float32(8)  # each of few significant bits
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    assert len(np.unique(palettes._keys(grid))) == len(grid)


SAME = """
import sys
import numpy as np
from nanogs.io.palette import palette
points = np.random.default_rng(11).normal(size=(6000, 24)).astype(np.float32)
points[::3] = np.round(points[::3] * 2) / 2
found = palette(points, 900, np.random.default_rng(12).uniform(0.01, 9, 6000))
sys.stdout.write(f"{found.labels.tobytes().hex()} {found.entries.tobytes().hex()}")
"""


def test_scalar_and_vector_kernels_find_the_same_palette():
    found = [
        subprocess.run(
            [sys.executable, "-c", SAME],
            env={**os.environ, "NANOGS_SIMD": simd},
            capture_output=True,
            check=True,
            text=True,
        ).stdout
        for simd in ("0", "1")
    ]
    assert found[0] == found[1] != ""


def test_any_number_of_threads_finds_the_same_palette():
    points, found = some_points(13, 20_000, 0.25), []
    for threads in (1, 2):
        with use_threads(threads):
            found.append(palette(points, 3000))
    assert np.array_equal(found[0].labels, found[1].labels)
    assert np.array_equal(found[0].entries, found[1].entries)


def test_nearby_cells_are_listed_nearest_first():
    points = some_points(14, 4000)
    cells = nearby_cells(points, 12, 2)
    assert cells.shape == (4000, 2)
    assert (cells[:, 0] != cells[:, 1]).all()
    starts, order = by_label(cells[:, 0], 12)
    centres = [points[order[a:b]].mean(axis=0) for a, b in pairwise(starts)]
    distances = np.linalg.norm(points[:, None] - np.array(centres), axis=-1)
    listed_distances = np.take_along_axis(distances, cells.astype(int), axis=1)
    assert (listed_distances[:, 0] < listed_distances[:, 1]).mean() > 0.9
    assert (listed_distances[:, 0] <= distances.min(axis=1) + 1e-6).mean() > 0.8


@pytest.mark.parametrize("near", [1, 2])
@pytest.mark.parametrize("step", [0, 0.5])
@pytest.mark.parametrize("count", [2, 19, 200])
def test_the_nearest_centres_are_found(near, step, count):
    points, centres = some_points(15, 501, step), some_points(16, count, step)
    columns = np.zeros((9, -(-count // LANES) * LANES), np.float32)
    squares = np.full(columns.shape[1], np.inf, np.float32)
    columns[:, :count], squares[:count] = centres.T, np.square(centres).sum(axis=1)
    cells = np.empty((501, near), np.int32)
    nearest_cells(points, columns, squares, cells)
    distances = ((points[:, None].astype(float) - centres) ** 2).sum(axis=-1)
    expected = distances.argsort(axis=1, kind="stable")[:, :near]  # the earlier of equal ones
    assert np.array_equal(cells, expected)
