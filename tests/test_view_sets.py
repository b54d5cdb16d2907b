"""Several kinds and sizes of views in one run, and their numbers in every output."""

import json
import math

import pytest

import nanogs
from nanogs.bench.run import run_bench
from nanogs.bench.scenes import BenchScene
from nanogs.bench.settings import BenchSettings
from nanogs.bench.tables import scene_table
from nanogs.datasets.synthetic import make_scene
from nanogs.errors import OptionError
from nanogs.formatting import number_text
from nanogs.protocol import usual_views
from nanogs.scoring.run import compare_files
from nanogs.scoring.view_sets import parse_kinds, view_sets
from test_cli import run

SCENE = make_scene(1500)
LABELS = ["auto 48", "auto 96", "roam 48", "roam 96"]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sets")
    nanogs.save(SCENE, folder / "scene.ply")
    nanogs.save(nanogs.simplify(SCENE, ratio=0.2, preset="fast")[0], folder / "small.ply")
    return [folder / "scene.ply", folder / "small.ply"]


def test_each_kind_and_size_of_views_is_scored_separately(files):
    found = nanogs.compare(*files, cameras=["auto", "roam"], pixels=[48, 96], views=2)
    assert [one.protocol.label for one in found.each] == LABELS
    psnrs = [one.models[0].psnr for one in found.each]
    assert len(set(psnrs)) == 4
    for one, label in zip(found.each, LABELS, strict=True):
        kind, size = label.split()
        alone = nanogs.compare(*files, cameras=kind, pixels=int(size), views=2)
        assert alone.models == one.models
        assert alone.further == ()


def test_the_worst_view_is_reported(files):
    model = nanogs.compare(*files, views=3, pixels=48).models[0]
    worst = min(model.views, key=lambda view: view.psnr)
    assert (model.least_psnr, model.least_view) == (worst.psnr, worst.view)
    assert model.least_psnr < model.psnr


def test_a_kind_has_the_same_camera_positions_at_all_sizes():
    small, wide, large = view_sets(SCENE, ["roam"], [(48, 48), (64, 32), (96, 96)], views=2)
    for one, other in zip(small.cameras, large.cameras, strict=True):
        assert (one.world_to_camera == other.world_to_camera).all()
        assert other.fx == pytest.approx(2 * one.fx)
    assert [camera.width for camera in wide.cameras] == [64, 64]


def test_each_kind_has_its_usual_number_of_views():
    auto, inside = view_sets(SCENE, ["auto", "inside"], [(16, 16)])
    assert len(auto.cameras) == len(inside.cameras) == usual_views("auto") == 8
    assert usual_views("roam") == 24


def test_fewer_views_than_requested_are_noted(monkeypatch):
    monkeypatch.setattr("nanogs.views.roam.TRIES", 12)
    [found] = view_sets(SCENE, ["roam"], [(16, 16)], views=8)
    assert 1 < len(found.cameras) < 8
    assert found.notes == (f"roam: {len(found.cameras)} views were found of 8 asked for",)


def test_sources_are_kinds_or_one_path():
    assert parse_kinds("auto, roam") == ["auto", "roam"]
    assert parse_kinds("a,b.json") == ["a,b.json"]
    with pytest.raises(OptionError, match="'orbti' is not a kind of cameras"):
        parse_kinds("auto,orbti")


@pytest.mark.parametrize(
    ("sources", "sizes", "message"),
    [
        (["auto", "auto"], [(16, 16)], "kind of cameras is given twice"),
        (["auto"], [(16, 16), (16, 16)], "size is given twice"),
        (["a.json"], [(16, 16), (32, 32)], "have sizes of their own"),
        (["a.json"], [(16, 16)], "no camera file 'a.json'"),
    ],
)
def test_invalid_kinds_and_sizes_of_views_are_refused(sources, sizes, message):
    with pytest.raises(OptionError, match=message):
        view_sets(SCENE, sources, sizes)


