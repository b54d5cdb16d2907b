"""Vector operations of the rasteriser: the compiled ones agree with their plain Python."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nanogs.kernels import blending, blocks, gradients
from nanogs.kernels.blocks import BATCH, LANES, MIN_TRANSMITTANCE, SIDE, TILE
from nanogs.kernels.policy import kernel

Y, X = np.mgrid[:TILE, :TILE]
BLOCK, LANE = Y // SIDE * SIDE + X // SIDE, Y % SIDE * SIDE + X % SIDE


@kernel
def mark_compiled(shapes, j, marks):
    return blocks.mark_blocks(shapes, j, marks)


@kernel
def open_compiled(left):
    return blocks.open_blocks(left)


@kernel
def prefetch_compiled(array, row, column):
    blocks.prefetch(array, row, column)


@kernel
def blend_compiled(mark, block, shapes, values, left, weights, planes):
    blending.blend_block(mark, block, shapes, values, left, weights, planes)


@kernel
def add_compiled(mark, block, weights, values, c, planes):
    blending.add_block(mark, block, weights, values, c, planes)


@kernel
def probe_compiled(mark, block, weights, probes, p, sums):
    blending.probe_block(mark, block, weights, probes, p, sums)


@kernel
def total_compiled(sums, p, j):
    return blending.total(sums, p, j)


@kernel
def gradient_compiled(mark, j, shapes, values, left, behind, blocks_to_compute, trust, partial, e):
    gradients.gradient_blocks(
        mark, j, shapes, values, left, behind, blocks_to_compute, trust, partial, e
    )


def shape_of(u, v, inv_w, slope, inv_yy, opacity):
    """Compute the row that `raster.fetch` writes for a splat at (u, v) from the first pixel."""
    across, rise = inv_w / blocks.UNIT, inv_yy**0.5 / blocks.UNIT
    u, v = u - blocks.MIDDLE, v - blocks.MIDDLE
    start, faint = -across * (u - slope * v), -np.log(opacity) / 16
    return np.float32([start, across, -across * slope, -rise * v, rise, faint, np.nan, np.nan])


def alpha_of(u, v, inv_w, slope, inv_yy, opacity):
    """Compute the splat's alpha at each pixel of a tile, (16, 16) float64, without thresholds."""
    p = inv_w * (X - u - slope * (Y - v))
    return opacity * np.exp(-0.5 * (p * p + inv_yy * (Y - v) ** 2))


def some_splats(rng, count=BATCH):
    """Draw random rows of arguments for `shape_of`."""
    low, high = (-3, -3, 0.1, -2, 0.02, 0.05), (18, 18, 1.5, 2, 2, 1)
    return rng.uniform(low, high, (count, 6))


splats = st.tuples(
    st.floats(-40, 60), st.floats(-20, 40), st.floats(0.05, 1.8), st.floats(-3, 3),
    st.floats(0.01, 3), st.floats(1 / 250, 1),
)  # fmt: skip


@given(splats, st.integers(0, BATCH - 1))
def test_every_block_with_a_visible_pixel_is_marked(splat, j):
    shapes = np.full((BATCH, blocks.SHAPE), np.nan, np.float32)
    shapes[j] = shape_of(*splat)
    before = np.arange(LANES, dtype=np.uint32) & ~np.uint32(1 << j)
    results = []
    for mark in (blocks.mark_blocks, mark_compiled):
        marks = before.copy()
        bits = int(mark(shapes, j, marks))
        marked = marks != before
        assert ((marks ^ before)[marked] == 1 << j).all()
        assert bits == sum(1 << int(block) for block in np.flatnonzero(marked))
        results.append(marked)
    visible = np.zeros(LANES, bool)
    np.logical_or.at(visible, BLOCK, alpha_of(*splat) >= 1 / 255)
    for marked in results:
        assert marked[visible].all()


def test_few_blocks_without_a_visible_pixel_are_marked():
    rng = np.random.default_rng(0)
    marked = visible = 0
    for splat in some_splats(rng, 500):
        shapes, marks = shape_of(*splat)[None], np.zeros(LANES, np.uint32)
        marked += int(mark_compiled(shapes, 0, marks)).bit_count()
        visible += len(np.unique(BLOCK[alpha_of(*splat) >= 1 / 255]))
    assert visible <= marked < 1.15 * visible


def test_an_overflowing_splat_marks_no_block_and_blends_nothing():
    shapes = np.zeros((BATCH, blocks.SHAPE), np.float32)
    for k, start in enumerate((np.inf, np.nan, 1e30)):
        shapes[k, blocks.START], shapes[k, blocks.RISE] = start, 1
        left, weights = np.ones((LANES, LANES), np.float32), np.ones((BATCH, LANES), np.float32)
        planes = np.zeros((3, LANES, LANES), np.float32)
        for mark, blend in (
            (blocks.mark_blocks, blending.blend_block),
            (mark_compiled, blend_compiled),
        ):
            assert mark(shapes, k, np.zeros(LANES, np.uint32)) == 0
            blend(np.uint32(1 << k), 3, shapes, planes[0], left, weights, planes)
            assert (left == 1).all()
            assert not weights[k].any()
            assert not planes.any()


