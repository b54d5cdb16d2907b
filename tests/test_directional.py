"""Colours of merged splats by direction, which presets that render nothing fit to their members."""

from itertools import product
from math import prod

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import reference_kernels as reference
from builders import random_splats, same_pixel
from nanogs.method.directional import RATE, STEPS, design, fit_colours
from nanogs.method.nodes import activate_nodes, gather, member_lists
from nanogs.method.store import store_groups
from nanogs.sh import basis
from nanogs.threads import use_threads

C0 = float(basis(np.array([[0.0, 0, 1]]), 0)[0, 0])


def nodes_of(splats):
    return activate_nodes(splats, np.arange(len(splats)), np.zeros(3), same_pixel(0.0))


def fitted(splats, labels, frames=None):
    """Return the coefficients of groups by the weighted mean, and as fitted, (G, C, 3) each."""
    nodes, groups = nodes_of(splats), int(labels.max()) + 1
    frames = np.tile(np.float32([1, 0, 0, 0]), (groups, 1)) if frames is None else frames
    means = gather(nodes, labels, groups).features
    colours = means.copy()
    fit_colours(nodes, *member_lists(labels, groups), frames, colours)
    return (each.reshape(groups, -1, 3) for each in (means, colours))


def flat_pair(first, second):
    """Two flat splats of degree 3, facing x and y, of one colour each."""
    splats = random_splats(2, degree=3)
    splats.means[:], splats.opacity_logits[:] = 0, 2
    splats.log_scales[:] = np.log([[0.001, 0.1, 0.1], [0.1, 0.001, 0.1]])
    splats.quats[:], splats.sh[:] = [1, 0, 0, 0], 0
    splats.sh[:, 0] = (np.array([first, second]) - 0.5) / C0
    return splats


def seen(colours, direction):
    values = basis(np.array([direction], float), round(len(colours) ** 0.5) - 1)[0]
    return np.maximum(0, 0.5 + values @ colours)


def test_the_design_integrates_polynomials_up_to_degree_seven():
    directions = design()
    assert directions.shape == (24, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-15)
    assert len(np.unique(directions.round(6), axis=0)) == 24
    for powers in product(range(8), repeat=3):
        if sum(powers) <= 7:
            # The mean of x^a y^b z^c over the sphere: 0 if one is odd (Folland, 2001).
            odd = any(power % 2 for power in powers)
            factors = [prod(range(power - 1, 0, -2)) for power in powers]
            expected = 0 if odd else prod(factors) / prod(range(sum(powers) + 1, 0, -2))
            mean = (directions ** np.array(powers)).prod(axis=1).mean()
            assert mean == pytest.approx(expected, abs=1e-12), powers


@settings(max_examples=20)
@given(st.integers(1, 4), st.integers(1, 9), st.integers(0, 1000))
def test_the_kernel_agrees_with_its_reference(degree, groups, seed):
    splats = random_splats(30, degree=degree, seed=seed)
    labels = np.random.default_rng(seed).integers(0, groups, 30).astype(np.int32)
    labels[:groups] = np.arange(groups)
    frames = random_splats(groups, seed=seed).unit_quats()
    means, colours = fitted(splats, labels, frames)
    nodes = nodes_of(splats)
    xx, xy, xz, yy, yz, zz = nodes.covariances.T
    covariances = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
    for group in range(groups):
        members = np.flatnonzero(labels == group)
        if len(members) == 1:
            assert np.array_equal(colours[group], means[group])
            continue
        directions = design() @ reference.rotation_matrix(frames[group]).T
        expected = reference.directional_colours(
            nodes.weights[members], covariances[members], splats.sh[members].astype(float),
            means[group].astype(float), directions, basis(directions, degree),
            min((degree + 1) ** 2, 16), [RATE] * STEPS,
        )  # fmt: skip
        np.testing.assert_allclose(colours[group], expected, atol=2e-5)


def test_flat_splats_show_most_of_their_colour_from_the_front():
    red, green = (0.9, 0.1, 0.1), (0.1, 0.9, 0.1)
    means, colours = fitted(flat_pair(red, green), np.zeros(2, np.int32))
    for direction in ((1, 0, 0), (0, 1, 0)):  # the weighted mean is the same from everywhere
        assert seen(means[0], direction)[:2] == pytest.approx([0.5, 0.5], abs=1e-3)
    assert seen(colours[0], (1, 0, 0))[0] > 0.7
    assert seen(colours[0], (-1, 0, 0))[0] > 0.7
    assert seen(colours[0], (0, 1, 0))[1] > 0.7
    assert seen(colours[0], (0, 0, 1))[:2] == pytest.approx([0.5, 0.5], abs=0.05)


def test_members_of_one_colour_keep_it():
    splats = random_splats(12, degree=3)
    splats.sh[:] = 0.1 * splats.sh[:1]
    _, colours = fitted(splats, np.zeros(12, np.int32))
    np.testing.assert_allclose(colours[0], splats.sh[0], atol=1e-6)


def test_so_many_members_that_shares_vanish_in_single_precision_keep_their_colour():
    splats = random_splats(1, degree=1).take(np.zeros(200_000, np.int64))
    means, colours = fitted(splats, np.zeros(len(splats), np.int32))
    np.testing.assert_allclose(colours, means, atol=2e-5)


def test_harmonics_below_black_do_not_darken_other_members():
    splats = flat_pair((0.6,) * 3, (-0.8,) * 3)  # one is drawn black, not darker than black
    means, colours = fitted(splats, np.zeros(2, np.int32))
    assert seen(means[0], (1, 0, 0)).max() == 0
    assert seen(colours[0], (1, 0, 0)).min() > 0.25
    splats.sh[:, 0] = (-3 - 0.5) / C0
    means, colours = fitted(splats, np.zeros(2, np.int32))
    assert np.array_equal(means, colours)  # all black: nothing to change


def test_harmonics_near_the_end_of_single_precision_stay_finite():
    splats = random_splats(6, degree=3)
    splats.sh[:] = np.where(splats.sh < 0, -3e38, 3e38)
    means, colours = fitted(splats, np.zeros(6, np.int32))
    assert np.isfinite(means).all()
    assert np.isfinite(colours).all()


@pytest.mark.parametrize("degree", [0, 2])
def test_only_results_that_are_not_measured_have_such_colours(degree):
    splats, labels = random_splats(200, degree=degree), np.repeat(np.arange(20, dtype=np.int32), 10)
    nodes, stored = nodes_of(splats), []
    for growth in (None, 1.25):
        groups = store_groups(nodes, labels, splats, np.zeros(3), same_pixel(0.0), growth=growth)
        stored.append(groups.model.sh)
    assert np.array_equal(*stored) == (degree == 0)


def test_the_colours_are_the_same_for_any_number_of_threads():
    splats = random_splats(4000, degree=3)
    labels = np.repeat(np.arange(1000, dtype=np.int32), 4)
    results = []
    for threads in (1, 2):
        with use_threads(threads):
            results.append([*fitted(splats, labels)][1].tobytes())
    assert results[0] == results[1]
