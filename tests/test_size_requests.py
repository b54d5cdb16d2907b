"""Random requests for a size, and cases that once failed."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import nanogs
from builders import random_splats
from launch import run
from nanogs.errors import CrowdedError, TooSmallError, UnstorableError
from nanogs.io import encoded_bytes, registry
from nanogs.pipeline.files import limit_degree
from nanogs.pipeline.options.target import Goal, target_of
from nanogs.pipeline.request import Request as FileRequest
from nanogs.pipeline.search.file_size import (
    MOST_PROBES,
    SIZE_SAMPLE,
    FittedSize,
    _along,
    guess_count,
    little_used,
    search_fit,
    with_ending_on_known,
)
from nanogs.report import SizeProbeReport, StopReason
from nanogs.views.opening import opening_for
from random_requests import FEW_VIEWS, Request, random_request, run_and_check

pytestmark = pytest.mark.usefixtures("small_pictures")

PRESETS = ("fast", "default")


@pytest.mark.parametrize("number", range(20))
def test_random_requests_are_met_or_refused_with_a_clear_message(number):
    request = random_request(np.random.default_rng([2, number]), {}, PRESETS)
    if request.mode == "command" or request.suffix == ".html":  # which take longer
        request = replace(request, mode="memory", suffix=".spz", options={})
    assert run_and_check(request).faults == "", request


def bytes_named(error):
    """Return the last number of bytes that an error names."""
    return int(str(error).rpartition(" B; allow")[0].rpartition(" ")[2].replace(",", ""))


@pytest.mark.parametrize(
    ("suffix", "preset", "block"),
    [
        (".sog", "default", None),
        (".spz", "default", None),
        (".usda", "fast", None),
        (".ply", "default", None),
        (".spz", "fast", 15),
        (".ply", "default", 15),
    ],
)
def test_the_smallest_size_that_an_error_names_works(tmp_path, suffix, preset, block):
    arguments = {"preset": preset, **(FEW_VIEWS if preset == "default" else {})}
    source, out = tmp_path / "in.ply", tmp_path / f"out{suffix}"
    nanogs.save(random_splats(24, degree=2), source)
    least = 10
    while True:
        with pytest.raises(TooSmallError, match="is too small: a file of one splat") as error:
            nanogs.simplify_blocks(source, out, size=least, block=block, **arguments)
        assert least < bytes_named(error.value)
        least = bytes_named(error.value)
        if "about" not in str(error.value):
            break
        least = round(0.6 * least)
    with pytest.raises(TooSmallError):
        nanogs.simplify_blocks(source, out, size=least - 1, block=block, **arguments)
    assert [*tmp_path.iterdir()] == [source]
    report = nanogs.simplify_blocks(source, out, size=least, block=block, **arguments)
    assert (report.achieved_count, report.achieved_size) == (1, least)
    assert out.stat().st_size == least


@pytest.mark.parametrize(
    ("suffix", "block", "degree"),
    [
        (".ply", None, 3),
        (".sog", None, 3),
        (".ply", 24, 3),
        (".sog", 24, 3),
        (".compressed.ply", None, 4),
        (".compressed.ply", 24, 4),
        (".sog", 24, 4),
    ],
)
def test_harmonics_are_dropped_if_nothing_fits_otherwise(tmp_path, suffix, block, degree):
    splats = random_splats(24, degree=degree)
    source, out = tmp_path / "in.ply", tmp_path / f"out{suffix}"
    nanogs.save(splats, source)
    without_harmonics = tmp_path / f"bare{suffix}"
    nanogs.save(splats.take(np.arange(1)).with_sh_degree(0), without_harmonics)
    size = round(1.02 * without_harmonics.stat().st_size)
    report = nanogs.simplify_blocks(source, out, size=size, block=block, **FEW_VIEWS)
    assert out.stat().st_size == report.achieved_size <= size
    assert any("above degree 0 are left out" in note for note in report.notes)


@pytest.mark.parametrize(
    ("goal", "suffix", "degree"),
    [
        ({"size": 900}, ".glb", None),
        ({"size": 900}, ".sog", None),
        ({"psnr": 30}, ".sog", None),
        ({"psnr": 30}, ".glb", 3),
        ({"size": 900}, ".splat", 0),
        ({"ratio": 0.1}, ".sog", 3),
    ],
)
def test_only_a_search_that_chooses_the_degree_is_not_limited_before(goal, suffix, degree):
    request = FileRequest(goal=Goal(**goal), output=Path(f"a{suffix}"))
    limited, notes = limit_degree(request, 4)
    assert (limited.sh_degree, len(notes)) == (degree, degree is not None)


def test_a_degree_that_is_asked_for_leaves_nothing_to_search():
    """The size of a .ply file is known for each count, unless a lower degree may be chosen."""
    splats, goal, chosen = random_splats(100, degree=3), Goal(size=5000), nanogs.presets["default"]
    assert target_of(goal, splats, 100, Path("a.ply"), chosen, None) is None
    count = target_of(goal, splats, 100, Path("a.ply"), chosen, 1)
    some = (random_splats(number, degree=1) for number in (count, count + 1))
    assert [encoded_bytes(each, "a.ply") <= 5000 for each in some] == [True, False]


@pytest.mark.parametrize("block", [None, 24])
@pytest.mark.parametrize("share", [0.9, 2])
def test_a_note_names_once_what_a_format_cannot_hold(tmp_path, share, block):
    source, whole, out = (tmp_path / name for name in ("in.ply", "w.glb", "out.glb"))
    nanogs.save(random_splats(24, degree=4), source)
    nanogs.save(random_splats(24, degree=3), whole)
    size = round(share * whole.stat().st_size)
    report = nanogs.simplify_blocks(source, out, size=size, block=block, **FEW_VIEWS)
    assert sum("above degree 3 are left out" in note for note in report.notes) == 1


def about_harmonics(report):
    return [note for note in report.notes if note.startswith("Spherical harmonics")]


@pytest.mark.parametrize("block", [None, 24])
@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("goal", [{"size": 4500}, {"size": "1MB"}, {"psnr": 5}], ids=str)
def test_a_search_tells_once_what_the_format_cannot_hold(tmp_path, goal, preset, block):
    source, out = tmp_path / "in.ply", tmp_path / "out.sog"
    nanogs.save(random_splats(24, degree=4), source)
    arguments = {"preset": preset, "block": block, **(FEW_VIEWS if preset == "default" else {})}
    [note] = about_harmonics(nanogs.simplify_blocks(source, out, **goal, **arguments))
    assert note.endswith(
        (" 3 are left out, .sog holds no more.", ", and .sog holds none above degree 3.")
    )


def test_a_search_tells_what_the_format_cannot_hold_of_the_degree_asked_for():
    splats, arguments = random_splats(24, degree=4), {"format": ".sog", "preset": "fast"}
    for degree, expected in ((4, 1), (3, 0), (2, 0)):
        small, report = nanogs.simplify(splats, size=4500, sh_degree=degree, **arguments)
        assert small.sh_degree == min(degree, 3)
        assert len(about_harmonics(report)) == expected


@pytest.mark.parametrize("block", [None, 60])
def test_a_size_with_a_lower_sh_degree_is_used_up(tmp_path, block):
    """The requested SH degree decides the bytes per splat, in memory and in blocks."""
    source, out = tmp_path / "in.ply", tmp_path / "out.ply"
    nanogs.save(random_splats(60, degree=3), source)
    size = 3000
    arguments = {"sh_degree": 0, "block": block, **FEW_VIEWS}
    report = nanogs.simplify_blocks(source, out, size=size, **arguments)
    assert size - 68 < report.achieved_size == out.stat().st_size <= size
    assert nanogs.open(out).columns.sh_degree == 0


@pytest.mark.parametrize("goal", [{"ratio": 1}, {"size": "1MB"}], ids=str)
def test_a_lower_sh_degree_also_applies_if_all_splats_are_kept(goal):
    small, _ = nanogs.simplify(random_splats(20, degree=2), sh_degree=1, **goal, **FEW_VIEWS)
    assert (len(small), small.sh_degree) == (20, 1)


@pytest.mark.parametrize(("suffix", "block"), [(".splat", None), (".ply", 40)])
def test_a_note_gives_the_size_with_one_more_splat(tmp_path, suffix, block):
    splats = random_splats(40, degree=0)
    file_bytes = registry.writable(Path(f"a{suffix}")).file_bytes
    source, out = tmp_path / "in.ply", tmp_path / f"out{suffix}"
    nanogs.save(splats, source)
    more = file_bytes(splats, 3)
    arguments = {"size": more - 1, "preset": "fast", "block": block}
    report = nanogs.simplify_blocks(source, out, **arguments)
    assert report.achieved_count == 2
    [note] = [note for note in report.notes if "of the requested size" in note]
    assert note.endswith(f"a file of 3 splats takes {more:,} B.")
    whole = {"size": "1MB", "preset": "fast", "block": block, "overwrite": True}
    report = nanogs.simplify_blocks(source, out, **whole)
    assert any("whole model fits" in note for note in report.notes)


@pytest.mark.parametrize(("suffix", "block"), [(".splat", None), (".ply", 40)])
def test_a_report_says_whether_one_more_splat_is_too_large_in_formats_of_known_size(
    tmp_path, suffix, block
):
    splats = random_splats(40, degree=0)
    file_bytes = registry.writable(Path(f"a{suffix}")).file_bytes
    source, out = tmp_path / "in.ply", tmp_path / f"out{suffix}"
    nanogs.save(splats, source)
    for size, count, stop in (
        (file_bytes(splats, 3) - 1, 2, "step"),
        (file_bytes(splats, 3), 3, "target"),
        (2 * file_bytes(splats, 40), 40, "target"),
    ):
        report = nanogs.simplify_blocks(
            source, out, size=size, preset="fast", block=block, overwrite=True
        )
        assert (report.achieved_count, report.stop) == (count, stop)


@pytest.mark.parametrize("suffix", [".ply", ".usda"])
@pytest.mark.parametrize("block", [None, 40])
def test_a_note_does_not_call_a_model_whole_whose_harmonics_do_not_fit(tmp_path, suffix, block):
    splats = random_splats(12, degree=1)
    splats.sh[:, 1:] *= 0.01
    source, out = tmp_path / "in.ply", tmp_path / f"out{suffix}"
    nanogs.save(splats, source)
    bare = encoded_bytes(splats.with_sh_degree(0), out)
    report = nanogs.simplify_blocks(source, out, size=bare + 100, block=block, **FEW_VIEWS)
    assert (report.achieved_count, nanogs.open(out).columns.sh_degree) == (12, 0)
    start = "Without the harmonics that are left out, the whole model fits into the requested size;"
    assert [note for note in report.notes if "whole model fits" in note] == [
        f"{start} nothing was merged."
    ]


def test_a_splat_too_small_for_its_coordinates_has_a_first_view():
    one = random_splats(1)
    opening = opening_for(replace(one, log_scales=one.log_scales - 80))
    assert np.isfinite([*opening.position, *opening.target]).all()


def test_a_random_request_is_reproducible():
    first, again = (random_request(np.random.default_rng(5), {}, PRESETS) for _ in range(2))
    assert (str(first), run_and_check(first)) == (str(again), run_and_check(again))
    assert isinstance(first, Request)


def test_a_large_file_header_does_not_slow_down_the_size_search():
    """Counts are extrapolated along a line with an offset, not by the mean bytes per splat."""
    fitted = search_fit(lambda count: 4000 + 25 * count, 5250, 20, 1, 10**6)
    assert fitted.bytes >= 0.98 * 5250
    assert len(fitted.probes) <= 3


def test_the_viewer_in_a_page_does_not_count_as_used_size():
    """If the size is hardly above the viewer's, the splats still use all that it leaves."""
    viewer = 1_400_000
    fitted = search_fit(lambda n: viewer + 20 * n, viewer + 10_000, 1, 1, 10**6, overhead=viewer)
    assert fitted.bytes - viewer >= 0.98 * 10_000
    assert not fitted.notes(viewer + 10_000, 10**6, viewer)
    assert "of the requested size" in replace(fitted, bytes=viewer).notes(10**7, 10**6, viewer)[0]


