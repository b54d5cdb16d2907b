"""`convert` some rows at a time: the same bytes as with the whole model, in little memory."""

import dataclasses
import json
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest

import launch
import nanogs
from builders import random_splats
from nanogs import filters, io
from nanogs.datasets.synthetic import make_scene
from nanogs.frames import change_frame
from nanogs.source import Filtered, InMemory, Reduced, Source, Turned

SUFFIXES = [".ply", ".splat", ".npz", ".spz", ".glb", ".compressed.ply"]
COUNT = 225_000  # the whole model and the libraries would take more than 105 MB
MOST_BYTES = 100e6  # bytes of the whole process
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
# Runs each command in a process of its own, forked from one that has imported what all of them
# need, and prints the peak memory of each, imported libraries included.
PRINT_PEAKS = """
import json, os, re, sys
from pathlib import Path
import nanogs.io
from nanogs.cli import main

for words in json.load(sys.stdin):
    if child := os.fork():
        assert os.waitpid(child, 0)[1] == 0, words
        continue
    sys.argv = ["nanogs", *words]
    try:
        main()
    except SystemExit as end:
        assert not end.code, end
    peak = re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]
    print("peak", int(peak) * 1024, flush=True)
    os._exit(0)
"""


@pytest.fixture
def scene(tmp_path, monkeypatch):
    monkeypatch.setattr("nanogs.source.base.PAGE_ROWS", 64)
    monkeypatch.setattr("nanogs.source.base.BLOCK_ROWS", 50)
    monkeypatch.setattr("nanogs.io.in_order._LEAST_ROWS", 100)
    extras = {"label": np.arange(900, dtype=np.int32)}
    nanogs.save(random_splats(900, degree=3, extras=extras), tmp_path / "a.ply")
    return tmp_path / "a.ply"


class Strict(Source):
    """A file that may only be read in blocks."""

    def __init__(self, path):
        self._source = nanogs.open(path)

    @property
    def count(self):
        return self._source.count

    @property
    def columns(self):
        return self._source.columns

    def _span(self, start, stop):
        assert stop - start <= 64, "that is more than a page"
        return self._source.read(start, stop)


@pytest.mark.parametrize("options", [{}, {"spz_version": 2}, {"spz_version": 4}])
@pytest.mark.parametrize("target", SUFFIXES)
@pytest.mark.parametrize("start", SUFFIXES)
def test_a_source_is_written_with_the_bytes_of_the_whole_model(
    scene, tmp_path, start, target, options
):
    if options and target != ".spz":
        return
    nanogs.save(nanogs.load(scene), tmp_path / f"b{start}")
    kept = [filters.box((-1, -1, -0.5), (1, 1, 0.5)), filters.opaque_enough(0.3)]
    near = Filtered(Strict(tmp_path / f"b{start}"), kept)
    changed = Turned(Reduced(near, 2), "rdf", "fru")
    nanogs.save(changed, tmp_path / f"c{target}", format_options=options)
    whole = filters.apply(nanogs.load(tmp_path / f"b{start}"), kept)[0]
    whole = change_frame(whole.with_sh_degree(2), "rdf", "fru")
    nanogs.save(whole, tmp_path / f"d{target}", format_options=options)
    assert (tmp_path / f"c{target}").read_bytes() == (tmp_path / f"d{target}").read_bytes()
    assert io.losses(changed, f"a{target}") == io.losses(whole, f"a{target}")


def test_splats_that_cannot_be_written_are_counted_over_all_blocks(scene, tmp_path):
    model = nanogs.load(scene)
    model.means[[130, 131, 800]] = np.nan
    nanogs.save(model, scene, overwrite=True)
    for target in (".splat", ".spz"):
        for source in (model, Strict(scene)):
            with pytest.raises(nanogs.NanogsError, match=r"3 splats hold .* in row 130"):
                nanogs.save(source, tmp_path / f"b{target}")
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


