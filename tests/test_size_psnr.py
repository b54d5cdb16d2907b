"""A size or a PSNR in place of a count: `simplify(size=...)`, `simplify(psnr=...)`."""

import sys

import numpy as np
import pytest

import nanogs
from builders import model_bytes, random_splats
from nanogs.errors import ModelError, OptionError
from nanogs.io import ply_write, registry
from nanogs.refit.parameters import RefitParameters
from nanogs.report import StopReason
from nanogs.simplify import forest_pipeline
from nanogs.simplify.reach import MOST_PROBES, TOLERANCE, search_count
from nanogs.simplify.target import Goal, count_for_size
from nanogs.splats import ExtraElement, RenderMode


@pytest.fixture(scope="module")
def splats():
    return random_splats(600, degree=1)


def awkward_splats():
    """Everything that a header or a row can hold beside the splats' own columns."""
    extras = {"label": np.arange(120, dtype=np.int16), "weight": np.ones(120, np.float64)}
    rows = np.zeros(7, dtype=[("a", "f8"), ("b", "u1")])
    base = random_splats(120, degree=2, extras=extras)
    return type(base)(
        means=base.means.astype(np.float64),
        log_scales=base.log_scales,
        quats=base.quats,
        opacity_logits=base.opacity_logits,
        sh=base.sh,
        extras=base.extras,
        render_mode=RenderMode.MIP,
        comments=("made for a test",),
        elements=(ExtraElement("camera", rows),),
    )


# Size


@pytest.mark.parametrize("count", [1, 9, 10, 99, 100, 120])
def test_the_size_is_that_of_the_file(tmp_path, count):
    """Down to the digits of the count in the header."""
    model = awkward_splats()
    path = tmp_path / "a.ply"
    nanogs.save(model.take(np.arange(count)), path)
    assert ply_write.file_bytes(model, count) == path.stat().st_size


@pytest.mark.parametrize("preset", ["fast", "default", "paper"])
def test_the_file_is_as_large_as_it_may_be(splats, tmp_path, preset):
    size = 20_000
    small, report = nanogs.simplify(splats, size=size, preset=preset)
    path = tmp_path / "a.ply"
    nanogs.save(small, path)
    assert path.stat().st_size <= size < ply_write.file_bytes(splats, len(small) + 1)
    assert (report.asked_size, report.asked_count) == (size, len(small))
    by_count, _ = nanogs.simplify(splats, count=len(small), preset=preset)
    assert model_bytes(small) == model_bytes(by_count)


def test_every_size_around_a_new_digit():
    """9 to 10 and 99 to 100 splats: the header grows by a byte."""
    model = awkward_splats()
    sizes = {count: ply_write.file_bytes(model, count) for count in range(1, 122)}
    for count in (9, 10, 99, 100):
        for size in range(sizes[count] - 1, sizes[count] + 2):
            expected = max(n for n, held in sizes.items() if held <= size)
            assert count_for_size(120, size, lambda n: ply_write.file_bytes(model, n)) == expected


def test_a_size_for_less_than_one_splat_is_refused(splats):
    smallest = ply_write.file_bytes(splats, 1)
    assert len(nanogs.simplify(splats, size=smallest, preset="fast")[0]) == 1
    with pytest.raises(OptionError, match=f"takes {smallest:,} B"):
        nanogs.simplify(splats, size=smallest - 1)


def test_a_model_that_fits_is_delivered_whole(splats):
    size = ply_write.file_bytes(splats, len(splats))
    small, report = nanogs.simplify(splats, size=size, preset="fast")
    assert model_bytes(small) == model_bytes(splats)
    assert "whole model fits" in report.notes[-1]
    assert nanogs.simplify(splats, size=size - 1, preset="fast")[1].notes == ()


def test_the_format_must_be_one_whose_size_is_known(splats, monkeypatch):
    with pytest.raises(OptionError, match="does not write"):
        nanogs.simplify(splats, size=10_000, format=".obj")
    written_only = [registry.Format(".ply", *[None] * 2, ply_write.write)]
    monkeypatch.setattr(registry, "FORMATS", written_only)
    with pytest.raises(OptionError, match="only known once it is written"):
        nanogs.simplify(splats, size=10_000)