def test_a_page_uses_the_size_that_the_viewer_leaves(tmp_path):
    scene = random_splats(400)
    one = tmp_path / "one.html"
    nanogs.save(scene.take(np.arange(1)), one)
    size = one.stat().st_size + 3000
    _, report = nanogs.simplify(scene, size=size, preset="fast", format=".html")
    assert size - 300 <= report.achieved_size <= size
    assert report.achieved_count > 50


def test_a_search_that_ends_early_says_so():
    fitted = search_fit(lambda count: 4000 + count.bit_length(), 10**6, 1, 1, 10**99)
    assert (len(fitted.probes), fitted.stop) == (MOST_PROBES, "settled")
    counts = [probe.count for probe in fitted.probes]
    assert counts == [16**power for power in range(MOST_PROBES)]
    (note,) = fitted.notes(10**6, 10**99)
    assert "no larger one was found in the allowed number of tries" in note


def test_the_file_that_is_named_as_too_large_has_more_splats():
    """A plain cut that leads the search may take more bytes than a fitted result of more splats."""
    probes = (SizeProbeReport(900, 1010), SizeProbeReport(950, 900), SizeProbeReport(959, 1200))
    (note,) = FittedSize(950, 900, probes, StopReason.STEP).notes(1000, 2000)
    assert note.endswith("because a file of 959 splats takes 1,200 B.")
    fitted = FittedSize(950, 900, (SizeProbeReport(990, 1300), *probes), StopReason.STEP)
    assert fitted.notes(1000, 2000) == (note,), "the smallest of those"
    assert FittedSize(950, 900, ()).notes(1000, 2000) == (), "nothing was tried"


