"""`simplify_blocks` and `write_levels`, which take files of any size."""

import dataclasses
import itertools
import shutil

import numpy as np
import pytest

import nanogs
from builders import random_splats
from nanogs import filters
from nanogs.errors import NotEnoughMemoryError, OptionError, OutputError
from nanogs.frames import change_frame
from nanogs.lod.layout import LodLayout
from nanogs.memory import LIBRARIES
from nanogs.pipeline.options.target import Goal
from nanogs.pipeline.request import Request, plan_files
from nanogs.scoring.file_judge import file_judge
from nanogs.sink import OneFile
from viewer_bundle import require_bundle

pytestmark = pytest.mark.usefixtures("small_pictures")

COUNT = 3000
QUICK = {"preset": "fast", "threads": 1}


@pytest.fixture(scope="module")
def splats():
    return random_splats(COUNT, degree=1)


@pytest.fixture(scope="module")
def scene(splats, tmp_path_factory):
    path = tmp_path_factory.mktemp("files") / "scene.ply"
    nanogs.save(splats, path)
    return path


def test_a_model_that_fits_into_memory_is_simplified_as_one(splats, scene, tmp_path):
    out = tmp_path / "a.ply"
    report = nanogs.simplify_blocks(scene, out, ratio=0.1, **QUICK)
    small, _ = nanogs.simplify(splats, ratio=0.1, **QUICK)
    nanogs.save(small, tmp_path / "b.ply")
    assert out.read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert (report.blocks, report.read_count, report.achieved_count) == (None, COUNT, 300)
    assert {"read", "match", "write"} <= set(report.seconds)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.ply", "b.ply"]


def test_a_model_that_does_not_fit_is_divided_into_blocks(scene, tmp_path):
    tight = LIBRARIES + 400_000
    assert plan_files(request(scene, tmp_path, max_memory=tight)).divided
    assert not plan_files(request(scene, tmp_path, max_memory=LIBRARIES + 2 * 10**8)).divided
    with pytest.raises(OptionError, match="must be at least"):  # less than one block takes
        nanogs.simplify_blocks(scene, tmp_path / "a.ply", ratio=0.1, max_memory=tight, **QUICK)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("options", [{"block": 500}, {"job": "kept"}, {"scratch": "files"}])
def test_options_of_jobs_make_blocks_of_a_small_model_too(scene, tmp_path, options):
    options = {name: tmp_path / value if isinstance(value, str) else value
               for name, value in options.items()}  # fmt: skip
    options = {name: str(value) if name == "scratch" else value for name, value in options.items()}
    report = nanogs.simplify_blocks(scene, tmp_path / "a.ply", ratio=0.1, **options, **QUICK)
    assert (report.blocks.blocks > 1) == ("block" in options)
    assert report.achieved_count == 300


def test_reports_of_blocks_have_the_entries_of_a_run_in_memory(splats, scene, tmp_path):
    """All entries are filled in; the passes of one block are those of the model in memory."""
    options = {"ratio": 0.2, "preset": "default", "views": 6, "view_size": 48, "steps": 4}
    _, in_memory = nanogs.simplify(splats, **options)
    of_one_block, of_several_blocks = (
        nanogs.simplify_blocks(scene, tmp_path / f"{block}.ply", block=block, **options)
        for block in (2 * COUNT, 1000)
    )
    fast_in_blocks = nanogs.simplify_blocks(
        scene, tmp_path / "f.ply", ratio=0.2, block=2 * COUNT, **QUICK
    )
    _, fast_in_memory = nanogs.simplify(splats, ratio=0.2, **QUICK)
    assert fast_in_blocks.passes == tuple(
        dataclasses.replace(entry, seconds={}) for entry in fast_in_memory.passes
    )
    for report in (of_one_block, of_several_blocks):
        first, last = report.passes[0], report.passes[-1]
        assert (first.count_before, last.count_after) == (COUNT, report.blocks.blocks)
        for before, after in itertools.pairwise(report.passes):
            assert before.count_after == after.count_before
        assert sum(entry.merged for entry in report.passes) == COUNT - report.blocks.blocks
        assert report.shown == pytest.approx(in_memory.shown, abs=0.05)
        assert [(entry.balance, entry.reassigned) for entry in report.candidates[:3]] == [
            (entry.balance, entry.reassigned) for entry in in_memory.candidates[:3]
        ]
        assert report.fit.psnr_after >= report.fit.psnr_before


