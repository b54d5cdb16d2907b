"""The command `nanogs refit`, run as a user runs it."""

import json

import numpy as np
import pytest

import nanogs
from builders import cloud_pair
from dataset_files import transforms, write_json
from launch import run
from nanogs.views.automatic import automatic_cameras
from test_cli import assert_refused


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder with an original, a smaller model and an empty one, which cannot be fitted."""
    folder = tmp_path_factory.mktemp("models")
    original, small = cloud_pair()
    nanogs.save(original, folder / "original.ply")
    nanogs.save(small, folder / "small.ply")
    header, end, _ = (folder / "small.ply").read_bytes().partition(b"end_header\n")
    count = b"element vertex %d\n" % len(small)
    (folder / "empty.ply").write_bytes(header.replace(count, b"element vertex 0\n") + end)
    return folder


def test_command_fits_and_reports(files, tmp_path):
    out = tmp_path / "out.ply"
    arguments = [files / "original.ply", files / "small.ply", out]
    quick = ["--views", "4", "--pixels", "128", "--rounds", "2"]
    result = run("refit", *arguments, *quick, "--json")
    assert (result.returncode, result.stderr) == (0, "")
    report = json.loads(result.stdout)
    assert report["improved"]
    assert len(report["fit_views"]) == 4
    assert [group["pixels"] for group in report["groups"]] == ["128"]
    assert len(nanogs.load(out)) == report["count"]
    assert_refused(run("refit", *arguments, *quick), "out.ply", "exists")
    result = run("refit", *arguments, *quick, "-w", "-v", "--cameras", "orbit")
    assert (result.returncode, result.stdout) == (0, "")
    assert "held out for validation" in result.stderr
    assert "128 px" in result.stderr, "what each group of views gained"


def test_what_the_format_leaves_out_is_noted(files, tmp_path):
    arguments = [files / "original.ply", files / "small.ply", tmp_path / "out.splat"]
    result = run("refit", *arguments, "--views", "2", "--pixels", "32", "--rounds", "1")
    assert result.returncode == 0
    assert "note: Spherical harmonics" in result.stderr
    assert "32 px" not in result.stderr, "only with -v"


def test_notes_on_reading_both_models_are_printed(files, tmp_path):
    """As by `simplify` and `view`; each is named once, the one on the render mode too."""
    for name in ("original", "small"):
        data = (files / f"{name}.ply").read_bytes()
        (tmp_path / f"{name}.ply").write_bytes(data.replace(b"element", b"obj_info a\nelement", 1))
    arguments = [tmp_path / "original.ply", tmp_path / "small.ply", tmp_path / "out.ply"]
    quick = ["--views", "2", "--pixels", "32", "--rounds", "1", "--render-mode", "mip"]
    result = run("refit", *arguments, *quick, "--json")
    assert result.returncode == 0
    notes = json.loads(result.stdout)["notes"]
    for path in arguments[:2]:
        assert notes.count(f"{path}: 1 obj_info line was kept as a comment.") == 1
        assert sum(f"{path}: " in note for note in notes) == 2, "the other is on the render mode"


def test_given_cameras_set_the_size_of_the_views(files, tmp_path):
    cameras = automatic_cameras(nanogs.load(files / "original.ply"), 8, width=64, height=48)
    poses = [np.linalg.inv(each.world_to_camera) * [1, -1, -1, 1] for each in cameras]
    frames = [{"file_path": str(k), "transform_matrix": p.tolist()} for k, p in enumerate(poses)]
    views = write_json(tmp_path / "views.json", transforms(frames, w=64, h=48))
    arguments = [files / "original.ply", files / "small.ply", tmp_path / "out.ply", "--rounds", "1"]
    result = run("refit", *arguments, "--cameras", views)
    assert "2 views held out for validation, of 64 pixels" in result.stderr


def test_splats_share_harmonics_as_the_file_stores_them(tmp_path):
    original, small = cloud_pair(6000, degree=2)
    small.sh[:, 1:] += np.random.default_rng(0).normal(0, 0.1, small.sh[:, 1:].shape)
    nanogs.save(original, tmp_path / "original.ply")
    nanogs.save(small, tmp_path / "small.ply")
    paths = [tmp_path / name for name in ("original.ply", "small.ply", "out.sog")]
    result = run("refit", *paths, "--rounds", "1", "--views", "4", "--pixels", "64")
    assert result.returncode == 0, result.stderr
    parameters = nanogs.RefitParameters(rounds=1, views=4, size=64)
    fitted, _ = nanogs.refit(original, small, parameters=parameters, format=".sog")
    assert len(np.unique(fitted.sh[:, 1:].reshape(len(fitted), -1), axis=0)) == 1024  # of 1,500
    nanogs.save(fitted, tmp_path / "same.sog")
    assert paths[-1].read_bytes() == (tmp_path / "same.sog").read_bytes()


@pytest.mark.parametrize(
    ("small_name", "arguments", "message"),
    [
        ("small.ply", ["--pixels", "3"], "16 to 8192 pixels"),
        ("small.ply", ["--cameras", "nowhere"], "no camera file"),
        ("small.ply", ["--up", "0,0,0"], "direction"),
        ("empty.ply", [], "no rows"),
        ("absent.ply", [], "absent.ply"),
    ],
)
def test_command_refuses_bad_input_in_one_sentence(files, tmp_path, small_name, arguments, message):
    out = tmp_path / "out.ply"
    assert_refused(
        run("refit", files / "original.ply", files / small_name, out, *arguments), message
    )
    assert not out.exists()
