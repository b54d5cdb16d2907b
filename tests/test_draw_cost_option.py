"""`--draw-cost`: the largest model whose draw cost is at most a share of the original's."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import nanogs
from builders import random_splats
from launch import run
from nanogs.errors import ModelError, OptionError, OutputError, TooSmallError
from nanogs.pipeline.search.draw_cost import MOST_PROBES, NEAR_SHARE, search_share
from nanogs.report import StopReason
from nanogs.scoring.draw_views import DrawViews

pytestmark = pytest.mark.usefixtures("small_pictures")

QUICK = {"preset": "fast"}
RENDERS = {"preset": "default", "views": 2, "view_size": 48, "around": 0, "steps": 2}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "in.ply"
    model = random_splats(800, degree=1, seed=7)
    model.means[3] = np.nan
    nanogs.save(model, path)
    return path


def share_of(original, small):
    """Return the splats per pixel that `compare` reports, as a share of the original's."""
    result = run("compare", original, small, "--json")
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    costs = report["models"][0]["cost"], report["reference_cost"]
    return costs[0]["splats_a_pixel"] / costs[1]["splats_a_pixel"]


@settings(deadline=None, max_examples=200)
@given(
    asked=st.floats(0.02, 1.0),
    power=st.floats(0.1, 2.0),
    least=st.floats(0, 0.3),
    noise=st.floats(0, 0.05),
    available=st.integers(2, 10**7),
    fewest=st.integers(1, 50),
    guess=st.integers(0, 10**7),
    quick=st.booleans(),
)
def test_the_search_ends_at_or_below_the_requested_share(
    asked, power, least, noise, available, fewest, guess, quick
):
    fewest, tried = min(fewest, available - 1), {}

    def measured(count):
        assert fewest <= count < available
        assert count not in tried, "no count is tried twice"
        unevenness = 1 + noise * np.sin(count * 12.9898)
        tried[count] = (least + (1 - least) * (count / available) ** power) * unevenness
        return tried[count]

    try:
        found = search_share(measured, asked, fewest, available, guess, quick=quick)
    except TooSmallError:
        assert tried[fewest] > asked
        return
    assert [probe.count for probe in found.probes] == [*tried]
    assert len(tried) <= MOST_PROBES + 1
    assert tried[found.count] <= asked * (1 + NEAR_SHARE * quick)
    if found.stop is StopReason.TARGET:
        assert tried[found.count] >= asked * (1 - NEAR_SHARE)
    else:
        fitting = [count for count, share in tried.items() if share <= asked]
        assert found.count == max(fitting)


def test_a_model_that_cannot_be_merged_is_tried_whole():
    counts = []
    with pytest.raises(TooSmallError, match="7 splats, the fewest"):
        search_share(lambda count: counts.append(count) or 1.0, 0.5, 7, 7, 3)
    assert counts == [7]


def test_a_quick_search_accepts_a_share_just_above_the_one_asked_for():
    found = search_share(lambda _count: 0.505, 0.5, 1, 1000, 100, quick=True)
    assert [(probe.count, probe.quick) for probe in found.probes] == [(100, True)]


def test_a_step_in_the_cost_is_reported_as_the_stop_reason():
    def share(count):
        return 0.2 if count < 700 else 0.9

    found = search_share(share, 0.5, 1, 1000, 500)
    assert found.stop is StopReason.STEP
    assert 690 <= found.count < 700


@pytest.mark.parametrize("suffix", [".ply", ".sog"])
@pytest.mark.parametrize("preset", [QUICK, RENDERS], ids=["fast", "default"])
@pytest.mark.parametrize("block", [None, 300])
def test_the_file_has_the_requested_draw_cost(scene, tmp_path, suffix, preset, block):
    out = tmp_path / f"a{suffix}"
    report = nanogs.simplify_blocks(scene, out, draw_cost=0.5, block=block, **preset)
    assert report.stop is StopReason.TARGET
    assert report.asked_draw_cost == 0.5
    assert (report.blocks is not None) == bool(block)
    share = report.cost.share_of(report.original_cost)
    assert 0.5 * (1 - NEAR_SHARE) <= share <= 0.5
    assert share_of(scene, out) == pytest.approx(share, rel=1e-12)
    assert report.achieved_count == report.asked_count == nanogs.open(out).count
    assert (report.achieved_count, share) in [(p.count, p.share) for p in report.draw_probes]
    assert any(probe.quick for probe in report.draw_probes) == (preset is RENDERS)
    assert [*tmp_path.iterdir()] == [out]