@pytest.mark.parametrize("seed", range(3))
def test_a_block_blends_its_splats_in_order(seed):
    rng = np.random.default_rng(seed)
    rows = some_splats(rng)
    if seed == 0:  # opaque: the transmittance runs out
        rows[:, 2:] = 0.02, 0.0, 0.0004, 0.9
    shapes = np.stack([shape_of(*row) for row in rows])
    values = rng.normal(size=(BATCH, 4)).astype(np.float32)
    mark = np.uint32(rng.integers(2**32))
    start = rng.normal(size=(4, LANES, LANES)).astype(np.float32)
    for block in (0, 6, 15):
        transmittance, weights, expected = (
            np.ones(LANES),
            np.zeros((BATCH, LANES)),
            start[:, block] + 0.0,
        )
        saturated = np.zeros(LANES, bool)
        for j in range(BATCH):
            if mark >> j & 1:
                alpha = np.minimum(alpha_of(*rows[j]), 0.99)
                alpha[alpha < 1 / 255] = 0
                alpha = alpha[block == BLOCK][np.argsort(LANE[block == BLOCK])]
                saturated |= transmittance * (1 - alpha) < MIN_TRANSMITTANCE
                weights[j] = np.where(saturated, 0, transmittance * alpha)
                transmittance = np.where(saturated, transmittance, transmittance * (1 - alpha))
                expected += values[j, :, None] * weights[j]
        for blend, add in (
            (blending.blend_block, blending.add_block),
            (blend_compiled, add_compiled),
        ):
            left, planes = np.ones((LANES, LANES), np.float32), start.copy()
            found = np.zeros((BATCH, LANES), np.float32)
            blend(mark, block, shapes, values, left, found, planes)
            add(mark, block, found, values, 3, planes)
            np.testing.assert_allclose(found, weights, atol=1e-5)
            np.testing.assert_allclose(abs(left[block]), transmittance, atol=1e-5)
            assert ((left[block] < 0) == saturated).all()
            np.testing.assert_allclose(planes[:, block], expected, atol=1e-4)
            others = np.arange(LANES) != block
            assert (left[others] == 1).all()
            assert (planes[:, others] == start[:, others]).all()
    assert saturated.any() == (seed == 0)


def test_probes_are_summed_pixel_by_pixel():
    rng = np.random.default_rng(4)
    weights = rng.normal(size=(BATCH, LANES)).astype(np.float32)
    probes = rng.normal(size=(2, LANES, LANES)).astype(np.float32)
    before = rng.normal(size=(2, BATCH, LANES)).astype(np.float32)
    mark = np.uint32(0b1011 << 20)
    expected = before.copy()
    expected[1, [20, 21, 23]] += weights[[20, 21, 23]] * probes[1, 5]
    for probe, total in (
        (blending.probe_block, blending.total),
        (probe_compiled, total_compiled),
    ):
        sums = before.copy()
        probe(mark, 5, weights, probes, 1, sums)
        np.testing.assert_allclose(sums, expected, atol=1e-6)
        assert total(sums, 1, 23) == pytest.approx(expected[1, 23].sum(), abs=1e-5)
        assert total(sums, 0, 7) == pytest.approx(before[0, 7].sum(), abs=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_compiled_gradients_agree_with_plain_python(seed):
    results = []
    for gradient in (gradients.gradient_blocks, gradient_compiled):
        rng = np.random.default_rng(seed)
        shapes = np.stack([shape_of(*row) for row in some_splats(rng)])
        values = rng.normal(size=(BATCH, 4)).astype(np.float32)
        behind, expected = rng.normal(size=(2, 4, LANES, LANES)).astype(np.float32)
        trust = rng.uniform(size=(LANES, LANES)).astype(np.float32)
        left = np.ones((LANES, LANES), np.float32)
        partial = np.full((12, gradients.SUMS), 7, np.float32)
        for j in range(10):
            mark = int(mark_compiled(shapes, j, np.zeros(LANES, np.uint32))) & ~(1 << j)
            gradient(mark, j, shapes, values, left, behind, expected, trust, partial, j + 1)
        results.append((left, behind, partial))
    for plain, compiled in zip(*results, strict=True):
        np.testing.assert_allclose(compiled, plain, rtol=1e-3, atol=1e-3)
    left, _, partial = results[0]
    assert left.min() < 0.5
    assert (np.abs(partial[1:11]).max(axis=0) > 0.1).all()
    assert (partial[[0, 11]] == 7).all()  # no other rows are written


def test_open_blocks_are_those_with_transmittance_left():
    left = np.full((LANES, LANES), -0.5, np.float32)
    for open_blocks in (blocks.open_blocks, open_compiled):
        assert open_blocks(left) == 0
    left[3, 15] = left[15, 0] = 0.1
    for open_blocks in (blocks.open_blocks, open_compiled):
        assert open_blocks(left) == 1 << 3 | 1 << 15


def test_prefetching_changes_nothing():
    array = np.arange(12.0).reshape(3, 4)
    prefetch_compiled(array, 2, 1)
    blocks.prefetch(array, 2, 1)
    assert array.ravel().tolist() == list(range(12))