def test_one_call_joins_filters_turns_simplifies_and_measures(splats, scene, tmp_path):
    chosen_filters = [filters.opaque_enough(0.3)]
    out, other = tmp_path / "a.ply", shutil.copy(scene, tmp_path / "other.ply")
    report = nanogs.simplify_blocks(
        [scene, other], out, ratio=0.2, filters=chosen_filters, sh_degree=0, frame=("rdf", "rub"),
        measured=True, **QUICK,
    )  # fmt: skip
    count_left = 2 * int((splats.opacities() >= 0.3).sum())
    assert (report.read_count, report.filters[0].left) == (2 * COUNT, count_left)
    assert report.achieved_count == -(-count_left // 5)
    assert report.judged is not None
    assert any("above degree 0 were dropped" in note for note in report.notes)
    small = nanogs.load(out)
    assert small.sh_degree == 0
    low, high = splats.means.min(axis=0), splats.means.max(axis=0)
    assert (np.sort([-low[1], -high[1]])[0] - 1e-3 <= small.means[:, 1]).all()


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".splat", ".npz", ".sog"])
def test_a_file_size_is_met_in_memory_and_in_blocks(scene, tmp_path, suffix):
    out, target = tmp_path / f"a{suffix}", {"size": 20_000}
    report = nanogs.simplify_blocks(scene, out, **target, **QUICK)
    assert (report.asked_size, report.achieved_size) == (20_000, out.stat().st_size)
    divided = tmp_path / f"b{suffix}"
    block_report = nanogs.simplify_blocks(scene, divided, block=500, **target, **QUICK)
    assert block_report.blocks.blocks > 1
    assert (block_report.asked_size, block_report.achieved_size) == (20_000, divided.stat().st_size)
    assert 0.97 * 20_000 < block_report.achieved_size <= 20_000
    if suffix != ".sog":  # the size of which depends on more than the count
        assert block_report.achieved_count == report.achieved_count


@pytest.mark.parametrize("suffix", [".ply", ".sog", ".spz"])
@pytest.mark.parametrize("block", [None, 500])
def test_a_file_size_is_met_for_the_frame_that_is_written(scene, tmp_path, suffix, block):
    path = tmp_path / f"a{suffix}"
    options = {"size": 20_000, "frame": ("rdf", "rub"), "block": block} | QUICK
    report = nanogs.simplify_blocks(scene, path, **options)
    assert report.achieved_size == path.stat().st_size <= 20_000
    assert path.stat().st_size > 19_000
    if block is None:  # the same splats, turned in memory or on their way to the file
        options = {"size": 20_000, "format": suffix, "frame": ("rdf", "rub")} | QUICK
        small, _ = nanogs.simplify(scene, **options)
        nanogs.save(small, tmp_path / f"b{suffix}", format_options=report.format_options)
        assert (tmp_path / f"b{suffix}").read_bytes() == path.read_bytes()


def test_a_psnr_is_met_for_a_turned_file(scene):
    options = {"psnr": 24.0, "format": ".spz", "preset": "fast"}
    unturned, report = nanogs.simplify(scene, **options)
    turned, turned_report = nanogs.simplify(scene, **options, frame=("rdf", "rub"))
    assert turned_report.judged.psnr == pytest.approx(report.judged.psnr, abs=0.1)
    turned_back = change_frame(turned, "rub", "rdf")
    assert len(turned_back) == pytest.approx(len(unturned), rel=0.05)
    with pytest.raises(OptionError, match="frame"):
        nanogs.simplify(scene, **options, frame=("rdf", "up"))


def test_a_large_size_keeps_all_splats_and_a_tiny_size_is_refused(scene, tmp_path):
    out = tmp_path / "a.ply"
    report = nanogs.simplify_blocks(scene, out, size="1GB", block=500, **QUICK)
    assert report.achieved_count == COUNT
    with pytest.raises(OptionError, match="too small"):
        nanogs.simplify_blocks(scene, tmp_path / "b.ply", size=100, block=500, **QUICK)


@pytest.mark.parametrize("changes", [{}, {"sh_degree": 0, "frame": ("rdf", "rub")}])
def test_results_made_in_blocks_are_measured_as_those_in_memory(splats, scene, tmp_path, changes):
    out, steps = tmp_path / "a.ply", []
    report = nanogs.simplify_blocks(
        scene, out, ratio=0.2, block=1000, measured=True, progress=steps.append, **changes, **QUICK
    )
    assert report.blocks.blocks > 1
    original = splats.with_sh_degree(0) if changes else splats
    judge = file_judge(original, ".ply", turn=changes.get("frame"))
    assert report.judged == judge.of(out)
    fractions = [step.fraction for step in steps]
    assert fractions == sorted(fractions)
    assert (fractions[-1], steps[-1].stage) == (1, "measure")
    assert fractions[-2] < 1


@pytest.mark.parametrize("suffix", [".sog", ".spz"])
def test_packed_files_are_measured_in_blocks(splats, tmp_path, suffix):
    scene, out = tmp_path / f"scene{suffix}", tmp_path / f"a{suffix}"
    nanogs.save(splats, scene)
    report = nanogs.simplify_blocks(scene, out, ratio=0.2, block=1000, measured=True, **QUICK)
    assert report.judged == file_judge(nanogs.load(scene), suffix).of(out)


def test_formats_that_are_not_read_are_not_measured_in_blocks(scene, tmp_path):
    require_bundle()
    out = tmp_path / "a.html"
    report = nanogs.simplify_blocks(scene, out, ratio=0.2, block=1000, measured=True, **QUICK)
    assert report.judged is None
    assert "PSNR and SSIM were not measured: nanogs does not read .html files." in report.notes