def test_a_size_below_any_file_is_found_out_soon():
    tried = []
    with pytest.raises(TooSmallError, match="takes 1,000 B"):
        search_fit(lambda count: tried.append(count) or 1000, 999, 10**6, 1, 10**6)
    assert len(tried) <= MOST_PROBES + 20  # the count is halved at last


def test_a_size_that_falls_with_the_count_is_taken_for_noise():
    falling = [SizeProbeReport(1000, 50_000), SizeProbeReport(980, 50_500)]
    assert _along(falling, 40_000) == pytest.approx(980 * 40_000 / 50_500)


def test_the_first_guess_is_from_splats_of_the_whole_model():
    """Those at the end of this model take three times the bytes of those at its beginning."""
    count = 2 * SIZE_SAMPLE
    sample = random_splats(1).take(np.zeros(count, np.int64))
    sample.means[:, 0] = np.linspace(10, 30, count)

    def encode(some):
        return 5000 + int(some.means[:, 0].sum(dtype=np.float64))

    guess = guess_count(sample, 10**7, 10**6, encode)
    assert guess == pytest.approx((0.993 * 10**6 - 5000) / 20, rel=0.001)


@pytest.mark.parametrize(("fits", "expected"), [(True, 300), (False, 1)])
def test_the_first_guess_is_a_count_that_the_model_has(fits, expected):
    """Also if more splats take no more bytes, or if not even one splat fits."""
    for growing in (0, 5):
        sample = random_splats(300)

        def encode(some, growing=growing):
            return 1000 + growing * len(some)

        size = 10**6 if fits else 900
        assert guess_count(sample, 300, size, encode) == (expected if growing else 300)
        one = sample.take(np.arange(1))
        assert guess_count(one, 1, size, encode) == 1