def test_the_command_reports_each_kind_and_size(files):
    options = ("--sizes", "48,96", "--cameras", "auto,roam", "--views", "2")
    report = json.loads(run("compare", *files, *options, "--json").stdout)
    each = [report, *report["further"]]
    assert [one["protocol"]["kind"] for one in each] == ["auto", "auto", "roam", "roam"]
    assert [one["protocol"]["pixels"] for one in each] == [[48, 48], [96, 96]] * 2
    table = run("compare", *files, *options)
    lines = table.stdout.splitlines()
    assert "worst" in lines[0]
    for one, label, line in zip(each, LABELS, lines[1:], strict=True):
        model = one["models"][0]
        assert label in line
        for value in (model["psnr"], model["least_psnr"]):
            assert f"{value:.2f}" in line
        assert f"{model['ssim']:.4f}" in line
    legend = " ".join(table.stderr.split())
    assert "2 held-out views of 48 pixels (auto 48)," in legend
    assert "2 held-out roaming views of 96 pixels (roam 96);" in legend
    assert "share of the original's on the same views" in legend


def test_the_page_has_each_score_and_pictures_of_each_kind(files, tmp_path):
    page = tmp_path / "page.html"
    found = compare_files(
        ("scene", files[0]), [("small", files[1])], cameras="auto,roam", views=2,
        sizes=[(48, 48), (64, 64)], report=page,
    )  # fmt: skip
    text = page.read_text(encoding="utf-8")
    for one in found.each:
        assert f'<td data-is="views">{one.protocol.label}</td>' in text
        assert f'data-is="worst (dB)">{one.models[0].least_psnr:.2f}<' in text
    assert 'data-views="4"' in text
    for one in (found.each[0], found.each[2]):
        for view in one.models[0].views:
            assert f"{number_text(view.psnr)} dB" in text


def test_the_page_says_which_views_each_of_its_numbers_and_pictures_is_of(files, tmp_path):
    page = tmp_path / "page.html"
    found = compare_files(
        ("scene", files[0]), [("small", files[1]), ("whole", files[0])], cameras="auto,inside",
        views=1, sizes=[(48, 48), (64, 64)], report=page, interactive=False,
    )  # fmt: skip
    text = page.read_text(encoding="utf-8")
    auto, inside = (f"1 held-out view of 48 pixels ({kind} 48)" for kind in ("auto", "inside"))
    assert auto in text
    assert inside in text
    assert f">{auto}</text>" in text  # title of the plot
    assert "share of the original's on the same views." in text
    assert found.reference_cost.pixel_text not in text.split("share of the original")[1][:100]
    for number, kind in enumerate(("auto", "inside"), 1):
        assert f"<h3>View {number} of 2: {kind} 48</h3>" in text
        assert f'data-caption="{kind} 48: small has' in text
    assert "only those of the first size are pictured" in text
    one = tmp_path / "one.html"
    single = compare_files(
        ("scene", files[0]), [("small", files[1])], views=1, sizes=[(48, 48)], report=one,
        interactive=False,
    )  # fmt: skip
    text = one.read_text(encoding="utf-8")
    assert "(auto 48)" not in text
    assert f"share of the original's, {single.reference_cost.pixel_text}." in text
    assert "first size" not in text
    assert "<h3>View 1 of 1</h3>" in text


def test_bench_reports_each_kind_and_size_in_a_row(files):
    settings = BenchSettings(
        ratios=(0.2,), methods=("opacity",), kinds=("auto", "roam"), sizes=(32, 48), views=1,
        fit_views=1,
    )  # fmt: skip
    rows = run_bench([BenchScene("a", files[0])], settings)
    labels = [one.label for one in rows[1].sets]
    assert labels == ["auto 32", "auto 48", "roam 32", "roam 48"]
    for one in rows[1].sets:
        assert math.isfinite(one.psnr)
        assert one.least_psnr == one.psnr
        assert one.views == 1
    table = scene_table(rows)
    assert "1 view (auto 32), 1 view (auto 48), 1 view (roam 32), 1 view (roam 48)." in table
    assert "| PSNR, roam 48 | worst, roam 48 | SSIM, roam 48 |" in table
    assert f"{rows[1].further[2].psnr:.2f}" in table