def test_levels_made_in_blocks_are_measured_as_those_in_memory(splats, scene, tmp_path):
    options = {"measured": True, "block": 1000} | QUICK
    for layout, name in (("files", "level_{}.ply"), ("streamed sog", "lod-meta.json")):
        folder = tmp_path / layout
        manifest, reports = nanogs.write_levels(
            scene, folder, [0.5, 0.1], layout=layout, frame=("rdf", "rub"), **options
        )
        judge = file_judge(splats, ".ply", turn=("rdf", "rub"))
        levels = (0, 0) if layout == "files" else (0, 1)
        for number, (entry, report, level) in enumerate(
            zip(manifest.levels, reports, levels, strict=True)
        ):
            judged = judge.of(folder / name.format(number), level)
            assert (entry.psnr, entry.ssim) == (judged.psnr, judged.ssim)
            assert report.judged == judged
        assert manifest.protocol == judged.protocol
        assert manifest.levels[0].psnr > manifest.levels[1].psnr


@pytest.mark.parametrize("layout", list(LodLayout))
def test_reports_of_levels_made_in_memory_have_the_scores_of_the_files(splats, tmp_path, layout):
    place = tmp_path / {LodLayout.TREE: "a.rad", LodLayout.ARCHIVE: "a.ssog"}.get(layout, "levels")
    manifest, reports = nanogs.write_levels(
        splats, place, [0.5, 0.1], layout=layout, measured=True, **QUICK
    )
    for entry, report in zip(manifest.levels, reports, strict=True):
        assert (report.judged.psnr, report.judged.ssim) == (entry.psnr, entry.ssim)
        assert report.judged.protocol == manifest.protocol
        assert report.cost.share_of(report.original_cost) == entry.draws


def test_resuming_an_unmeasured_job_with_measured_measures_it(scene, tmp_path, monkeypatch):
    out, move = tmp_path / "a.ply", OneFile.move

    def interrupt(*_):
        raise KeyboardInterrupt

    options = {"ratio": 0.2, "block": 1000} | QUICK
    monkeypatch.setattr(OneFile, "move", interrupt)
    with pytest.raises(KeyboardInterrupt):
        nanogs.simplify_blocks(scene, out, **options)
    monkeypatch.setattr(OneFile, "move", move)
    report = nanogs.simplify_blocks(scene, out, resume=True, measured=True, **options)
    assert report.judged == file_judge(nanogs.load(scene), ".ply").of(out)


def test_a_psnr_is_met_in_memory_and_in_blocks(scene, tmp_path):
    for options in ({}, {"block": 500}):
        report = nanogs.simplify_blocks(
            scene, tmp_path / "a.ply", psnr=15.0, overwrite=True, **options, **QUICK
        )
        assert report.achieved_count < COUNT
        assert report.judged.psnr >= 15.0
    with pytest.raises(NotEnoughMemoryError, match="Measuring takes about"):
        nanogs.simplify_blocks(
            scene, tmp_path / "b.ply", max_memory=LIBRARIES + 400_000, psnr=15.0, **QUICK
        )
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


def request(scene, folder, **given):
    return Request(inputs=(scene,), output=folder / "a.ply", goal=Goal(ratio=0.1), **given)


@pytest.mark.parametrize(
    ("source", "target", "column", "message"),
    [
        ("a.npz", "b.ply", "label", "'label' is int64, which PLY cannot hold"),
        ("a.npz", "b.ply", "my label", "'my label' is empty or holds a space"),
        ("a.npz", "b.ply", "scale_0", "'scale_0' has a splat's own name"),
        ("a.ply", "b.npz", r"my\label", "cannot hold the name"),
    ],
)
def test_columns_that_the_output_cannot_hold_are_refused_before_any_work(
    tmp_path, source, target, column, message
):
    kind = np.int64 if column == "label" else np.float32
    extras = {column: np.arange(300, dtype=kind)}
    source, out = tmp_path / source, tmp_path / target
    nanogs.save(random_splats(300, extras=extras), source)
    steps = []
    options = {"preset": "fast", "progress": steps.append}
    levels = tmp_path / "lv", [0.5]
    for work in (
        lambda: nanogs.simplify_blocks(source, out, ratio=0.5, **options),
        lambda: nanogs.simplify_blocks(source, out, ratio=0.5, block=100, **options),
        lambda: nanogs.write_levels(source, *levels, suffix=out.suffix, **options),
        lambda: nanogs.write_levels(nanogs.load(source), *levels, suffix=out.suffix, **options),
        lambda: nanogs.convert(source, out, progress=steps.append),
    ):
        with pytest.raises(OutputError, match=message):
            work()
    assert [step.stage for step in steps] == []
    assert [path.name for path in tmp_path.iterdir()] == [source.name]
    again = tmp_path / f"c{source.suffix}"
    nanogs.simplify_blocks(source, again, ratio=0.5, preset="fast")
    assert nanogs.load(again).extras[column].dtype == kind