def test_a_source_is_written_to_formats_that_need_the_whole_model(scene, tmp_path):
    for target in ("b.glb", "folder/meta.json"):
        nanogs.save(nanogs.open(scene), tmp_path / target)
        assert nanogs.io.inspect(tmp_path / target).splats == 900
    assert len(io.losses(InMemory(nanogs.load(scene)), "a.glb")) == 1


def test_a_file_can_be_converted_onto_itself(scene):
    before = nanogs.load(scene)
    run = launch.run("convert", scene, scene, "-w", "--crop", "box:-1,-1,-1,0,1,1", "--json")
    report = json.loads(run.stdout)
    left = filters.crop_box(before, (-1, -1, -1), (0, 1, 1))
    assert report["filters"][0]["left"] == report["splats"] == len(left)
    assert nanogs.load(scene).means.tobytes() == left.means.tobytes()


def test_conversions_that_need_too_much_memory_are_refused_before_work(large, tmp_path):
    allowed = ("--max-memory", "110MB")
    refused = [("b.usda",), ("b.sog",), ("b.ply", "--drop-floaters")]
    for target, *rest in refused:
        run = launch.run("convert", large, tmp_path / target, *allowed, *rest)
        assert run.returncode == 2, run.stderr
        assert "of memory" in run.stderr
        assert not list(tmp_path.iterdir())
    run = launch.run("convert", large, tmp_path / "b.ply", *allowed)
    assert run.returncode == 0, run.stderr


def save_scene(path, count):
    """Save a scene whose colours repeat a tenth of them, because making all takes seconds."""
    splats, colours = make_scene(count, sh_degree=0), make_scene(count // 10, sh_degree=3).sh
    nanogs.save(dataclasses.replace(splats, sh=np.tile(colours, (10, 1, 1))), path)
    return path


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    return save_scene(tmp_path_factory.mktemp("large") / "a.ply", COUNT)


def assert_peaks(runs, folder, limit):
    """Check peak memory; modules are compiled first, which takes memory in a fresh clone."""
    subprocess.run([sys.executable, "-m", "nanogs", "info", *map(str, runs[0][1:2])], cwd=folder)
    result = subprocess.run(
        [sys.executable, "-c", PRINT_PEAKS], input=json.dumps(runs, default=str),
        cwd=folder, capture_output=True, text=True,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    peaks = [line.split()[1] for line in result.stdout.splitlines() if line.startswith("peak ")]
    for run, peak in zip(runs, map(int, peaks), strict=True):
        assert peak < limit, run


@LINUX
@pytest.mark.slow
def test_a_large_model_is_converted_within_a_hundred_megabytes(large, tmp_path):
    """From each format to the next, except .splat, which cannot hold colours of degree 3."""
    others = [f"b{end}" for end in SUFFIXES if end not in (".ply", ".splat")]
    runs = [["convert", large, "b.splat"], ["convert", "b.splat", "c.ply"]]
    runs += [["convert", a, b] for a, b in pairwise([large, *others, "b.ply"])]
    runs += [["info", large], ["info", "b.spz"]]
    assert_peaks(runs, tmp_path, MOST_BYTES)


@LINUX
@pytest.mark.slow
def test_filtered_and_turned_splats_are_converted_in_little_memory(large, tmp_path):
    changes = ["--crop", "sphere:0,0,0,1000", "--min-opacity", "0.01", "--frame", "rub:rdf"]
    suffixes = [end for end in SUFFIXES if end != ".glb"]  # which has a fixed frame
    runs = [["convert", large, f"b{end}", *changes] for end in suffixes]
    assert_peaks(runs, tmp_path, MOST_BYTES)


@LINUX
@pytest.mark.slow
def test_a_model_is_rendered_and_compared_within_max_memory(tmp_path):
    """With the whole model in memory, rendering takes 1.5 times and comparing twice as much."""
    large = save_scene(tmp_path / "a.ply", 500_000)
    render = ["render", large, "a", "--views", "2", "--pixels", "400", "-q", "--max-memory"]
    assert_peaks([[*render, "320MB"]], tmp_path, 320e6)
    compare = ["compare", large, large, "--views", "1", "--sizes", "400", "--max-memory", "330MB"]
    assert_peaks([compare], tmp_path, 330e6)