@pytest.mark.parametrize("preset", [QUICK, RENDERS], ids=["fast", "default"])
@pytest.mark.parametrize("block", [None, 300])
def test_each_result_is_measured_once(scene, tmp_path, monkeypatch, preset, block):
    measured = []

    def counted(self, model):
        measured.append(model.count if isinstance(model, nanogs.Source) else len(model))
        return cost(self, model)

    cost = DrawViews.cost
    monkeypatch.setattr(DrawViews, "cost", counted)
    report = nanogs.simplify_blocks(scene, tmp_path / "a.sog", draw_cost=0.5, block=block, **preset)
    assert measured == [probe.count for probe in report.draw_probes]


def test_the_command_accepts_shares_and_prints_the_achieved_one(scene, tmp_path):
    out = tmp_path / "a.ply"
    result = run("simplify", scene, out, "--draw-cost", "40%", "--preset", "fast")
    assert result.returncode == 0, result.stderr
    assert f"{share_of(scene, out):.1%} of the splats a pixel" in result.stderr
    planned = run("simplify", scene, out, "--draw-cost", "0.4", "--dry-run", "-w")
    assert planned.returncode == 0, planned.stderr
    assert "40.0% of the splats a pixel" in planned.stderr
    verbose = run("simplify", scene, out, "--draw-cost", "0.4", "--preset", "fast", "-w", "-v")
    assert "draw probes:" in verbose.stderr


@pytest.mark.parametrize("block", [None, 300])
def test_the_cost_is_measured_on_the_filtered_model_in_its_own_frame(scene, tmp_path, block):
    edits = {"filters": [nanogs.filters.box((-9, -9, -9), (0.6, 9, 9))], "frame": ("rdf", "rub")}
    out, filtered = tmp_path / "a.ply", tmp_path / "left.ply"
    report = nanogs.simplify_blocks(scene, out, draw_cost=0.6, block=block, **edits, **QUICK)
    filtered_splats, _ = nanogs.filters.apply(nanogs.load(scene), edits["filters"])
    nanogs.save(filtered_splats, filtered)
    turned_back = tmp_path / "turned.ply"
    nanogs.convert(out, turned_back, frame=("rub", "rdf"))
    share = report.cost.share_of(report.original_cost)
    assert share_of(filtered, turned_back) == pytest.approx(share, rel=1e-6)


@pytest.mark.parametrize("block", [None, 300])
def test_a_draw_cost_of_one_keeps_the_whole_model(scene, tmp_path, block):
    report = nanogs.simplify_blocks(scene, tmp_path / "a.ply", draw_cost=1.0, block=block, **QUICK)
    assert report.draw_probes == ()
    assert report.achieved_count == 799
    assert report.cost.splats_a_pixel == report.original_cost.splats_a_pixel


@pytest.mark.parametrize("preset", [QUICK, RENDERS], ids=["fast", "default"])
@pytest.mark.parametrize("block", [None, 300])
def test_a_whole_model_that_its_format_makes_costlier_is_reduced(tmp_path, preset, block):
    """Scales of .spz begin at exp(-10): smaller splats grow when they are written."""
    model = random_splats(800, degree=0, seed=7)
    model.means[:] *= np.float32(1e-3)
    model.log_scales[:] -= np.float32(7)
    nanogs.save(model, tmp_path / "in.ply")
    assert nanogs.draw_cost(nanogs.io.round_trip(model, "a.spz")).share_of(
        nanogs.draw_cost(model)
    ) > 1.02  # fmt: skip
    out = tmp_path / "a.spz"
    report = nanogs.simplify_blocks(tmp_path / "in.ply", out, draw_cost=1.0, block=block, **preset)
    share = report.cost.share_of(report.original_cost)
    assert 1 - NEAR_SHARE <= share <= 1
    assert share_of(tmp_path / "in.ply", out) == pytest.approx(share, rel=1e-12)
    assert report.stop is StopReason.TARGET
    whole = [probe for probe in report.draw_probes if probe.count == len(model)]
    assert [probe.quick for probe in whole] == [False]
    assert whole[0].share > 1


@pytest.mark.parametrize("block", [None, 300])
def test_a_draw_cost_below_that_of_one_splat_is_refused(scene, tmp_path, block):
    with pytest.raises(TooSmallError, match=r"cost of 0\.001% is too small: 1 splat, the"):
        nanogs.simplify_blocks(scene, tmp_path / "a.ply", draw_cost=1e-5, block=block, **QUICK)
    assert not list(tmp_path.iterdir())


def test_a_draw_cost_that_no_result_has_is_refused_with_a_remedy_that_helps():
    """Merged splats of a sparse model can cost more than the model: no allowed share is enough."""
    with pytest.raises(TooSmallError, match=r"cost 40\.00% .* allow at least that"):
        search_share(lambda _count: 0.4, 0.1, 1, 1000, 100)
    with pytest.raises(TooSmallError, match=r"cost 160\.00% .* ask for a `ratio` or a `count`"):
        search_share(lambda _count: 1.6, 0.5, 1, 1000, 100)


