"""A file size or a PSNR as the target: `simplify(size=...)`, `simplify(psnr=...)`."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given as drawn
from hypothesis import strategies as st

import nanogs
from builders import model_bytes, random_splats
from launch import run_here
from nanogs.datasets.synthetic import make_scene
from nanogs.errors import ModelError, OptionError
from nanogs.io import registry
from nanogs.io.ply import write as ply_write
from nanogs.pipeline import one_block as pipeline_run
from nanogs.pipeline.options.target import Goal, count_for_size
from nanogs.pipeline.search.coarseness import COARSEST_FOR_PSNR, HALVINGS, coarsest
from nanogs.pipeline.search.file_size import ENOUGH, fit_size, search_fit
from nanogs.pipeline.search.file_size import MOST_PROBES as FIT_PROBES
from nanogs.pipeline.search.file_size import TOLERANCE as CLOSE
from nanogs.pipeline.search.packer import MOST_SAVED, ChosenPacking, PackingForPsnr
from nanogs.pipeline.search.packing import ERROR_LEFT, Packing
from nanogs.pipeline.search.psnr import (
    BELOW_STEP,
    MOST_PROBES,
    NEAR_DB,
    reach_psnr,
    search_count,
)
from nanogs.pipeline.search.size_request import SizeRequest
from nanogs.progress import Tracker
from nanogs.report import PackingReport, StopReason
from nanogs.scoring.comparison import NamedModel, compare_models
from nanogs.scoring.held_out import held_out
from nanogs.splats import ExtraElement, RenderMode
from nanogs.views.automatic import automatic_cameras
from viewer_bundle import require_bundle


@pytest.fixture(scope="module")
def splats():
    return random_splats(600, degree=1)


def awkward_splats():
    """A model with all that a file can have besides the usual columns of splats."""
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


def test_a_page_size_works_if_the_first_splat_is_transparent(splats, tmp_path):
    """Once, this splat alone was written to measure its size, and a page needs a visible splat."""
    require_bundle()
    clear = splats.take(np.arange(len(splats)))
    clear.opacity_logits[0] = -30
    nanogs.save(clear, tmp_path / "scene.ply")
    page = tmp_path / "page.html"
    arguments = (tmp_path / "scene.ply", page, "--size", "10MB", "--preset", "fast", "-q")
    assert run_here("simplify", *arguments, "--dry-run") == 0
    assert run_here("simplify", *arguments) == 0
    assert page.stat().st_size < 10_000_000


@pytest.mark.parametrize("count", [1, 9, 10, 99, 100, 120])
def test_the_computed_ply_size_is_that_of_the_file(tmp_path, count):
    """To the byte, including the digits of the count in the header."""
    model = awkward_splats()
    path = tmp_path / "a.ply"
    nanogs.save(model.take(np.arange(count)), path)
    assert ply_write.file_bytes(model, count) == path.stat().st_size


@pytest.mark.parametrize("preset", ["fast", "default", "paper"])
def test_the_file_is_as_large_as_the_size_allows(splats, tmp_path, preset, small_views):
    size = 20_000
    small, report = nanogs.simplify(splats, size=size, preset=preset)
    path = tmp_path / "a.ply"
    nanogs.save(small, path)
    assert path.stat().st_size <= size < ply_write.file_bytes(splats, len(small) + 1)
    assert (report.asked_size, report.asked_count) == (size, len(small))
    by_count, _ = nanogs.simplify(splats, count=len(small), preset=preset)
    assert model_bytes(small) == model_bytes(by_count)


def test_sizes_are_met_where_the_header_grows_by_a_digit():
    """From 9 to 10 splats and from 99 to 100, the header grows by a byte."""
    model = awkward_splats()
    sizes = {count: ply_write.file_bytes(model, count) for count in range(1, 122)}
    for count in (9, 10, 99, 100):
        for size in range(sizes[count] - 1, sizes[count] + 2):
            expected = max(n for n, file_bytes in sizes.items() if file_bytes <= size)
            assert count_for_size(120, size, lambda n: ply_write.file_bytes(model, n)) == expected


def test_a_size_too_small_for_one_splat_is_refused(splats):
    smallest = ply_write.file_bytes(splats, 1)
    assert len(nanogs.simplify(splats, size=smallest, preset="fast")[0]) == 1
    with pytest.raises(OptionError, match=f"takes {smallest:,} B"):
        nanogs.simplify(splats, size=smallest - 1, preset="fast")


def test_a_model_that_fits_is_returned_unchanged(splats):
    size = ply_write.file_bytes(splats, len(splats))
    small, report = nanogs.simplify(splats, size=size, preset="fast")
    assert model_bytes(small) == model_bytes(splats)
    assert "whole model fits" in report.notes[-1]
    assert nanogs.simplify(splats, size=size - 1, preset="fast")[1].notes == ()


def test_a_format_that_is_not_written_is_refused(splats):
    with pytest.raises(OptionError, match="does not write"):
        nanogs.simplify(splats, size=10_000, format=".obj")


def test_without_a_size_formula_the_count_is_found_by_writing(splats, monkeypatch):
    """A .ply file whose size is treated as unknown until it is written."""
    written_only = registry.Format(".ply", None, ply_write.write)
    monkeypatch.setattr(registry, "of_name", lambda _: written_only)
    with pytest.raises(OptionError, match="only known once it is written"):
        registry.sizer(Path("a.ply"))
    small, report = nanogs.simplify(splats, size=20_000, preset="fast")
    assert ENOUGH * 20_000 <= report.achieved_size <= 20_000
    assert report.achieved_size == ply_write.file_bytes(splats, len(small))


# Size of a format that compresses


@pytest.mark.usefixtures("small_pictures")
@pytest.mark.parametrize(
    ("suffix", "preset", "options"),
    [
        (".spz", "fast", {}),
        (".spz", "fast", {"spz_version": 4}),
        (".spz", "default", {}),
        (".sog", "fast", {}),
        (".sog", "fast", {"palette": 64}),
    ],
)
def test_a_compressed_file_is_no_larger_than_requested(
    splats, tmp_path, suffix, preset, options, small_views
):
    size = {".spz": 6_000, ".sog": 12_000}[suffix]
    settings = {"preset": preset}
    small, report = nanogs.simplify(
        splats, size=size, format=suffix, format_options=options, **settings
    )
    assert ("palette" in options) is ("palette" not in report.format_options)
    options = {**options, **report.format_options}
    nanogs.save(small, tmp_path / f"a{suffix}", format_options=options)
    written = (tmp_path / f"a{suffix}").stat().st_size
    assert report.achieved_size == written <= size
    counts = [probe.count for probe in report.size_probes]
    assert len(small) == report.asked_count == report.achieved_count < len(splats)
    assert len(small) in counts
    too_many = [probe.count for probe in report.size_probes if probe.bytes > size]
    close = too_many and min(too_many) <= max((1 + CLOSE) * len(small), len(small) + 1)
    assert written >= ENOUGH * size or close
    assert bool(report.notes) is (written < ENOUGH * size)
    if preset == "fast":  # others fit the splats that share harmonics
        by_count, _ = nanogs.simplify(splats, count=len(small), **settings)
        assert model_bytes(small) == model_bytes(by_count)


def test_a_model_whose_compressed_file_fits_is_returned_unchanged(splats):
    small, report = nanogs.simplify(splats, size=10**6, preset="fast", format=".spz")
    assert model_bytes(small) == model_bytes(splats)
    assert "whole model fits" in report.notes[-1]
    assert report.achieved_size < 10**6


def test_impossible_compressed_sizes_are_refused(splats):
    with pytest.raises(OptionError, match="a file of one splat of this model takes"):
        nanogs.simplify(splats, size=30, preset="fast", format=".spz")
    with pytest.raises(OptionError, match=r"paper cannot search for the size of a \.spz file"):
        nanogs.simplify(splats, size=6_000, preset="paper", format=".spz")


@pytest.mark.parametrize("seed", range(40))
def test_the_search_for_a_size_never_exceeds_it(seed):
    """With noise and jumps of the size, and from good and bad first guesses."""
    rng = np.random.default_rng(seed)
    available = int(10 ** rng.uniform(0, 6))
    each, leaps = rng.uniform(4, 40), rng.uniform(0, 3)
    noise = rng.uniform(0.98, 1, 97)

    def bytes_of(count):
        counts.append(count)
        leap = leaps * each * (1 << (count.bit_length() - 1))
        return int(100 + (each * count + leap) * noise[count % 97])

    counts = []
    size = max(bytes_of(1), int(bytes_of(available) * rng.uniform(0.001, 1.1)))
    counts = []
    guess = int(available * 10 ** rng.uniform(-3, 1))
    found = search_fit(bytes_of, size, guess, 1, available)
    assert found.bytes <= size
    assert [probe.count for probe in found.probes] == counts
    assert all(1 <= count <= available for count in counts)
    assert len(counts) <= 2 * FIT_PROBES
    too_large = [probe.count for probe in found.probes if probe.bytes > size]
    best = found.bytes >= ENOUGH * size or found.count == available
    close = too_large and min(too_large) <= max((1 + CLOSE) * found.count, found.count + 1)
    assert best or close or len(counts) >= FIT_PROBES
    assert bool(found.notes(size, available)) is not best


def test_a_size_below_that_of_the_lowest_count_is_refused():
    with pytest.raises(OptionError, match="the fewest that this model can be merged to"):
        search_fit(lambda count: 1000 + count, 900, 500, 7, 1000)


# PSNR


FEW = {"steps": 4, "views": 4, "view_size": 48}  # so few because each probe is fitted


@pytest.mark.parametrize(("preset", "overrides"), [("fast", {}), ("default", FEW), ("fast", FEW)])
def test_the_result_reaches_the_psnr_and_equals_that_of_its_count(splats, preset, overrides):
    requested = 24.0
    small, report = nanogs.simplify(splats, psnr=requested, preset=preset, **overrides)
    assert report.stop is StopReason.TARGET
    assert requested <= report.judged.psnr <= requested + NEAR_DB
    assert len(small) == report.asked_count == report.achieved_count < len(splats)
    psnrs = {probe.count: probe.psnr for probe in report.probes if not probe.quick}
    assert psnrs[len(small)] == pytest.approx(report.judged.psnr, abs=1e-9)
    by_count, _ = nanogs.simplify(splats, count=len(small), preset=preset, **overrides)
    assert model_bytes(small) == model_bytes(by_count)
    [compared] = compare_models(
        NamedModel("a", splats), [NamedModel("b", small)], automatic_cameras(splats, split="test")
    )[0].models
    assert compared.psnr == report.judged.psnr


@pytest.mark.parametrize("suffix", [".spz", ".sog", ".compressed.ply"])
def test_for_compressed_formats_the_psnr_is_that_of_the_file(splats, tmp_path, suffix):
    small, report = nanogs.simplify(splats, psnr=24.0, preset="fast", format=suffix)
    nanogs.save(small, tmp_path / f"small{suffix}")
    packed = nanogs.load(tmp_path / f"small{suffix}")
    assert 24 <= report.judged.psnr <= 24.3
    assert held_out(splats).judge(packed) == report.judged
    assert held_out(splats).judge(small).psnr != report.judged.psnr


def test_for_a_page_the_psnr_is_that_of_what_it_shows(splats):
    """The page holds an .spz, which clamps some of the colours."""
    require_bundle()
    small, report = nanogs.simplify(splats, psnr=24.0, preset="fast", format=".html")
    assert 24 <= report.judged.psnr <= 24.3
    assert held_out(splats).judge(nanogs.io.round_trip(small, "a.html")) == report.judged
    assert held_out(splats).judge(small).psnr != report.judged.psnr


def test_an_unreachable_psnr_gives_the_whole_model_in_few_probes(splats):
    small, report = nanogs.simplify(splats, psnr=100, preset="fast")
    assert report.stop is StopReason.UNREACHED
    assert model_bytes(small) == model_bytes(splats)
    assert report.judged.psnr == math.inf
    assert report.probes[-1].count == 594
    assert all(probe.psnr < 100 for probe in report.probes)
    assert len(report.probes) <= 3
    # If a quick result is far below the PSNR, no candidates are compared and none is fitted.
    best = nanogs.simplify(splats, psnr=120, preset="best")[1]
    assert best.stop is StopReason.UNREACHED
    assert best.fit is None
    assert all(probe.quick for probe in best.probes)


def test_a_psnr_near_zero_gives_one_splat(splats):
    small, report = nanogs.simplify(splats, psnr=0.1, preset="fast")
    assert (len(small), report.stop) == (1, StopReason.STEP)
    assert report.stop.met


def test_a_psnr_of_an_invisible_model_is_refused():
    invisible = random_splats(50)
    invisible.opacity_logits[:] = -np.inf
    for preset in ("fast", "default"):
        with pytest.raises(ModelError, match="cannot be measured"):
            nanogs.simplify(invisible, psnr=30, preset=preset)


def test_the_preset_paper_refuses_a_psnr(splats):
    with pytest.raises(OptionError, match="paper"):
        nanogs.simplify(splats, psnr=30, preset="paper")


@pytest.mark.parametrize("jump", [2, 3, 50, 99, 1000, 54_321, 99_000])
@pytest.mark.parametrize("guess", [1, 10_000, 99_999])
def test_a_jump_of_the_psnr_is_located_to_a_hundredth(jump, guess):
    """No count is within the span: the one found reaches the PSNR, and 1 % fewer do not."""
    counts = []

    def psnr_of(count):
        counts.append(count)
        return 31.0 if count >= jump else 20.0

    found = search_count(psnr_of, 30.0, 1, 100_000, guess)
    assert found.stop is StopReason.STEP
    assert jump <= found.count <= max(jump, 1.01 * jump)
    assert [probe.count for probe in found.probes] == counts
    assert len(set(counts)) == len(counts) <= MOST_PROBES + BELOW_STEP


def test_the_search_continues_below_a_jump_of_the_psnr():
    """Such jumps arise where the choice between two candidates changes with the count."""

    def psnr_of(count):
        return 20 + 3 * math.log(count / 100) + (0.8 if count // 50 % 2 else 0.0)

    for guess in (100, 1000, 9000):
        found = search_count(psnr_of, 24.55, 1, 100_000, guess)
        assert found.stop is StopReason.TARGET
        assert 24.55 <= psnr_of(found.count) <= 24.55 + NEAR_DB


def test_the_smallest_count_below_a_jump_that_reaches_the_psnr_is_found():
    """Counts below it that exceed the span do not end the search either."""

    def psnr_of(count):
        return 40.0 if count >= 1000 else 35.0 if 780 < count < 870 else 20.0

    found = search_count(psnr_of, 30.0, 1, 10_000, 990)
    assert found.stop is StopReason.STEP
    assert [probe.psnr for probe in found.probes[-BELOW_STEP:]] == [20, 20, 35, 35, 20, 20]
    assert found.count == found.probes[-3].count


def test_a_range_up_to_an_infinite_psnr_is_halved():
    def psnr_of(count):
        return math.inf if count >= 5000 else 20.0

    found = search_count(psnr_of, 30.0, 1, 100_000, 20)
    assert 5000 <= found.count <= 5050
    assert len(found.probes) <= 12 + BELOW_STEP


@pytest.mark.parametrize("seed", range(40))
def test_a_search_along_a_curve_ends_within_the_span(seed):
    """On bent and noisy curves, with good and bad first guesses."""
    rng = np.random.default_rng(seed)
    available = int(10 ** rng.uniform(3, 6))
    slope, bend, noise = rng.uniform(1.5, 5), rng.uniform(0, 0.3), rng.uniform(0, 0.05, 97)

    def psnr_of(count):
        x = math.log(count / available)
        return 45 + slope * x - bend * x * x / 4 + noise[count % 97]

    requested = psnr_of(available // 200) + 5
    found = search_count(psnr_of, requested, 1, available, int(available ** rng.uniform(0.2, 1)))
    assert found.stop is StopReason.TARGET
    assert requested <= psnr_of(found.count) <= requested + NEAR_DB
    assert len(found.probes) <= 8


def test_a_quick_search_accepts_a_psnr_just_below_the_target():
    found = search_count(lambda count: 29.8 + count / 1e6, 30.0, 1, 1000, 100, quick=True)
    assert [(probe.count, probe.quick) for probe in found.probes] == [(100, True)]


def test_the_search_stays_between_the_lowest_count_and_the_whole_model():
    found = search_count(lambda count: 40.0, 30.0, 7, 1000, 100)
    assert (found.count, found.stop) == (7, StopReason.STEP)
    assert all(probe.count >= 7 for probe in found.probes)
    missed = search_count(lambda count: 0.0, 30.0, 7, 1000, 100)
    assert (missed.count, missed.stop) == (1000, StopReason.UNREACHED)
    assert [probe.count for probe in missed.probes] == [100, 990]
    alone = search_count(lambda count: 0.0, 30.0, 1, 1, 1)
    assert (alone.probes, alone.stop) == ((), StopReason.UNREACHED)


def test_a_search_without_any_count_that_reaches_has_not_found_one():
    """The PSNR stays a little below what is asked, so that counts grow in small steps."""
    found = search_count(lambda count: 29.999, 30.0, 1, 10**9, 10)
    assert len(found.probes) == MOST_PROBES
    assert (found.count, found.stop) == (10**9, StopReason.UNREACHED)


@pytest.mark.parametrize(("guess", "slope"), [(10_000, 3.0), (700, 10.0)])
def test_a_search_follows_the_slope_that_it_has_measured(guess, slope):
    """It comes down from nearly all splats without trying all, and leaves a wrong first slope."""
    probes = []

    def psnr_of(count):
        probes.append(count)
        return 30 + 4 * math.log(count / 8000)

    found = search_count(psnr_of, 30.0, 1, 10_000, guess, slope)
    assert found.stop is StopReason.TARGET
    assert found.count == pytest.approx(8000, rel=0.08)
    assert len(probes) <= 4


class CountedResults:
    """Results of a model of 1,000 splats; a result is its count."""

    available, fewest, looks = 1000, 1, True

    def plain(self, rounds=None):
        return self

    def stages(self, count):
        return []

    def make(self, count, progress):
        return count

    def make_and_measure(self, count, measure, progress):
        return count, measure(count)

    def keep(self, result):
        pass


@pytest.mark.parametrize(("lack", "tried"), [(3.0, True), (8.0, False)])
def test_results_are_tried_unless_plain_cuts_are_far_below_the_psnr(lack, tried):
    made = []

    class Noted(CountedResults):
        def __init__(self, quick=False):
            self.quick = quick

        def plain(self, rounds=None):
            return Noted(quick=True)

        def make(self, count, progress):
            made.append(count)
            return count

        def make_and_measure(self, count, measure, progress):
            if self.quick:
                return count, measure(count) - lack
            return self.make(count, progress), measure(count)

    def psnr_of(count):
        return 20 + count / 100

    def packed(_count, _slope):
        return results, 950

    results, asked = Noted(), 29.0
    pack = PackingForPsnr(results, None, None, None, Tracker(None, []))
    result, found = reach_psnr(results, asked, psnr_of, Tracker(None, []), packed, pack.smaller)
    assert result == found.count
    if tried:
        assert found.stop is StopReason.TARGET
        assert asked <= psnr_of(result) <= asked + NEAR_DB
    else:
        assert (result, found.stop, made) == (1000, StopReason.UNREACHED, [1000])


def test_a_size_that_no_count_uses_up_is_found_with_plain_cuts():
    """One result is made then: it uses as much as the cut, whose reason to end is that of both."""
    made = {"plain": [], "full": []}

    class Noted(CountedResults):
        def __init__(self, kind="full"):
            self.kind = kind

        def plain(self, rounds=None):
            assert rounds is None, "splats are reassigned as in results, for files as large"
            return Noted("plain")

        def make_and_measure(self, count, measure, progress):
            made[self.kind].append(count)
            return count, measure(count)

    def bytes_of(count):
        return 40_000 + count + 80_000 * (count > 500)

    result, found = fit_size(Noted(), 100_000, 300, bytes_of, Tracker(None, []))
    assert 495 <= result == found.count <= 500
    assert made["full"] == [result]
    assert found.stop is StopReason.STEP
    assert [probe.count for probe in found.probes] == [*made["plain"], result]
    made["plain"].clear()
    fit_size(Noted(), 100_000, 300, bytes_of, Tracker(None, []), near=True)
    assert made["plain"] == [], "a guess from full results is not improved by plain cuts"


@pytest.mark.parametrize(
    ("asked", "whole_psnr", "each", "expected"),
    [
        (29.5, 29.6, 40, 1000),  # finer files of more than 750 splats take more bytes
        (29.5, 29.4, 40, None),  # the whole model does not reach the PSNR with fewer bytes each
        (29.5, 29.6, 30, None),
        (25.0, 29.6, 90, None),  # far from the whole model
    ],
)
def test_a_psnr_never_takes_more_bytes_than_the_whole_model(asked, whole_psnr, each, expected):
    """With a finer packing than the format's own, fewer splats can take more bytes."""

    class Files:
        def count(self, result):
            return result

        def bytes_of(self, result, options):
            return result * (each if options else 30)

    def psnr_of(result):
        return 20 + result / 100 if pack.packed or result < 1000 else whole_psnr

    results = CountedResults()
    pack = PackingForPsnr(results, None, None, Files(), Tracker(None, []))

    def chosen(count, _slope):
        packing = Packing(0, None, (("bits", 8),))
        tried = (PackingReport(0, {}, count, 1, 30.0, 0.9, 31.0, 0.9),)
        pack.packed = ChosenPacking(packing, count, tried, 0, 0, ".sog")
        return CountedResults(), count

    result, found = reach_psnr(results, asked, psnr_of, Tracker(None, []), chosen, pack.smaller)
    assert result == found.count
    if expected:
        assert (result, found.stop, pack.options(result)) == (1000, StopReason.STEP, {})
    else:
        assert result < 1000
        assert found.stop is StopReason.TARGET
        assert pack.options(result) == {"bits": 8}


