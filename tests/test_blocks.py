"""Vector operations of the rasteriser: compiled they do as their plain Python says."""

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
def prefetch_compiled(array, row):
    blocks.prefetch(array, row)


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
def gradient_compiled(mark, j, shapes, values, left, behind, wanted, trust, partial, e):
    gradients.gradient_blocks(mark, j, shapes, values, left, behind, wanted, trust, partial, e)


def shape_of(u, v, inv_w, slope, inv_yy, opacity):
    """Of a splat at (u, v) from the tile's first pixel, what `raster.fetch` writes of it."""
    across, rise = inv_w / blocks.UNIT, inv_yy**0.5 / blocks.UNIT
    u, v = u - blocks.MIDDLE, v - blocks.MIDDLE
    start, faint = -across * (u - slope * v), -np.log(opacity) / 16
    return np.float32([start, across, -across * slope, -rise * v, rise, faint, np.nan, np.nan])


def alpha_of(u, v, inv_w, slope, inv_yy, opacity):
    """(16, 16) float64 of a tile's pixels, without any threshold."""
    p = inv_w * (X - u - slope * (Y - v))
    return opacity * np.exp(-0.5 * (p * p + inv_yy * (Y - v) ** 2))


def some_splats(rng, count=BATCH):
    """Rows of what `shape_of` takes."""
    low, high = (-3, -3, 0.1, -2, 0.02, 0.05), (18, 18, 1.5, 2, 2, 1)
    return rng.uniform(low, high, (count, 6))


splats = st.tuples(
    st.floats(-40, 60), st.floats(-20, 40), st.floats(0.05, 1.8), st.floats(-3, 3),
    st.floats(0.01, 3), st.floats(1 / 250, 1),
)  # fmt: skip


@given(splats, st.integers(0, BATCH - 1))
def test_marks_hold_every_block_with_a_pixel_that_is_reached(splat, j):
    shapes = np.full((BATCH, blocks.SHAPE), np.nan, np.float32)
    shapes[j] = shape_of(*splat)
    before = np.arange(LANES, dtype=np.uint32) & ~np.uint32(1 << j)
    found = []
    for mark in (blocks.mark_blocks, mark_compiled):
        marks = before.copy()
        bits = int(mark(shapes, j, marks))
        reached = marks != before
        assert ((marks ^ before)[reached] == 1 << j).all()
        assert bits == sum(1 << int(block) for block in np.flatnonzero(reached))
        found.append(reached)
    seen = np.zeros(LANES, bool)
    np.logical_or.at(seen, BLOCK, alpha_of(*splat) >= 1 / 255)
    for reached in found:
        assert reached[seen].all()


def test_few_blocks_are_marked_in_vain():
    rng = np.random.default_rng(0)
    marked = seen = 0
    for splat in some_splats(rng, 500):
        shapes, marks = shape_of(*splat)[None], np.zeros(LANES, np.uint32)
        marked += int(mark_compiled(shapes, 0, marks)).bit_count()
        seen += len(np.unique(BLOCK[alpha_of(*splat) >= 1 / 255]))
    assert seen <= marked < 1.15 * seen


def test_a_number_too_large_for_float32_reaches_nothing():
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
def test_a_block_takes_its_splats_in_their_order(seed):
    rng = np.random.default_rng(seed)
    rows = some_splats(rng)
    if seed == 0:  # fill the tile
        rows[:, 2:] = 0.02, 0.0, 0.0004, 0.9
    shapes = np.stack([shape_of(*row) for row in rows])
    values = rng.normal(size=(BATCH, 4)).astype(np.float32)
    mark = np.uint32(rng.integers(2**32))
    start = rng.normal(size=(4, LANES, LANES)).astype(np.float32)
    for block in (0, 6, 15):
        light, weights, expected = np.ones(LANES), np.zeros((BATCH, LANES)), start[:, block] + 0.0
        full = np.zeros(LANES, bool)
        for j in range(BATCH):
            if mark >> j & 1:
                alpha = np.minimum(alpha_of(*rows[j]), 0.99)
                alpha[alpha < 1 / 255] = 0
                alpha = alpha[block == BLOCK][np.argsort(LANE[block == BLOCK])]
                full |= light * (1 - alpha) < MIN_TRANSMITTANCE
                weights[j] = np.where(full, 0, light * alpha)
                light = np.where(full, light, light * (1 - alpha))
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
            np.testing.assert_allclose(abs(left[block]), light, atol=1e-5)
            assert ((left[block] < 0) == full).all()
            np.testing.assert_allclose(planes[:, block], expected, atol=1e-4)
            others = np.arange(LANES) != block
            assert (left[others] == 1).all()
            assert (planes[:, others] == start[:, others]).all()
    assert full.any() == (seed == 0)


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
def test_pulls_compiled_do_as_their_plain_python_says(seed):
    ways = []
    for gradient in (gradients.gradient_blocks, gradient_compiled):
        rng = np.random.default_rng(seed)
        shapes = np.stack([shape_of(*row) for row in some_splats(rng)])
        values = rng.normal(size=(BATCH, 4)).astype(np.float32)
        behind, wanted = rng.normal(size=(2, 4, LANES, LANES)).astype(np.float32)
        trust = rng.uniform(size=(LANES, LANES)).astype(np.float32)
        left = np.ones((LANES, LANES), np.float32)
        partial = np.full((12, gradients.SUMS), 7, np.float32)
        for j in range(10):
            mark = int(mark_compiled(shapes, j, np.zeros(LANES, np.uint32))) & ~(1 << j)
            gradient(mark, j, shapes, values, left, behind, wanted, trust, partial, j + 1)
        ways.append((left, behind, partial))
    for plain, compiled in zip(*ways, strict=True):
        np.testing.assert_allclose(compiled, plain, rtol=1e-3, atol=1e-3)
    left, _, partial = ways[0]
    assert left.min() < 0.5
    assert (np.abs(partial[1:11]).max(axis=0) > 0.1).all()
    assert (partial[[0, 11]] == 7).all()  # no row but its own is written


def test_open_blocks_are_those_with_light():
    left = np.full((LANES, LANES), -0.5, np.float32)
    for ask in (blocks.open_blocks, open_compiled):
        assert ask(left) == 0
    left[3, 15] = left[15, 0] = 0.1
    for ask in (blocks.open_blocks, open_compiled):
        assert ask(left) == 1 << 3 | 1 << 15


def test_prefetching_changes_nothing():
    array = np.arange(12.0).reshape(3, 4)
    prefetch_compiled(array, 2)
    blocks.prefetch(array, 2)
    assert array.ravel().tolist() == list(range(12))
