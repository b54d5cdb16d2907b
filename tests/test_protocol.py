"""All commands report the same PSNR for the same model."""

import json
from dataclasses import asdict

import numpy as np
import pytest

import nanogs
from launch import run
from nanogs.datasets.synthetic import make_scene
from nanogs.method.parameters import ForestParameters
from nanogs.protocol import Protocol
from nanogs.scoring.file_judge import file_judge
from nanogs.scoring.held_out import held_out
from nanogs.views.automatic import automatic_cameras
from viewer_bundle import require_bundle
from views_and_scores import scene_with_views

WORDS = "8 held-out views of 512 pixels"
FEW = ("--views", "4", "--view-size", "64", "--steps", "2")  # a small fit


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("protocol") / "scene.ply"
    nanogs.save(make_scene(1000), path)
    return path


def report_of(*words):
    result = run(*words, "--json")
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


@pytest.mark.slow
def test_simplify_lod_compare_and_view_report_the_same_scores(scene, tmp_path):
    require_bundle()
    small, levels = tmp_path / "small.ply", tmp_path / "levels"
    fast = ("--preset", "fast", "--measure")  # any result will do
    numbers = [report_of("simplify", scene, small, "-r", "0.2", *fast)["judged"]]
    [compared] = (report := report_of("compare", scene, small))["models"]
    numbers.append({name: compared[name] for name in ("psnr", "ssim")})
    numbers.append(report_of("view", scene, small, "-o", tmp_path / "a.html")["judged"])
    numbers.append(report_of("lod", scene, levels, "--levels", "0.2", *fast)["levels"][0])
    numbers.append(json.loads((levels / "levels.json").read_text())["levels"][0])
    for other in numbers[1:]:
        assert other["psnr"] == pytest.approx(numbers[0]["psnr"], abs=0.01)
        assert other["ssim"] == pytest.approx(numbers[0]["ssim"], abs=1e-4)
    protocol = json.loads((levels / "levels.json").read_text())["protocol"]
    assert protocol == report["protocol"] == numbers[0]["protocol"] == numbers[2]["protocol"]
    assert protocol == json.loads(json.dumps(asdict(Protocol())))
    assert Protocol().text == WORDS
    requested = f"{compared['psnr'] - 0.1:.2f}"
    reached = report_of("simplify", scene, small, "--psnr", requested, "-w", *fast)["judged"]
    [compared] = report_of("compare", scene, small)["models"]
    assert reached["psnr"] == pytest.approx(compared["psnr"], abs=0.01)
    assert float(requested) <= compared["psnr"] <= float(requested) + 0.3


def test_reported_scores_are_those_of_the_written_file(scene, tmp_path):
    """Also of packed files, in another frame, and in chunks."""
    fast = ("--preset", "fast", "--measure")
    for name, *options in (("a.spz", *fast), ("a.ply", "--frame", "rub", *FEW)):
        report = report_of("simplify", scene, tmp_path / name, "-r", "0.1", *options)
        loaded = nanogs.load(tmp_path / name)
        if report["frames"]:
            loaded = nanogs.frames.change_frame(loaded, *reversed(report["frames"]))
        expected = held_out(nanogs.load(scene)).judge(loaded)
        assert report["judged"]["psnr"] == pytest.approx(expected.psnr, abs=1e-6)
    folder = tmp_path / "l" / "lod-meta.json"
    levels = report_of("lod", scene, folder, "--levels", "0.5,0.1", *fast)["levels"]
    for number, level in enumerate(levels):
        loaded = nanogs.load(folder, level=number)
        expected = held_out(nanogs.load(scene)).judge(loaded)
        assert level["psnr"] == pytest.approx(expected.psnr, abs=1e-6)