@pytest.mark.parametrize(
    ("fitted", "slope", "size"),
    [
        # A whole fit leaves 0.6 of the error: 2.2 dB more. So it gains 6 dB over the cut.
        (36 + 10 * math.log10(ERROR_LEFT), 6.0, 9000 / math.e),
        (27.0, 6.0, 9000),  # a fit that does not help is no reason for a larger file
        (90.0, 1.0, 9000 * math.exp(-MOST_SAVED)),
    ],
)
def test_a_packing_for_a_psnr_is_chosen_at_the_size_of_a_fitted_result(
    monkeypatch, fitted, slope, size
):
    """A plain cut of 300 splats reaches the PSNR in 9,000 B; fitted, fewer splats reach it."""

    class Cut(CountedResults):
        def __init__(self, psnr):
            self.psnr = psnr

        def plain(self, rounds=None):
            assert rounds == 0, "as in the search that led to the count"
            return Cut(30.0)

        def brief(self):
            return Cut(fitted)

        def make_and_measure(self, count, measure, progress):
            assert count == 300
            return self, measure(self)

    class Files:
        def count(self, result):
            return 300

        def measure(self, result, sh_degree, options):
            assert (sh_degree, options) == (2, {})
            size = 9000 if result.psnr == 30.0 else 8000
            return PackingReport(2, {}, 300, size, result.psnr, 0.9, result.psnr, 0.9)

    class Recorded:
        def __init__(self, results, request, *others):
            self.request = request

        def pack(self):
            asked.append(self.request)
            return ChosenPacking(Packing(2), 250, (), 2, 2, ".spz")

        def results_for(self, packing):
            return results

    asked, results = [], Cut(0.0)
    monkeypatch.setattr("nanogs.pipeline.search.packer.Packer", Recorded)
    request = SizeRequest(0, registry.writable(Path("a.spz")), {}, 2)
    sample = random_splats(9, degree=3)
    pack = PackingForPsnr(results, request, lambda: sample, Files(), Tracker(None, []))
    assert pack(300, slope) == (results, 250)
    assert asked == [request._replace(size=round(size), by_psnr=True)]


