"""The sample of a model, its core, and the occupancy grid in which rays are stopped."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from nanogs.views.occupancy import CELLS, Grid, build_grid, capped, find_core, sample
from test_views import ball, cloud


def test_the_core_is_centred_on_its_extent_and_holds_its_splats_whole():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(4000, 3)) * 0.01
    points[:, 0] = 4 * rng.random(4000) ** 2  # half of them from 0 to 1
    assert find_core(sample(cloud(points, 0.01))).centre[0] == pytest.approx(1.92, abs=0.1)
    assert find_core(sample(cloud(ball(2000), 0.5))).radius == pytest.approx(1.5, abs=0.05)


def test_a_huge_area_counts_no_more_than_almost_all_others():
    assert capped(np.array([1.0] * 299 + [1000.0])).max() == 1


def test_a_splat_is_spread_over_its_centre_and_the_ends_of_its_longest_axes():
    """Each of the five points is in a cell of width 1, which is averaged with the one before."""
    splat = cloud(np.full((1, 3), 0.5))
    splat.log_scales[:] = np.log([3.0, 0.1, 2.0])
    sampled = sample(splat)
    found = build_grid(sampled, np.zeros(3), CELLS / 2)
    expected = np.zeros((CELLS + 2,) * 3)
    for x, z in ((0, 0), (3, 0), (-3, 0), (0, 2), (0, -2)):
        middle = np.array([x, 0, z]) + CELLS // 2 + 1  # there is a border of one cell
        for next_to in product((0, 1), repeat=3):
            expected[tuple(middle + next_to)] += sampled.areas[0] / 5 / 8
    np.testing.assert_allclose(found.depth, expected)
    of_two = build_grid(replace(sampled, stride=2), np.zeros(3), CELLS / 2)
    np.testing.assert_allclose(of_two.depth, 2 * expected)


def layer(depth):
    """Return a grid of cells of width 1 with one layer of an optical depth, from x 10 to 11."""
    depths = np.zeros((CELLS + 2,) * 3)
    depths[11] = depth
    return Grid(depths, np.zeros(3), 1.0)


@pytest.mark.parametrize(("depth", "stops"), [(2.0, True), (0.5, False)])
def test_a_ray_is_stopped_by_an_opaque_layer(depth, stops):
    origin, ahead = np.array([[0.5, 30, 30]]), np.array([[1.0, 0, 0]])
    [hit] = layer(depth).first_hits(origin, ahead, 40.0)
    assert 9.5 <= hit <= 11 if stops else hit == np.inf
    assert layer(depth).first_hits(origin, -ahead, 40.0).tolist() == [np.inf]


@pytest.mark.parametrize(
    ("depth", "x", "free"), [(0.6, 8.5, False), (0.6, 7.5, True), (0.4, 8.5, True)]
)
def test_a_place_is_free_if_nothing_opaque_is_within_two_cells(depth, x, free):
    assert layer(depth).free(np.array([x, 30.0, 30.0])) == free