def test_presets_without_rendering_measure_only_if_asked(scene, tmp_path):
    fast = ("-r", "0.1", "--preset", "fast", "-w")
    assert report_of("simplify", scene, tmp_path / "a.ply", *fast)["judged"] is None
    measured = run("simplify", scene, tmp_path / "a.ply", *fast, "--measure", "-v")
    assert f"dB on {WORDS}" in measured.stderr
    quick = report_of(
        "simplify", scene, tmp_path / "a.ply", "-r", "0.1", "-w", "--no-measure", *FEW
    )
    assert quick["judged"] is None


def test_a_format_that_is_only_written_is_not_measured(scene, tmp_path):
    require_bundle()
    result = run("simplify", scene, tmp_path / "a.html", "-r", "0.1", *FEW)
    assert result.returncode == 0
    assert "PSNR and SSIM were not measured: nanogs does not read .html files." in result.stderr


def test_it_is_noted_why_an_invisible_result_is_not_measured(tmp_path):
    unseen = make_scene(10)
    unseen.opacity_logits[:] = -np.inf
    nanogs.save(unseen, tmp_path / "a.ply")
    judge = file_judge(unseen, ".ply")
    assert judge.of(tmp_path / "a.ply") is None
    assert judge.notes[0].startswith("Nothing was rendered or measured: The model shows nothing")


@pytest.mark.parametrize("preset", ["default", "fast"])
def test_an_invisible_model_is_noted_once(tmp_path, preset):
    unseen = make_scene(10)
    unseen.opacity_logits[:] = -50
    nanogs.save(unseen, tmp_path / "a.ply")
    result = run(
        "simplify", tmp_path / "a.ply", tmp_path / "b.ply", "-r", "0.5", "--preset", preset,
        "--measure", *(FEW if preset == "default" else ()),
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    assert result.stderr.count("The model shows nothing") == 1
    assert "cannot be measured" not in result.stderr


def test_it_is_noted_why_an_unreadable_file_is_not_measured(tmp_path):
    judge = file_judge(make_scene(50), ".ply")
    (tmp_path / "a.ply").write_bytes(b"ply\n")
    assert judge.of(tmp_path / "a.ply") is None
    assert judge.notes[0].startswith("Nothing was measured: ")
    assert "a.ply" in judge.notes[0]


def test_levels_in_a_format_that_is_only_written_are_not_measured(scene, tmp_path):
    require_bundle()
    options = ("--format", "html", "--levels", "0.1", "--measure", *FEW)
    report = report_of("lod", scene, tmp_path / "a", *options)
    assert report["notes"] == ["PSNR and SSIM were not measured: nanogs does not read .html files."]
    assert report["protocol"] is None


def test_held_out_views_are_not_used_for_fitting():
    scene = make_scene(500)
    held_out_cameras = automatic_cameras(scene, split="test")
    fit_cameras = automatic_cameras(scene, 40, split="fit", habit=False)
    views = scene_with_views(
        scene, None, ForestParameters(views=14, view_size=768, further=20, around=4)
    )
    fit_cameras += [view.camera for view in views.fitting] + list(views.views.further)
    fit_cameras += [view.camera for group in views.view_groups for view in group.targets]
    positions = {tuple(camera.position.round(6)) for camera in fit_cameras}
    assert not any(tuple(camera.position.round(6)) in positions for camera in held_out_cameras)


def test_protocols_mention_views_of_several_sizes():
    splats = make_scene(300)
    sizes = ((64, 48), (32, 32), (64, 48), (48, 64))
    cameras = [
        automatic_cameras(splats, 1, width=width, height=height)[0] for width, height in sizes
    ]
    for count, words in (
        (1, "1 given view of 64 x 48 pixels"),
        (2, "2 given views of 64 x 48 pixels and 1 other size"),
        (4, "4 given views of 64 x 48 pixels and 2 other sizes"),
    ):
        protocol = nanogs.compare(splats, splats[:200], cameras=cameras[:count]).protocol
        assert (protocol.text, protocol.pixels) == (words, (64, 48))
    assert nanogs.draw_cost(splats, cameras).protocol.sizes == 3