def test_the_number_of_probes_is_limited():
    found = search_count(lambda count: 90.0, 30.0, 1, 10**300, 10**299)
    assert (found.stop, len(found.probes)) == (StopReason.PROBES, MOST_PROBES)


def test_a_ratio_of_one_grows_no_forest(splats, monkeypatch):
    monkeypatch.setattr(pipeline_run, "grow_forest", None)
    bad = splats.take(np.arange(len(splats)))
    bad.means[7] = np.nan
    for preset in ("fast", "default", "best"):
        small, report = nanogs.simplify(bad, ratio=1, preset=preset)
        assert model_bytes(small) == model_bytes(bad.take(np.flatnonzero(bad.finite())))
        assert (report.achieved_count, report.stop) == (len(bad) - 1, StopReason.TARGET)
    [(level, _)] = nanogs.levels(splats, [1.0])
    assert model_bytes(level) == model_bytes(splats)


# Refused targets


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "exactly one of"),
        ({"ratio": 0.5, "size": 10_000}, "exactly one of"),
        ({"count": 5, "psnr": 30.0}, "exactly one of"),
        ({"size": 5_000, "psnr": 30.0}, "exactly one of"),
        ({"size": 0}, "size must be at least 1 byte"),
        ({"psnr": float("nan")}, "PSNR must be above 0"),
        ({"psnr": float("inf")}, "PSNR must be above 0"),
        ({"psnr": -1.0}, "PSNR must be above 0"),
    ],
)
def test_anything_but_one_valid_target_is_refused(options, message):
    with pytest.raises(OptionError, match=message):
        Goal(**options)


