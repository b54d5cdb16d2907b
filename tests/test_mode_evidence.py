"""Evidence for drawing a model as `default` or as `mip`, and `nanogs info` that renders."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

import nanogs
from builders import random_splats
from conftest import scene_path
from dataset_files import write_json
from launch import run
from nanogs.errors import NotEnoughMemoryError, OptionError
from nanogs.memory import LIBRARIES
from nanogs.memory_estimates import drawn_bytes, models_bytes, shown_bytes
from nanogs.protocol import Protocol
from nanogs.scoring.modes import ModeEvidence, evidence_on
from nanogs.splats import RenderMode
from nanogs.views.costing import protocol_of
from nanogs.views.plan import LEAST
from reference_raster import splat_on_screen
from test_raster import make_camera, make_splats


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A model of thin splats, and photographs rendered from it in each render mode."""
    folder = tmp_path_factory.mktemp("taken")
    model = random_splats(600, seed=3)
    model = replace(model, log_scales=model.log_scales - 1.2)
    nanogs.save(model, folder / "model.ply")
    pose = np.eye(4)
    pose[2, 3] = 4.0
    frames = [{"file_path": f"./r_{i}.png", "transform_matrix": pose.tolist()} for i in range(2)]
    for frame, side in zip(frames, (-0.3, 0.3), strict=True):
        frame["transform_matrix"][0][3] = side
    for mode in ("default", "mip"):
        (folder / mode).mkdir()
        cameras = {"camera_angle_x": 0.9, "w": 64, "h": 64, "frames": frames}
        write_json(folder / mode / "transforms_test.json", cameras)
        pictures = run(
            "render", folder / "model.ply", folder / mode, "--render-mode", mode,
            "--cameras", folder / mode / "transforms_test.json", "-q", "-w",
        )  # fmt: skip
        assert pictures.returncode == 0, pictures.stderr
    return folder


def info_of(path, *arguments):
    result = run("info", path, *arguments, "--json")
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


@pytest.mark.parametrize("mode", ["default", "mip"])
@pytest.mark.parametrize("tag", ["default", "mip"])
def test_photographs_show_the_mode_whatever_the_tag(capture, mode, tag):
    pytest.importorskip("PIL.Image")
    report = info_of(
        capture / "model.ply",
        "--photos",
        capture / mode,
        "--background",
        "black",
        "--render-mode",
        tag,
    )
    scores = report["mode_evidence"]["photographs"]
    other = {"default": "mip", "mip": "default"}[mode]
    assert scores[mode] > 45 > scores[other] + 3  # limited by photographs of 8 bits
    assert report["mode_evidence"]["sentences"][0].endswith(f"which speaks for {mode}")
    assert report["mode_evidence"]["protocol"]["kind"] == "photographs"
    assert report["draw_cost"]["protocol"]["views"] == 2


def test_shares_of_thin_and_faded_splats_match_a_plain_loop():
    model, cameras = (
        make_splats(n=60, seed=5, size=-3.0),
        [make_camera(), make_camera(60, 50, 70.0)],
    )
    found = evidence_on(
        model, cameras, protocol_of(cameras, "given"), [], None, lambda _done, _parts: None
    )
    visible = thin = faded = 0
    for camera in cameras:
        for i in range(len(model)):
            if not is_visible(model, camera, i):
                continue
            z, _, after, _, _ = splat_on_screen(model, camera, i)
            before = after - 0.3 * np.eye(2)
            visible += 1
            thin += np.exp(model.log_scales[i].min()) * camera.fx / z < math.sqrt(0.3)
            faded += math.sqrt(np.linalg.det(before) / np.linalg.det(after)) < 0.1
    assert visible > 30
    assert found.thin == pytest.approx(thin / visible, abs=1e-9)
    assert found.faded == pytest.approx(faded / visible, abs=1e-9)
    assert 0 < found.faded < found.thin <= 1


def is_visible(model, camera, i):
    from nanogs.kernels.project import HIDDEN
    from nanogs.raster.rendering import prepare, project_rows

    return project_rows(prepare(model[[i]]), camera)[2][0] != HIDDEN


def test_a_model_that_is_read_in_parts_has_the_same_evidence(tmp_path, monkeypatch):
    model = random_splats(500, seed=6)
    nanogs.save(model, tmp_path / "a.npz")
    cameras = [make_camera(48, 40, 40.0), make_camera(30, 30, 30.0)]
    view_options = (
        cameras,
        protocol_of(cameras, "given"),
        [],
    )

    def evidence(source_or_model, max_memory):
        return evidence_on(source_or_model, *view_options, max_memory, lambda _done, _parts: None)

    in_memory = evidence(model, None)
    monkeypatch.setattr("nanogs.views.streamed.DRAWN_ROWS", 64)
    with nanogs.open(tmp_path / "a.npz") as source:
        assert evidence(source, LEAST) == in_memory
    tagged = evidence(replace(model, render_mode=RenderMode.MIP), None)
    assert tagged == in_memory, "both ways are drawn, whatever the tag is"


