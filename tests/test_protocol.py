"""One PSNR for one model, whichever command says it."""

import json
from dataclasses import asdict

import numpy as np
import pytest

import nanogs
from launch import run
from looking import looked
from nanogs.datasets.synthetic import make_scene
from nanogs.method.parameters import ForestParameters
from nanogs.protocol import Protocol
from nanogs.scoring.file_judge import file_judge
from nanogs.scoring.held_out import held_out
from nanogs.views.automatic import automatic_cameras
from viewer_bundle import require_bundle

WORDS = "8 held-out views of 512 pixels"
FEW = ("--views", "4", "--view-size", "64", "--steps", "2")  # a small fit


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("protocol") / "scene.ply"
    nanogs.save(make_scene(1000), path)
    return path


def said(*words):
    result = run(*words, "--json")
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


@pytest.mark.slow
def test_simplify_lod_compare_and_view_say_the_same(scene, tmp_path):
    require_bundle()
    small, levels = tmp_path / "small.ply", tmp_path / "levels"
    fast = ("--preset", "fast", "--measure")  # what is measured is another matter
    numbers = [said("simplify", scene, small, "-r", "0.2", *fast)["judged"]]
    [compared] = (report := said("compare", scene, small))["models"]
    numbers.append({name: compared[name] for name in ("psnr", "ssim")})
    numbers.append(said("view", scene, small, "-o", tmp_path / "a.html")["judged"])
    numbers.append(said("lod", scene, levels, "--levels", "0.2", *fast)["levels"][0])
    numbers.append(json.loads((levels / "levels.json").read_text())["levels"][0])
    for other in numbers[1:]:
        assert other["psnr"] == pytest.approx(numbers[0]["psnr"], abs=0.01)
        assert other["ssim"] == pytest.approx(numbers[0]["ssim"], abs=1e-4)
    protocol = json.loads((levels / "levels.json").read_text())["protocol"]
    assert protocol == report["protocol"] == numbers[0]["protocol"] == numbers[2]["protocol"]
    assert protocol == json.loads(json.dumps(asdict(Protocol())))
    assert Protocol().text == WORDS
    asked = f"{compared['psnr'] - 0.1:.2f}"
    reached = said("simplify", scene, small, "--psnr", asked, "-w", *fast)["judged"]
    [compared] = said("compare", scene, small)["models"]
    assert reached["psnr"] == pytest.approx(compared["psnr"], abs=0.01)
    assert float(asked) <= compared["psnr"] <= float(asked) + 0.3


def test_what_is_said_is_of_the_file(scene, tmp_path):
    """Packed, turned into another frame, and in chunks."""
    fast = ("--preset", "fast", "--measure")
    for name, *options in (("a.spz", *fast), ("a.ply", "--frame", "rub", *FEW)):
        run_of = said("simplify", scene, tmp_path / name, "-r", "0.1", *options)
        seen = nanogs.load(tmp_path / name)
        if run_of["frames"]:
            seen = nanogs.frames.change_frame(seen, *reversed(run_of["frames"]))
        expected = held_out(nanogs.load(scene)).judge(seen)
        assert run_of["judged"]["psnr"] == pytest.approx(expected.psnr, abs=1e-6)
    folder = tmp_path / "l" / "lod-meta.json"
    made = said("lod", scene, folder, "--levels", "0.5,0.1", *fast)["levels"]
    for number, level in enumerate(made):
        seen = nanogs.load(folder, level=number)
        expected = held_out(nanogs.load(scene)).judge(seen)
        assert level["psnr"] == pytest.approx(expected.psnr, abs=1e-6)


def test_nothing_is_measured_where_nothing_is_rendered_unless_asked(scene, tmp_path):
    fast = ("-r", "0.1", "--preset", "fast", "-w")
    assert said("simplify", scene, tmp_path / "a.ply", *fast)["judged"] is None
    asked = run("simplify", scene, tmp_path / "a.ply", *fast, "--measure", "-v")
    assert f"dB on {WORDS}" in asked.stderr
    quick = said("simplify", scene, tmp_path / "a.ply", "-r", "0.1", "-w", "--no-measure", *FEW)
    assert quick["judged"] is None


def test_a_file_that_is_not_read_is_not_measured(scene, tmp_path):
    require_bundle()
    result = run("simplify", scene, tmp_path / "a.html", "-r", "0.1", *FEW)
    assert result.returncode == 0
    assert "Nothing was measured: nanogs does not read .html files." in result.stderr


def test_a_result_that_cannot_be_measured_says_why(tmp_path):
    unseen = make_scene(10)
    unseen.opacity_logits[:] = -np.inf
    nanogs.save(unseen, tmp_path / "a.ply")
    judge = file_judge(unseen, ".ply")
    assert judge.of(tmp_path / "a.ply") is None
    assert judge.notes[0].startswith("Nothing was measured: The model shows nothing")


@pytest.mark.parametrize("preset", ["default", "fast"])
def test_a_model_that_shows_nothing_is_told_of_once(tmp_path, preset):
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


def test_a_file_that_cannot_be_read_any_more_says_why(tmp_path):
    judge = file_judge(make_scene(50), ".ply")
    (tmp_path / "a.ply").write_bytes(b"ply\n")
    assert judge.of(tmp_path / "a.ply") is None
    assert judge.notes[0].startswith("Nothing was measured: ")
    assert "a.ply" in judge.notes[0]


def test_levels_that_are_not_read_are_not_measured(scene, tmp_path):
    require_bundle()
    given = ("--format", "html", "--levels", "0.1", "--measure", *FEW)
    made = said("lod", scene, tmp_path / "a", *given)
    assert made["notes"] == ["Nothing was measured: nanogs does not read .html files."]
    assert made["protocol"] is None


def test_nothing_is_learnt_from_the_views_that_judge():
    scene = make_scene(500)
    judging = automatic_cameras(scene, split="test")
    learning = automatic_cameras(scene, 40, split="fit", habit=False)
    views = looked(scene, None, ForestParameters(views=14, view_size=768, further=20, roaming=4))
    learning += [view.camera for view in views.fitting] + list(views.views.further)
    learning += [view.camera for group in views.groups for view in group.targets]
    places = {tuple(camera.position.round(6)) for camera in learning}
    assert not any(tuple(camera.position.round(6)) in places for camera in judging)


def test_views_of_several_sizes_are_not_said_to_have_one():
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