def test_a_guess_that_is_much_too_large_is_corrected_at_once():
    fitted = search_fit(lambda count: 25 * count, 2500, 1000, 1, 10**6)
    assert [probe.count for probe in fitted.probes] == [1000, 99]


def test_a_jump_of_the_size_is_located_to_a_hundredth():
    def bytes_of(count):
        return 10 * count + 80_000 * (count > 5000)

    for guess in (3000, 7000):
        fitted = search_fit(bytes_of, 100_000, guess, 1, 10**6)
        assert fitted.stop == "step"
        over = min(probe.count for probe in fitted.probes if probe.bytes > 100_000)
        assert fitted.count + 1 < over <= 1.01 * fitted.count


@pytest.mark.parametrize(
    ("bytes_of", "available", "stop"),
    [
        (lambda count: 40 * count, 1000, "target"),
        (lambda count: 40 * count, 10, "target"),  # the whole model
        (lambda count: 40 * count if count <= 60 else 10**6, 1000, "step"),
    ],
)
def test_a_search_says_why_it_ended(bytes_of, available, stop):
    fitted = search_fit(bytes_of, 4000, 30, 1, available)
    assert fitted.stop == stop
    assert fitted.stop.met
    assert fitted.bytes <= 4000


@pytest.mark.parametrize("block", [None, 15])
def test_a_report_says_why_the_search_for_a_size_ended(tmp_path, block):
    """With so few splats, one takes more than the 2 % of the size that may stay unused."""
    source = tmp_path / "in.ply"
    nanogs.save(random_splats(40), source)
    report = nanogs.simplify_blocks(
        source, tmp_path / "a.spz", size=900, preset="fast", block=block
    )
    assert report.stop == ("target" if report.achieved_size >= 0.98 * 900 else "step")


