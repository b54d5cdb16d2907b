"""Paths that the system refuses to look up: one sentence each, wherever they are given."""

import pytest

import nanogs
from nanogs import NanogsError, paths
from nanogs.datasets.dataset import cameras_from_file, open_dataset
from nanogs.datasets.synthetic import make_scene
from nanogs.io.collect import collect
from test_cli import run

LONG = "a" * 300  # longer than any file system allows
SCENE = make_scene(60)


def test_a_name_that_the_system_refuses_is_nothing_that_exists(tmp_path):
    for refused in (tmp_path / LONG, tmp_path / "a\0b", tmp_path / "missing"):
        assert not paths.exists(refused)
        assert not paths.is_file(refused)
        assert not paths.is_folder(refused)
    assert paths.why_refused(tmp_path / LONG) == "File name too long"
    for simple in (tmp_path, tmp_path / "missing", tmp_path / "a\0b"):
        assert paths.why_refused(simple) is None


CALLS = {
    "render": lambda: nanogs.render(SCENE, LONG),
    "compare": lambda: nanogs.compare(SCENE, SCENE, cameras=LONG),
    "compare with kinds": lambda: nanogs.compare(SCENE, SCENE, cameras=f"{LONG},{LONG}"),
    "photographs": lambda: nanogs.compare(SCENE, SCENE, photos=LONG),
    "simplify": lambda: nanogs.simplify(SCENE, ratio=0.5, cameras=LONG),
    "mode_evidence": lambda: nanogs.mode_evidence(SCENE, photos=LONG),
    "cameras_from_file": lambda: cameras_from_file(LONG),
    "open_dataset": lambda: open_dataset(LONG),
}


@pytest.mark.parametrize("call", CALLS)
def test_cameras_and_photographs_of_too_long_a_name_are_refused(call):
    with pytest.raises(NanogsError, match=r"cannot be read \(File name too long\); check the path"):
        CALLS[call]()


def test_a_kind_of_cameras_beside_too_long_a_name_is_refused():
    with pytest.raises(NanogsError, match="is not a kind of cameras"):
        nanogs.compare(SCENE, SCENE, cameras=f"auto,{LONG}")


def test_a_pattern_of_too_long_a_name_matches_nothing(tmp_path):
    with pytest.raises(NanogsError, match="Nothing matches"):
        collect([tmp_path / f"{LONG}*.ply"])


def test_a_model_may_have_a_longer_name_than_files_may(tmp_path):
    nanogs.save(SCENE, tmp_path / "a.ply")
    result = run("compare", tmp_path / "a.ply", f"{LONG}={tmp_path / 'a.ply'}", "--views", "1")
    assert result.returncode == 0, result.stderr


def test_a_folder_that_may_not_be_listed_is_refused(tmp_path, monkeypatch):
    def denied(path):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(type(tmp_path), "iterdir", denied)
    with pytest.raises(NanogsError, match=r"cannot be read \(Permission denied\); check its"):
        collect([tmp_path])
