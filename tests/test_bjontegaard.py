"""Mean differences of rate-distortion curves, on curves made by hand."""

import math

import pytest

from nanogs.bench.bjontegaard import bd_quality, bd_rate, rises

CURVE = [(250e3, 24.0), (500e3, 27.5), (1e6, 30.2), (2e6, 32.0), (4e6, 33.1)]


def shifted(by=0.0, times=1.0, curve=CURVE):
    return [(times * size, quality + by) for size, quality in curve]


@pytest.mark.parametrize("by", [2.0, -0.5, 0.0])
def test_a_curve_shifted_by_so_many_decibels_is_so_much_better(by):
    assert bd_quality(CURVE, shifted(by)) == pytest.approx(by, abs=1e-9)


@pytest.mark.parametrize("times", [0.5, 1.0, 3.0])
def test_a_curve_of_a_share_of_the_bytes_saves_the_rest(times):
    assert bd_rate(CURVE, shifted(times=times)) == pytest.approx(times - 1, abs=1e-9)


def test_only_the_interval_that_both_have_counts():
    better = [(size, quality + 1) for size, quality in CURVE[1:4]]
    assert bd_quality(CURVE, better) == pytest.approx(1.0, abs=0.03)
    beyond = [*better, (1e9, 90.0)]
    assert bd_quality(better, beyond) == pytest.approx(0.0, abs=0.2)  # the slope at its end alone


def test_lines_are_met_exactly():
    """On straight lines the integral is known: over sizes of 1 to 100, log10 from 0 to 2."""
    flat, steep = [(1, 10.0), (100, 10.0)], [(1, 10.0), (10, 11.0), (100, 12.0)]
    assert bd_quality(flat, steep) == pytest.approx(1.0)
    # Qualities from 10 to 12: log10 of the bytes is D - 10 in one, 2 (D - 10) in the other.
    double = [(1, 10.0), (10_000, 12.0)]
    assert bd_rate(steep, double) == pytest.approx(10**1 - 1)


def test_the_order_of_points_is_nothing():
    assert bd_quality(CURVE[::-1], shifted(2.0)) == pytest.approx(2.0)
    assert bd_rate(CURVE[::-1], shifted(times=0.5)) == pytest.approx(-0.5)


def test_the_other_way_round_is_the_opposite():
    other = [(300e3, 26.0), (900e3, 30.0), (3e6, 33.0)]
    there, back = bd_rate(CURVE, other), bd_rate(other, CURVE)
    assert bd_quality(CURVE, other) == pytest.approx(-bd_quality(other, CURVE))
    assert math.log10(1 + there) == pytest.approx(-math.log10(1 + back))


@pytest.mark.parametrize(
    "other",
    [[], CURVE[:1], shifted(times=100.0), [(1e6, 20.0), (1e6, 30.0)]],
    ids=["none", "one", "apart", "one size"],
)
def test_without_a_common_interval_of_sizes_there_is_no_number(other):
    assert bd_quality(CURVE, other) is None
    assert bd_quality(other, CURVE) is None


def test_without_a_common_interval_of_qualities_nothing_is_saved():
    assert bd_rate(CURVE, shifted(50.0)) is None
    assert bd_quality(CURVE, shifted(50.0)) == pytest.approx(50)


def test_a_curve_that_falls_has_no_bytes_of_a_quality():
    falling = [*CURVE[:3], (2e6, 29.0)]
    assert rises(CURVE)
    assert not rises(falling)
    assert bd_rate(CURVE, falling) is None
    assert bd_quality(CURVE, falling) is not None
