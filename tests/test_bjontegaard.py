"""Bjontegaard differences of rate-distortion curves, on curves made by hand."""

import math

import pytest

from nanogs.bench.bjontegaard import bd_quality, bd_rate, rises

CURVE = [(250e3, 24.0), (500e3, 27.5), (1e6, 30.2), (2e6, 32.0), (4e6, 33.1)]


def shifted(shift=0.0, times=1.0, curve=CURVE):
    return [(times * size, quality + shift) for size, quality in curve]


@pytest.mark.parametrize("shift", [2.0, -0.5, 0.0])
def test_a_curve_shifted_in_quality_has_that_mean_difference(shift):
    assert bd_quality(CURVE, shifted(shift)) == pytest.approx(shift, abs=1e-9)


@pytest.mark.parametrize("factor", [0.5, 1.0, 3.0])
def test_a_curve_with_scaled_sizes_has_that_rate(factor):
    assert bd_rate(CURVE, shifted(times=factor)) == pytest.approx(factor - 1, abs=1e-9)


def test_only_the_common_interval_of_both_curves_counts():
    better = [(size, quality + 1) for size, quality in CURVE[1:4]]
    assert bd_quality(CURVE, better) == pytest.approx(1.0, abs=0.03)
    beyond = [*better, (1e9, 90.0)]
    assert bd_quality(better, beyond) == pytest.approx(
        0.0, abs=0.2
    )  # only the slope at its end differs


def test_straight_lines_are_integrated_exactly():
    """For straight lines the integral is known; sizes are 1 to 100, so their log10 is 0 to 2."""
    flat, steep = [(1, 10.0), (100, 10.0)], [(1, 10.0), (10, 11.0), (100, 12.0)]
    assert bd_quality(flat, steep) == pytest.approx(1.0)
    # For a quality D from 10 to 12, log10 of the bytes is D - 10 and 2 (D - 10).
    double = [(1, 10.0), (10_000, 12.0)]
    assert bd_rate(steep, double) == pytest.approx(10**1 - 1)


def test_the_order_of_points_does_not_matter():
    assert bd_quality(CURVE[::-1], shifted(2.0)) == pytest.approx(2.0)
    assert bd_rate(CURVE[::-1], shifted(times=0.5)) == pytest.approx(-0.5)


def test_exchanging_the_curves_reverses_the_differences():
    other = [(300e3, 26.0), (900e3, 30.0), (3e6, 33.0)]
    forward, backward = bd_rate(CURVE, other), bd_rate(other, CURVE)
    assert bd_quality(CURVE, other) == pytest.approx(-bd_quality(other, CURVE))
    assert math.log10(1 + forward) == pytest.approx(-math.log10(1 + backward))


@pytest.mark.parametrize(
    "other",
    [
        [],
        CURVE[:1],
        shifted(times=100.0),
        [(4e6, 30.0), (8e6, 35.0)],
        [(1e6, 20.0), (1e6, 30.0)],
        [(1e6, 20.0), (1e6, 21.0), (2e6, 30.0)],
    ],
    ids=["none", "one", "apart", "one size in common", "one size", "one size twice"],
)
def test_without_a_common_interval_of_sizes_the_difference_is_none(other):
    assert bd_quality(CURVE, other) is None
    assert bd_quality(other, CURVE) is None


def test_without_a_common_interval_of_qualities_the_rate_is_none():
    assert bd_rate(CURVE, shifted(50.0)) is None
    assert bd_quality(CURVE, shifted(50.0)) == pytest.approx(50)


def test_a_curve_that_falls_has_no_rate():
    falling = [*CURVE[:3], (2e6, 29.0)]
    assert rises(CURVE)
    assert not rises(falling)
    assert not rises([*CURVE, (8e6, CURVE[-1][1])])
    assert bd_rate(CURVE, falling) is None
    assert bd_rate(falling, CURVE) is None
    assert bd_quality(CURVE, falling) is not None
