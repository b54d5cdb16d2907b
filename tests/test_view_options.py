"""View options that have no effect beside others are refused by every command."""

import json

import numpy as np
import pytest

import nanogs
from builders import random_splats
from dataset_files import write_json
from launch import run
from launch import run_here as command
from test_cli import assert_refused
from test_streamed_views import stderr_line
from viewer_bundle import require_bundle

SMALL = ("--views", "1", "--pixels", "32")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A model, and the cameras of a data set without its photographs."""
    folder = tmp_path_factory.mktemp("views")
    nanogs.save(random_splats(300), folder / "a.ply")
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, 2, 3] = 4.0, 5.0
    frames = [
        {"file_path": f"./r_{i}.png", "transform_matrix": pose.tolist()}
        for i, pose in enumerate(poses)
    ]
    cameras = {"camera_angle_x": 0.9, "w": 48, "h": 32, "frames": frames}
    write_json(folder / "cams.json", cameras)
    return folder


@pytest.mark.parametrize(
    ("options", "option"),
    [
        (["--photos", "data", "--views", "3"], "--views"),
        (["--photos", "data", "--pixels", "64"], "--sizes"),
        (["--photos", "data", "--cameras", "orbit"], "--cameras"),
        (["--photos", "data", "--up", "0,0,1"], "--up"),
        (["--images", "images_4"], "--images"),
        (["--split", "train"], "--split"),
        (["--cameras", "cams.json", "--views", "2"], "--views"),
        (["--cameras", "cams.json", "--sizes", "64"], "--sizes"),
        (["--cameras", "cams.json", "--up", "0,0,1"], "--up"),
        (["--mixed", "--split", "train"], "--split"),
        (["--mixed", "--render-mode", "mip"], "--render-mode"),
        (["--mixed", "--metrics", "flip"], "--metrics"),
        (["--mixed", "--packed", ".spz"], "--packed"),
        (["--mixed", "--report", "page.html"], "--report"),
        (["--mixed", "--device", "auto"], "--device"),
        (["--mixed", "--cameras", "cams.json", "--views", "2"], "--views"),
    ],
)
def test_compare_refuses_view_options_without_effect(folder, options, option):
    assert_refused(run("compare", "a.ply", "a.ply", *options, cwd=folder), f"{option} ")


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (["info", "a.ply", "--views", "2"], "--views"),
        (["render", "a.ply", "out", "--views", "2"], "--views"),
        (["render", "a.ply", "out", "--pixels", "64"], "--pixels"),
        (["view", "a.ply", "a.ply", "--pixels", "64"], "--pixels"),
        (["simplify", "a.ply", "b.ply", "-r", "0.5", "--up", "1,0,0"], "--up"),
        (["lod", "a.ply", "out", "--up", "1,0,0"], "--up"),
        (["refit", "a.ply", "a.ply", "b.ply", "--up", "1,0,0"], "--up"),
    ],
)
def test_view_options_beside_a_camera_file_are_refused(folder, arguments, option):
    result = run(*arguments, "--cameras", "cams.json", cwd=folder)
    assert_refused(result, f"{option} cannot be combined with --cameras cams.json")
    assert not [path for path in folder.iterdir() if path.name not in ("a.ply", "cams.json")]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["render", "a.ply", "out", "--transparent", "--background", "white"],
            "--background cannot be combined with --transparent",
        ),
        (
            ["render", "a.ply", "out", "--background", "transparent"],
            "--background is black, white or #rrggbb; for no background give --transparent in its",
        ),
        (
            ["compare", "a.ply", "a.ply", "--no-interactive"],
            "--no-interactive works only with --report",
        ),
        (
            ["simplify", "a.ply", "b.ply", "-r", "0.5", "--preset", "fast", "--view-size", "99"],
            "--views, --view-size, --cameras and --up have no effect, because the preset fast",
        ),
        (["view", "a.ply", "b.html"], "b.html is a page, not a model; give -o b.html to write it."),
        (["view", "a.ply", "--psnr"], "--psnr has no effect, because it compares two models;"),
        (["view", "a.ply", "--views", "2"], "--views has no effect, because the PSNR of"),
        (["view", "a.ply", "--cameras", "roam"], "--cameras roam has no effect, because the PSNR"),
        (
            ["view", "a.ply", "a.ply", "--no-psnr", "--pixels", "9"],
            "--pixels has no effect, because the PSNR",
        ),
        (["compare", "a.ply", "a.ply", "--interactive"], "--interactive works only with --report"),
        (["info", "a.ply", "--threads", "1"], "--threads works only with --views, --photos or"),
        (["info", "a.ply", "--max-memory", "1GB"], "--max-memory works only with --views,"),
        (
            ["info", "a.ply", "--packed", ".sog", "--background", "white"],
            "--background works only with --views or --photos;",
        ),
    ],
)
def test_options_without_effect_are_refused(folder, arguments, message):
    assert_refused(run(*arguments, cwd=folder), message)
    assert not [path for path in folder.iterdir() if path.name not in ("a.ply", "cams.json")]


def test_options_with_an_effect_are_accepted(folder, tmp_path):
    page = ("--up", "0,0,1", "--report", tmp_path / "page.html", "-w")
    for options in (SMALL, ("--cameras", "cams.json"), ("--cameras", "cams.json", *page)):
        result = run("compare", "a.ply", "a.ply", *options, "--json", cwd=folder)
        assert result.returncode == 0, result.stderr
        size = [32, 32] if options is SMALL else [48, 32]
        assert json.loads(result.stdout)["protocol"]["pixels"] == size
    fit = ("--cameras", "cams.json", "--views", "1", "--pixels", "16", "--rounds", "1")
    result = run("refit", "a.ply", "a.ply", tmp_path / "b.ply", *fit, cwd=folder)
    assert result.returncode == 0, result.stderr
    assert len(nanogs.load(tmp_path / "b.ply")) == 300
    mistyped = run("render", "a.ply", tmp_path / "out", "--cameras", "orbti", *SMALL, cwd=folder)
    assert_refused(mistyped, "no camera file 'orbti'")


@pytest.mark.parametrize(
    "arguments",
    [
        ["render", "a.ply", "out"],
        ["info", "a.ply"],
        ["compare", "a.ply", "a.ply"],
        ["compare", "a.ply", "a.ply", "--report", "page.html"],
    ],
)
def test_without_memory_for_the_cameras_of_a_file_no_options_of_automatic_views_are_advised(
    folder, arguments, monkeypatch, capsys
):
    monkeypatch.chdir(folder)
    assert command(*arguments, "--cameras", "cams.json", "--max-memory", "210MB") == 2
    said = stderr_line(capsys)
    assert "give fewer cameras or smaller ones, or automatic views, or " in said
    assert "--views" not in said
    assert "--pixels" not in said


def test_without_memory_for_its_scores_a_page_can_leave_them_out(folder, monkeypatch, capsys):
    require_bundle()
    monkeypatch.chdir(folder)
    few = ["view", "a.ply", "a.ply", "--no-open", "--max-memory"]
    assert command(*few, "211MB") == 2
    assert stderr_line(capsys).endswith(
        "or view smaller models, or leave out the PSNR (--no-psnr)."
    )
    assert command(*few, "2MB") == 2
    assert stderr_line(capsys).endswith("or view smaller models.")