def test_impossible_requests_are_refused(scene, tmp_path):
    out = tmp_path / "a.ply"
    for request in ({"draw_cost": 0.0}, {"draw_cost": 1.5}, {"draw_cost": 0.5, "ratio": 0.5}):
        with pytest.raises(OptionError, match="draw"):
            nanogs.simplify_blocks(scene, out, **request)
    with pytest.raises(OptionError, match="a draw cost"):
        nanogs.simplify(nanogs.load(scene), draw_cost=0.5, preset="paper")
    result = run("simplify", scene, out, "--draw-cost", "0.5", "--psnr", "30")
    assert result.returncode == 2
    assert "--draw-cost" in result.stderr
    unseen = random_splats(20)
    unseen.opacity_logits[:] = -20
    with pytest.raises(ModelError, match="draw cost cannot be measured"):
        nanogs.simplify(unseen, draw_cost=0.5, **QUICK)
    assert not list(tmp_path.iterdir())


def test_an_interrupted_search_resumes_to_the_same_bytes(scene, tmp_path):
    options = {"draw_cost": 0.5, "block": 300, **QUICK}
    expected, resumed = tmp_path / "one.ply", tmp_path / "two.ply"
    nanogs.simplify_blocks(scene, expected, **options)
    for least in (0.3, 0.6, 0.8):

        def interrupt(step, least=least):
            if step.fraction > least:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            nanogs.simplify_blocks(scene, resumed, progress=interrupt, resume=True, **options)
    with pytest.raises(OutputError, match="search"):
        nanogs.simplify_blocks(scene, resumed, resume=True, **{**options, "draw_cost": 0.6})
    nanogs.simplify_blocks(scene, resumed, resume=True, **options)
    assert resumed.read_bytes() == expected.read_bytes()


@pytest.mark.parametrize("block", [None, 300])
def test_a_measured_result_reports_its_draw_cost(scene, tmp_path, block):
    out = tmp_path / "a.spz"
    options = {"ratio": 0.2, "block": block, **QUICK}
    unmeasured = nanogs.simplify_blocks(scene, tmp_path / "plain.spz", **options)
    assert unmeasured.cost is None
    report = nanogs.simplify_blocks(scene, out, measured=True, frame=("rdf", "rub"), **options)
    cost = nanogs.draw_cost(scene)
    assert report.original_cost.splats_a_pixel == pytest.approx(cost.splats_a_pixel, rel=1e-12)
    turned_back = tmp_path / "back.npz"
    nanogs.convert(out, turned_back, frame=("rub", "rdf"))
    share = report.cost.share_of(report.original_cost)
    assert share_of(scene, turned_back) == pytest.approx(share, rel=1e-6)
    assert share > 0.2, "a fifth of the splats takes more than a fifth of the work"


@pytest.mark.parametrize("block", [None, 300])
@pytest.mark.parametrize("target", ["levels", "stream/lod-meta.json"])
def test_measured_levels_report_their_draw_cost(scene, tmp_path, block, target):
    layout = "files" if target == "levels" else "streamed sog"
    folder = (tmp_path / target).parent if "." in target else tmp_path / target
    manifest, _ = nanogs.write_levels(
        scene, folder, [0.5, 0.1], layout=layout, measured=True, block=block, **QUICK
    )
    for number, level in enumerate(manifest.levels):
        path, level_in_file = (
            (folder / level.file, 0) if layout == "files" else (tmp_path / target, number)
        )
        nanogs.save(nanogs.load(path, level=level_in_file), tmp_path / f"{number}.npz")
        share = share_of(scene, tmp_path / f"{number}.npz")
        assert level.draws == pytest.approx(share, rel=1e-9)
        assert level.ratio < level.draws < 1
    unmeasured, _ = nanogs.write_levels(scene, tmp_path / "plain", [0.1], **QUICK)
    assert unmeasured.levels[0].draws is None


def test_the_command_prints_the_draw_cost_of_levels(scene, tmp_path):
    arguments = ["lod", scene, tmp_path / "levels", "--levels", "0.5,0.1", "--preset", "fast"]
    result = run(*arguments, "--measure")
    assert result.returncode == 0, result.stderr
    assert "draws: splats a pixel" in result.stderr
    manifest = json.loads((tmp_path / "levels" / "levels.json").read_text(encoding="utf-8"))
    for level in manifest["levels"]:
        assert f"{level['draws']:.1%}" in result.stderr