def test_a_model_out_of_sight_gives_no_evidence():
    model, camera = random_splats(20), make_camera()
    away = replace(model, means=model.means - np.float32([0, 0, 50]))
    found = evidence_on(
        away, [camera], protocol_of([camera], "given"), [], None, lambda _done, _parts: None
    )
    assert (found.thin, found.faded, found.leak) == (0.0, 0.0, None)
    assert math.isinf(found.between)


@pytest.mark.parametrize(
    ("photographs", "numbers", "verdicts"),
    [
        ({}, (0.95, 0.2, 0.02), ["for default", "little", "for default"]),
        ({}, (0.1, 0.0, 0.0), ["little", "for mip", "little"]),
        ({"default": 20.0, "mip": 22.0}, (0.9, 0.2, None), ["for mip", "for default", "little"]),
        ({"default": 22.0, "mip": 21.95}, (0.9, 0.0, None), ["little", "little", "little"]),
    ],
)
def test_sentences_conclude_no_more_than_the_numbers_support(photographs, numbers, verdicts):
    thin, faded, leak = numbers
    evidence = ModeEvidence(thin, faded, leak, 30.0, photographs, Protocol())
    assert len(evidence.sentences) == len(verdicts)
    for sentence, verdict in zip(evidence.sentences, verdicts, strict=True):
        assert verdict in sentence.rpartition("which ")[2]


def test_evidence_alone_measures_no_draw_cost(capture, monkeypatch):
    def measured(*_):
        raise AssertionError("the draw cost is not part of the evidence")

    monkeypatch.setattr("nanogs.views.covering.cost_on", measured)
    assert nanogs.mode_evidence(capture / "model.ply", views=2, pixels=64).sentences


def test_info_renders_only_if_views_are_given(capture):
    path = capture / "model.ply"
    plain = info_of(path)
    assert plain["draw_cost"] is None
    assert plain["mode_evidence"] is None
    report = info_of(path, "--views", "2", "--pixels", "64")
    cost = nanogs.draw_cost(path, views=2, pixels=64)
    assert report["draw_cost"]["splats_a_pixel"] == cost.splats_a_pixel
    assert report["draw_cost"]["protocol"]["pixels"] == [64, 64]
    text = run("info", path, "--cameras", "orbit", "--pixels", "64").stdout
    assert "splats a pixel" in text
    assert "evidence, not proof" in text
    assert "--views 8" not in text
    assert "--views 8" in run("info", path).stdout


@pytest.mark.parametrize(
    "options",
    [
        ["--split", "train"],
        ["--images", "images_4"],
        ["--threads", "1"],
        ["--background", "white"],
        ["--photos", "here", "--views", "2"],
        ["--photos", "here"],
        ["--cameras", "none.json"],
        ["--views", "2", "--pixels", "0"],
    ],
)
def test_contradicting_options_of_views_are_refused(capture, options):
    result = run("info", capture / "model.ply", *options)
    assert result.returncode == 2
    assert result.stderr.startswith("error: ")
    assert not result.stdout


def test_the_model_and_photographs_must_fit_in_memory_together(capture):
    model = nanogs.load(capture / "model.ply")
    held = models_bytes([model], all_of_it=True) + drawn_bytes(len(model))
    fitting = LIBRARIES + held + shown_bytes(64 * 64, 2) + 2 * 64 * 64 * 3 * 4
    photos = capture / "mip"
    with pytest.raises(NotEnoughMemoryError, match="use smaller photographs, or a smaller model"):
        nanogs.mode_evidence(model, photos=photos, max_memory=fitting - 1)
    assert nanogs.mode_evidence(model, photos=photos, max_memory=fitting).photographs


@pytest.mark.parametrize(
    "views", [{"cameras": "roam"}, {"up": (0, 0, 1)}, {"views": 3}, {"pixels": (64, 32)}]
)
def test_views_beside_photographs_are_refused(capture, views):
    with pytest.raises(OptionError, match="`photos` cannot be combined with options for views"):
        nanogs.mode_evidence(capture / "model.ply", photos=capture / "mip", **views)


def test_a_split_without_photographs_is_refused(capture):
    with pytest.raises(OptionError, match="must be test or train, not 'validation'"):
        nanogs.mode_evidence(capture / "model.ply", photos=capture / "mip", split="validation")


def test_evidence_agrees_with_models_of_known_training():
    """The chair was trained without antialiasing; the kitchen is tagged mip, and rightly."""
    chair = nanogs.mode_evidence(scene_path("chair.splat"))
    kitchen = nanogs.mode_evidence(scene_path("kitchen.spz"))
    assert chair.faded > 0.3
    assert chair.leak > 0.01
    assert kitchen.faded < 0.01
    assert kitchen.thin < 0.2
