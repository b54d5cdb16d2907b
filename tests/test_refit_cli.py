"""`nanogs refit` from outside, as a user runs it."""

import json

import pytest

import nanogs
from builders import cloud_pair
from launch import run
from test_cli import assert_refused


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """ORIGINAL, SMALL, and small models that no one can fit."""
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
    given = [files / "original.ply", files / "small.ply", out]
    quick = ["--views", "4", "--pixels", "128", "--rounds", "2"]
    result = run("refit", *given, *quick, "--json")
    assert (result.returncode, result.stderr) == (0, "")
    report = json.loads(result.stdout)
    assert report["improved"]
    assert len(report["fit_views"]) == 4
    assert len(nanogs.load(out)) == report["count"]
    assert_refused(run("refit", *given, *quick), "out.ply", "exists")
    result = run("refit", *given, *quick, "-w", "-v", "--cameras", "orbit")
    assert (result.returncode, result.stdout) == (0, "")
    assert "kept apart" in result.stderr
    assert "128 px" in result.stderr, "what each group of views gained"


@pytest.mark.parametrize(
    ("small", "arguments", "said"),
    [
        ("small.ply", ["--pixels", "3"], "16 to 8192 pixels"),
        ("small.ply", ["--cameras", "nowhere"], "no camera file"),
        ("small.ply", ["--up", "0,0,0"], "direction"),
        ("empty.ply", [], "no rows"),
        ("absent.ply", [], "absent.ply"),
    ],
)
def test_command_refuses_in_one_sentence(files, tmp_path, small, arguments, said):
    out = tmp_path / "out.ply"
    assert_refused(run("refit", files / "original.ply", files / small, out, *arguments), said)
    assert not out.exists()