# PSNR


@pytest.mark.parametrize(
    ("preset", "overrides"), [("fast", {}), ("default", {}), ("fast", {"refit": True})]
)
def test_the_result_reaches_the_psnr_and_is_that_of_its_count(
    splats, preset, overrides, monkeypatch
):
    few = RefitParameters(views=3, steps=2, rounds=1, size=48)
    monkeypatch.setattr(forest_pipeline, "REFIT", few)  # a fit for every probe
    asked = 24.0
    small, report = nanogs.simplify(splats, psnr=asked, preset=preset, **overrides)
    assert report.stop is StopReason.TARGET
    assert report.achieved_psnr >= asked
    assert len(small) == report.asked_count == report.achieved_count < len(splats)
    tried = {probe.count: probe.psnr for probe in report.probes}
    assert tried[len(small)] == report.achieved_psnr
    missed = max(count for count, psnr in tried.items() if psnr < asked)
    assert missed + 1 >= len(small) / (1 + TOLERANCE) - 1
    by_count, _ = nanogs.simplify(splats, count=len(small), preset=preset, **overrides)
    assert model_bytes(small) == model_bytes(by_count)


def test_a_psnr_out_of_reach_delivers_the_whole_model(splats):
    small, report = nanogs.simplify(splats, psnr=100, preset="fast")
    assert report.stop is StopReason.UNREACHED
    assert model_bytes(small) == model_bytes(splats)
    assert report.achieved_psnr == 100
    assert all(probe.psnr < 100 for probe in report.probes)


def test_a_psnr_of_nothing_is_one_splat(splats):
    small, report = nanogs.simplify(splats, psnr=0.1, preset="fast")
    assert (len(small), report.stop) == (1, StopReason.TARGET)


def test_a_psnr_needs_something_to_see():
    dark = random_splats(50)
    dark.opacity_logits[:] = -np.inf
    for preset in ("fast", "default"):
        with pytest.raises(ModelError, match="cannot be measured"):
            nanogs.simplify(dark, psnr=30, preset=preset)


def test_the_published_method_is_not_asked_for_a_psnr(splats):
    with pytest.raises(OptionError, match="paper"):
        nanogs.simplify(splats, psnr=30, preset="paper")


@pytest.mark.parametrize("wanted", [1, 2, 3, 50, 99, 1000, 54_321, 99_000])
def test_the_search_finds_the_fewest(wanted):
    tried = []

    def psnr_of(count):
        tried.append(count)
        return 30.0 if count >= wanted else 20.0

    found = search_count(psnr_of, 30.0, 1, 100_000)
    assert wanted <= found.count <= max(wanted, (1 + TOLERANCE) * wanted)
    assert found.stop is StopReason.TARGET
    assert [probe.count for probe in found.probes] == tried
    assert len(set(tried)) == len(tried) <= 12


def test_the_search_stays_between_the_fewest_and_the_whole():
    found = search_count(lambda count: 40.0, 30.0, 7, 1000)
    assert found.count == 7
    assert all(probe.count >= 7 for probe in found.probes)
    assert search_count(lambda count: 0.0, 30.0, 7, 1000).stop is StopReason.UNREACHED
    assert search_count(lambda count: 0.0, 30.0, 1, 1).probes == ()


def test_the_search_is_bounded(monkeypatch):
    # By its module: `nanogs.simplify` is the function here.
    monkeypatch.setattr(sys.modules[search_count.__module__], "TOLERANCE", 0.0)
    found = search_count(lambda count: 0.0, 30.0, 1, 10**12)
    assert (found.stop, len(found.probes)) == (StopReason.PROBES, MOST_PROBES)


# What is refused


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"ratio": 0.5, "size": 10_000},
        {"count": 5, "psnr": 30.0},
        {"size": 5_000, "psnr": 30.0},
        {"size": 0},
        {"psnr": float("nan")},
        {"psnr": float("inf")},
        {"psnr": -1.0},
    ],
)
def test_exactly_one_goal_in_its_range(given):
    with pytest.raises(OptionError):
        Goal(**given)
