"""Vector operations of the rasteriser: compiled they do as their plain Python says."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nanogs.kernels import pixels, spans
from nanogs.kernels.policy import kernel
from nanogs.kernels.spans import PIXELS, ROWS, ROWS_OF, SECOND, SPLAT, TILE

CUT = np.float32(pixels.MIN_ALPHA)


@kernel
def blend_compiled(base, slope, q, opacity, first, left, at, weights, to):
    pixels.blend_pixels(base, slope, q, opacity, first, left, at, weights, to)


@kernel
def pair_compiled(pieces, k, bases, squares, starts, slopes, opacities, left, weights):
    pixels.blend_pair(pieces, k, bases, squares, starts, slopes, opacities, left, weights)


@kernel
def three_compiled(
    pieces, k, bases, squares, starts, slopes, opacities, left, weights, values, planes
):
    pixels.blend_pair_three(
        pieces, k, bases, squares, starts, slopes, opacities, left, weights, values, planes
    )


@kernel
def scale_compiled(values, j, c, weights, at, planes, to):
    pixels.add_scaled(values, j, c, weights, at, planes, to)


@kernel
def multiply_compiled(weights, at, probes, there, sums, to):
    pixels.add_products(weights, at, probes, there, sums, to)


@kernel
def span_compiled(
    u, v, w, slope, h, reach, first, light, bases, squares, starts, at, pieces, n, rows
):
    return spans.span_rows(
        u, v, w, slope, h, reach, first, light, bases, squares, starts, at, pieces, n, rows
    )


@kernel
def open_compiled(left, open_rows):
    return spans.any_open(left, open_rows)


@kernel
def prefetch_compiled(array, row):
    spans.prefetch(array, row)


PLAIN = (
    pixels.blend_pixels,
    pixels.blend_pair,
    pixels.blend_pair_three,
    pixels.add_scaled,
    pixels.add_products,
)
COMPILED = (blend_compiled, pair_compiled, three_compiled, scale_compiled, multiply_compiled)


@pytest.mark.parametrize("seed", range(3))
def test_blending_compiled_does_as_its_plain_python_says(seed):
    ways = []
    for blend, pair, three, scale, multiply in (PLAIN, COMPILED):
        rng = np.random.default_rng(seed)
        left = rng.uniform(-0.2, 1, (ROWS, TILE)).astype(np.float32)
        planes = rng.normal(size=(3, ROWS, TILE)).astype(np.float32)
        weights, sums = np.full(32, 7, np.float32), np.zeros(24, np.float32)
        values = rng.normal(size=(2, 4)).astype(np.float32)
        slopes, opacities = rng.uniform(0, 1, (2, 2)).astype(np.float32)
        bases, squares = rng.uniform(0, (1, 3), (SECOND, 2)).astype(np.float32).T.copy()
        starts = rng.integers(0, 9, 2 * SECOND).astype(np.int32)
        for _ in range(60):
            base, slope, q, opacity = np.float32([rng.normal(), *rng.uniform(0, (1, 3, 1))])
            place = int(rng.integers(32)) * 8
            blend(base, slope, q, opacity, place % 16, left, place, weights, 0)
            scale(values, 1, 2, weights, 0, planes, place)
            multiply(weights, 0, planes, place, sums, 8)
            rows = SPLAT + rng.permutation(ROWS)[:2]
            pieces = np.array([7, 7, *rows], np.uint32)
            pair(pieces, 2, bases, squares, starts, slopes, opacities, left, weights)
            three(
                pieces, 2, bases, squares, starts, slopes, opacities, left, weights, values, planes
            )
        ways.append((left, planes, weights, sums))
    for plain, compiled in zip(*ways, strict=True):
        np.testing.assert_allclose(compiled, plain, atol=1e-5, rtol=1e-5)
    left, _, weights, sums = ways[0]
    assert (left < 0).any()  # some pixels are full
    assert np.abs(sums[8:16]).max() > 0.1
    assert (weights[16:] < 7).any()


def test_a_number_too_large_for_float32_leaves_its_pixels_alone():
    left, weights = np.ones(8, np.float32), np.ones(8, np.float32)
    huge, one = np.float32(1e30), np.float32(1)
    for blend in (pixels.blend_pixels, blend_compiled):
        blend(huge, one, one, one, 0, left, 0, weights, 0)
        assert (left == 1).all()
        assert (weights == 0).all()


def pieces_of(span, splat, first, open_rows, n=0):
    """What `span_rows` writes: pieces, and the numbers of 8 rows."""
    bases, squares = np.zeros((2, SECOND), np.float32)
    starts = np.concatenate([np.zeros(SECOND), np.full(SECOND, PIXELS)]).astype(np.int32)
    pieces, at = np.zeros(64, np.uint32), 3 * SPLAT + first
    n = span(*splat, first, open_rows, bases, squares, starts, at, pieces, n, ROWS_OF)
    rows = slice(at, at + PIXELS)
    return pieces[:n], bases[rows], squares[rows], starts


splats = st.tuples(
    st.floats(-40, 60), st.floats(-20, 40), st.floats(0.05, 1.8), st.floats(-3, 3),
    st.floats(0.01, 3), st.floats(0.001, 11),
)  # fmt: skip


@given(splats, st.integers(0, 8), st.integers(0, 2**16 - 1))
def test_runs_hold_every_pixel_within_reach_of_open_rows_once(splat, first, light):
    u, v, inv_w, slope, inv_yy, reach = splat
    open_rows = np.array([light >> row & 1 for row in range(TILE)], np.int32)
    found = pieces_of(span_compiled, splat, first, open_rows)
    for plain, compiled in zip(
        pieces_of(spans.span_rows, splat, first, open_rows), found, strict=True
    ):
        np.testing.assert_allclose(compiled, plain, rtol=1e-5, atol=1e-5)
    pieces, bases, squares, starts = found
    covered = np.zeros((TILE, TILE), int)
    for piece in pieces.tolist():
        row = piece % SECOND - 3 * SPLAT
        covered[row, starts[piece] : starts[piece] + PIXELS] += 1
    assert covered.max(initial=0) <= 1
    y, x = np.mgrid[first : first + PIXELS, :TILE]
    p, q = inv_w * (x - u - slope * (y - v)), (y - v) ** 2 * inv_yy
    near = (p * p + q < reach - 1e-4) & (open_rows[first : first + PIXELS, None] != 0)
    assert covered[first : first + PIXELS][near].all()
    assert not covered[:, :][open_rows == 0].any()
    np.testing.assert_allclose(squares, q[:, 0], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(bases, p[:, 0], rtol=1e-5, atol=1e-4)


def test_runs_are_listed_after_those_before():
    splat = (4.0, 4.0, 1.0, 0.0, 1.0, 11.0)
    pieces, *_ = pieces_of(span_compiled, splat, 0, np.ones(TILE, np.int32), n=5)
    assert (pieces[:5] == 0).all()
    assert (pieces[5:] // SPLAT == 3).all()
    assert len(pieces) == 5 + 7


def test_open_rows_are_those_with_light():
    left = np.full((ROWS, TILE), -0.5, np.float32)
    rows = np.full(TILE, 9, np.int32)
    for ask in (spans.any_open, open_compiled):
        assert not ask(left, rows)
        assert not rows.any()
    left[3, 15] = left[15, 0] = 0.1
    for ask in (spans.any_open, open_compiled):
        assert ask(left, rows)
        assert np.flatnonzero(rows).tolist() == [3, 15]


def test_prefetching_changes_nothing():
    array = np.arange(12.0).reshape(3, 4)
    prefetch_compiled(array, 2)
    spans.prefetch(array, 2)
    assert array.ravel().tolist() == list(range(12))