# ---- what a result has above its PSNR is used up by rounding -----------------------------------


@drawn(st.floats(0.5, 5.0))
def test_values_are_rounded_as_coarsely_as_the_psnr_allows(limit):
    tried = []

    def reaches(coarseness):
        tried.append(coarseness)
        return coarseness <= limit

    found = coarsest(reaches)
    assert min(tried) > 1.0, "the result itself reaches it"
    assert len(tried) <= 1 + HALVINGS
    if limit >= COARSEST_FOR_PSNR:
        assert (found, tried) == (COARSEST_FOR_PSNR, [COARSEST_FOR_PSNR])
    elif found > 1.0:
        assert found <= limit < found * COARSEST_FOR_PSNR ** (1 / 2**HALVINGS) * (1 + 1e-9)
    else:
        assert limit < COARSEST_FOR_PSNR ** (1 / 2**HALVINGS) * (1 + 1e-9)


@pytest.mark.parametrize("storage", ["held", "blocks"])
def test_a_file_of_a_psnr_is_rounded_until_it_has_no_more(tmp_path, monkeypatch, storage):
    """Its file has fewer bytes than with usual rounding, and the PSNR that is reported."""
    scene = make_scene(2000, seed=3)
    nanogs.save(scene, tmp_path / "in.ply")
    given = {"steps": 24, "views": 24, "view_size": 64, "around": 0}

    def made(psnr):
        path = tmp_path / f"{len(found)}.sog"
        if storage == "held":
            small, report = nanogs.simplify(scene, format=".sog", psnr=psnr, **given)
            nanogs.save(small, path, format_options=report.format_options)
        else:
            report = nanogs.simplify_blocks(
                tmp_path / "in.ply", path, block=1500, psnr=psnr, **given
            )
        assert report.stop is StopReason.TARGET
        reached = nanogs.compare(scene, nanogs.load(path)).models[0].psnr
        assert psnr <= reached == pytest.approx(report.judged.psnr, abs=1e-6)
        return path.stat().st_size

    found = []

    def searched(reaches):
        found.append(coarsest(reaches))
        return found[-1]

    monkeypatch.setattr("nanogs.pipeline.search.psnr.coarsest", searched)
    for psnr in (29.0, 28.0, 27.0, 26.0):
        coarse = made(psnr)
        if found[-1] > 1:  # the result has some more than asked
            break
    assert found[-1] > 1
    monkeypatch.setattr("nanogs.pipeline.search.psnr.coarsest", lambda reaches: 1.0)
    assert coarse < made(psnr)