def test_a_job_that_cannot_be_divided_leaves_no_files(tmp_path):
    source = tmp_path / "in.ply"
    nanogs.save(random_splats(1).take(np.zeros(20, np.int64)), source)
    with pytest.raises(CrowdedError, match=r"20 splats lie in one place.*; raise `block`"):
        nanogs.simplify_blocks(source, tmp_path / "a.ply", ratio=0.5, preset="fast", block=8)
    assert [*tmp_path.iterdir()] == [source]


def test_a_size_search_for_an_unstorable_model_leaves_no_files(tmp_path):
    source, splats = tmp_path / "in.ply", random_splats(40)
    far = replace(splats, means=splats.means + np.float32([1e8, 0, 0]))
    nanogs.save(far, source)
    with pytest.raises(UnstorableError, match="move the model to the origin"):
        nanogs.simplify_blocks(source, tmp_path / "a.spz", size=600, preset="fast", block=16)
    assert [*tmp_path.iterdir()] == [source]


def test_a_dry_run_in_blocks_applies_the_sh_degree(tmp_path):
    source, out = tmp_path / "in.ply", tmp_path / "out.ply"
    nanogs.save(random_splats(60, degree=3), source)
    arguments = ("--size", 3000, "--sh-degree", 0, "--job", tmp_path / "job", "--dry-run", "--json")
    plan = json.loads(run("simplify", source, out, *arguments).stdout)
    without_harmonics = nanogs.load(source).with_sh_degree(0)
    file_bytes = registry.writable(out).file_bytes
    assert (
        file_bytes(without_harmonics, plan["asked_count"])
        <= 3000
        < file_bytes(without_harmonics, plan["asked_count"] + 1)
    )


def test_the_overhead_of_every_file_does_not_count_as_used():
    over = SizeProbeReport(11, 1040)
    assert little_used(1000, 990, over, overhead=500) == ()
    [note] = little_used(1000, 989, over, overhead=500)
    assert note.endswith("because a file of 11 splats takes 1,040 B.")
    [note] = little_used(1000, 989, None, overhead=500)
    assert note.endswith("because no larger one was found in the allowed number of tries.")


@dataclass(frozen=True)
class Ended:
    """The fields of a result or a report that are read and changed."""

    stop: StopReason
    notes: tuple[str, ...] = ()


@pytest.mark.parametrize(
    ("stop", "each", "expected"),
    [
        (StopReason.TARGET, 400, StopReason.STEP),  # 1,200 of 1,500 B, and one more is too large
        (StopReason.NO_CANDIDATES, 400, StopReason.NO_CANDIDATES),
        (StopReason.TARGET, 495, StopReason.TARGET),  # 1,485 B
    ],
)
def test_a_size_that_jumps_is_the_reason_unless_something_else_ended_the_work(stop, each, expected):
    found = with_ending_on_known(
        Ended(stop), 1500, 3, 10, lambda count: each * count, left_out=False
    )
    assert found.stop is expected
    assert len(found.notes) == (each == 400)
