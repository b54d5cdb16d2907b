"""Streamed SOG: the division of space, the folder that `nanogs lod` makes, and the real viewer."""

import hashlib
import itertools
import json
import os
import re
import shutil
import stat
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

import nanogs
from builders import random_splats
from conftest import scene_path
from launch import run
from nanogs import io
from nanogs.errors import OptionError, OutputError
from nanogs.formatting import bytes_text
from nanogs.io import atomic
from nanogs.io.folder import atomic_folder
from nanogs.levels_of_detail import write_levels
from nanogs.lod import streamed_sog
from nanogs.lod.boxes import box_around
from nanogs.lod.cells import LEAF, divide
from nanogs.lod.chunks import SortedLevel
from nanogs.lod.folder import LevelsFolder, made_files
from nanogs.lod.layout import LodLayout, block_layout_of, output_of
from nanogs.lod.streamed_sog import StreamedSog
from nanogs.lod.tiles import Tiles
from nanogs.lod.tree_blocks import Linked
from nanogs.threads import most_threads, use_threads
from supersplat_page import render_in_supersplat
from test_cli import assert_refused
from test_sog_write import angle, in_order_of

RATIOS = (0.5, 0.1, 0.02)
FLOAT_MAX = float(str(np.finfo(np.float32).max))
CHUNK = 60


@pytest.fixture(scope="module")
def splats():
    return random_splats(900, degree=1)


@pytest.fixture(scope="module")
def path(scene, tmp_path_factory):
    """The `lod-meta.json` that the command makes of the scene."""
    path = tmp_path_factory.mktemp("out") / "levels" / "lod-meta.json"
    options = ["--levels", "0.5,0.1,0.02", "--preset", "fast", "--chunk", CHUNK, "-q"]
    result = run("lod", scene, path, *options)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
    return path


def write(splats, folder, *, layout=LodLayout.SOG, chunk=CHUNK, ratios=RATIOS, **options):
    return write_levels(
        splats, folder, ratios, source="a.ply", preset="fast", layout=layout, chunk=chunk, **options
    )


def nodes(tree):
    """Yield each node with the bounding boxes of its ancestors."""
    stack = [(tree, [])]
    while stack:
        node, ancestors = stack.pop()
        yield node, ancestors
        stack += [(child, [*ancestors, node["bound"]]) for child in node.get("children", [])]


def assert_binary(tree):
    """Assert that each node has two children or none and is within the boxes of its ancestors."""
    for node, ancestors in nodes(tree):
        assert ("children" in node) != ("lods" in node)
        assert len(node.get("children", [0, 0])) == 2
        for bound in ancestors:
            assert (np.array(bound["min"]) <= node["bound"]["min"]).all()
            assert (np.array(bound["max"]) >= node["bound"]["max"]).all()


def leaves(tree):
    return [node for node, _ in nodes(tree) if "lods" in node]


def files(folder):
    """Return the digest of each file by its path."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


# Cells


@st.composite
def clouds(draw):
    """Point clouds in which some points, or nearly all, coincide or share a coordinate."""
    n = draw(st.integers(1, 60))
    grid = draw(st.sampled_from([1, 2, 5, 1000]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    dtype = draw(st.sampled_from([np.float32, np.float64]))
    points = rng.integers(-grid, grid, (n, 3)).astype(dtype) / 7
    points[: draw(st.sampled_from([0, 0, n // 2, n - 1, max(n - 5, 0)]))] = points[0]
    return points


@given(points=clouds(), most=st.integers(1, 70))
def test_no_cell_exceeds_the_maximum_and_none_is_empty(points, most):
    cells = divide(points, most)
    leaf = cells.leaf_of(points)
    counts = np.bincount(leaf, minlength=cells.count)
    assert len(counts) == cells.count == (cells.axes == LEAF).sum()
    assert counts.min() >= 1
    for number in np.flatnonzero(counts > most):
        assert (np.ptp(points[leaf == number], axis=0) == 0).all()  # they coincide
    for first, end in cells.leaves[cells.axes != LEAF]:
        assert counts[first:end].sum() > most  # nothing is divided without need


@st.composite
def sizes(draw):
    """A maximum and a minimum for chunks that can both be kept."""
    most = draw(st.integers(1, 40))
    return most, draw(st.integers(1, (most + 1) // 2))


@given(points=clouds(), bounds=sizes())
def test_every_cell_has_at_least_the_minimum(points, bounds):
    """Except where no plane leaves enough on both sides, as when many points share coordinates."""
    most, least = bounds
    cells = divide(points, most, least)
    leaf = cells.leaf_of(points)
    counts = np.bincount(leaf, minlength=cells.count)
    assert counts.sum() == len(points)
    for number in np.flatnonzero(counts > most):
        assert (np.ptp(points[leaf == number], axis=0) == 0).all()  # they coincide
    for parent in np.flatnonzero(cells.axes != LEAF):
        first, end = cells.leaves[parent]
        sides = [counts[slice(*cells.leaves[child])].sum() for child in cells.children[parent]]
        if min(sides) < least:
            own = points[(leaf >= first) & (leaf < end)]
            assert min(sides) == max(
                min((own[:, axis] < plane).sum(), (own[:, axis] >= plane).sum())
                for axis in range(3)
                for plane in np.unique(own[:, axis])
            )
    if all(len(np.unique(column)) == len(points) for column in points.T):
        assert counts.max() <= most
        assert counts.min() >= min(least, len(points))


def test_if_no_plane_leaves_enough_on_both_sides_the_most_even_one_is_taken():
    points = np.zeros((30, 3))
    points[0, 0] = 9  # the longest side has one point apart from the others, the next has three
    points[1:4, 1] = 1
    cells = divide(points, 20, 10)
    assert (cells.axes[0], cells.planes[0]) == (1, 1)
    assert np.bincount(cells.leaf_of(points)).min() == 1  # the rest is still too many


@given(counts=st.lists(st.integers(0, 10), min_size=1, max_size=60), least=st.integers(1, 10))
def test_files_stay_between_the_minimum_and_the_maximum(counts, least):
    """Each cell has at most a quarter of a file and is in one file; the order of cells is kept."""
    runs = streamed_sog._runs(np.array(counts), 40, least)
    held = [sum(counts[first:end]) for first, end in runs]
    assert sum(held) == sum(counts)
    assert all(end == first for (_, end), (first, _) in itertools.pairwise(runs))
    assert max(held, default=0) <= 40
    assert min(held, default=least) >= min(least, sum(counts))


@given(counts=st.lists(st.integers(0, 100), min_size=1, max_size=60), least=st.integers(1, 10))
@example(counts=[5, 40], least=10)  # too much for one file, and too little for two
def test_files_reach_the_minimum_beside_cells_that_are_too_large(counts, least):
    runs = streamed_sog._runs(np.array(counts), 40, least)
    held = [sum(counts[first:end]) for first, end in runs]
    assert sum(held) == sum(counts)
    assert min(held, default=least) >= min(least, sum(counts))


def test_a_small_file_is_joined_to_the_neighbour_that_stays_smaller():
    assert streamed_sog._runs(np.array([49, 9, 39]), 40, 10) == [(0, 1), (1, 3)]
    assert streamed_sog._runs(np.array([39, 9, 49]), 40, 10) == [(0, 2), (2, 3)]


def test_boxes_are_rounded_outwards_and_hardly_further():
    rng = np.random.default_rng(0)
    box = rng.normal(size=(2, 1000)) * 10.0 ** rng.integers(-50, 38, (2, 1000))
    box[:, :100] = box[:, :100].astype(np.float32)  # not rounded at all
    low, high = (np.float32(streamed_sog._bound(box)[end]) for end in ("min", "max"))
    step = np.spacing(np.abs(box).astype(np.float32)) * np.float64(2)
    assert (low <= box[0]).all()
    assert (low >= box[0] - step[0]).all()
    assert (high >= box[1]).all()
    assert (high <= box[1] + step[1]).all()
    assert (low[:100] == box[0, :100]).all()
    far = streamed_sog._bound(np.array([[-1e300, -np.inf], [1e300, np.inf]]))
    assert far == {"min": [-FLOAT_MAX] * 2, "max": [FLOAT_MAX] * 2}


@given(points=clouds(), others=clouds(), most=st.integers(1, 70))
def test_cells_cover_all_of_space(points, others, most):
    """Any point has the leaf to which the planes lead, also far from the points of the cells."""
    cells = divide(points, most)
    for other, found in zip(100 * others, cells.leaf_of(100 * others), strict=True):
        node = 0
        while not cells.is_leaf(node):
            node = cells.children[node, int(other[cells.axes[node]] >= cells.planes[node])]
        assert cells.leaves[node].tolist() == [found, found + 1]


@given(points=clouds(), most=st.integers(1, 30), seed=st.integers(0, 99))
def test_cells_of_coarser_cuts_are_unions_of_finer_cells(points, most, seed):
    cells = divide(points, most)
    rng = np.random.default_rng(seed)
    finer = cells.all_leaves()
    for top in (2 * most, most, 3):
        counts = rng.integers(0, top + 1, cells.count)
        cut = cells.cut(counts, most, finer)
        spans = [cells.leaves[node].tolist() for node in cut]
        assert [first for first, _ in spans] == [0, *(end for _, end in spans[:-1])]
        assert spans[-1][1] == cells.count
        edges = {edge for node in finer for edge in cells.leaves[node].tolist()}
        assert {edge for span in spans for edge in span} <= edges
        for node, (first, end) in zip(cut, spans, strict=True):
            assert counts[first:end].sum() <= most or node in finer
        finer = frozenset(cut)


def test_boxes_enclose_the_ellipsoids_tightly(monkeypatch):
    monkeypatch.setattr("nanogs.lod.boxes.BLOCK_ROWS", 70)
    splats = random_splats(300, seed=3)
    box = box_around(splats, 3.0)
    directions = np.random.default_rng(0).normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    w, v = splats.unit_quats()[:, :1], splats.unit_quats()[:, 1:]
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for i in range(len(splats)):
        points = 3 * splats.scales()[i] * directions
        points = points + 2 * np.cross(v[i], np.cross(v[i], points) + w[i] * points)
        low = np.minimum(low, (splats.means[i] + points).min(axis=0))
        high = np.maximum(high, (splats.means[i] + points).max(axis=0))
    assert (box[0] <= low + 1e-6).all()
    assert (box[1] >= high - 1e-6).all()
    assert np.allclose([box[0], box[1]], [low, high], atol=0.01 * (high - low).max())


def test_splats_of_a_cell_keep_their_order():
    """So bytes do not depend on how a machine sorts."""
    splats = random_splats(400, degree=0)
    level = SortedLevel(splats, [(400, divide(splats.means, 100))])
    taken, leaf = level.take(0, level.cells.count)
    expected = np.lexsort((np.arange(400), level.leaves))
    assert leaf.tolist() == level.leaves[expected].tolist()
    np.testing.assert_array_equal(taken.means, splats.means[expected])


# The folder


def test_every_level_equals_that_of_the_library_up_to_quantisation(splats, path):
    meta = json.loads(path.read_text())
    levels = list(nanogs.levels(splats, RATIOS, preset="fast"))
    assert meta["counts"] == [len(small) for small, _ in levels] == [450, 90, 18]
    assert (meta["count"], meta["lodLevels"], meta["version"]) == (558, 3, 1)
    for level, (small, _) in enumerate(levels):
        loaded = in_order_of(small, nanogs.load(path, level=level))
        logarithms = [np.log1p(np.abs(m.means)) for m in (small, loaded)]
        assert np.abs(logarithms[0] - logarithms[1]).max() < 1e-3
        assert angle(small, loaded).max() < 0.035
        assert np.abs(small.log_scales - loaded.log_scales).max() < 0.03
        assert np.abs(small.opacities() - loaded.opacities()).max() <= 0.5 / 255 + 1e-9
        assert np.abs(small.sh[:, 0] - loaded.sh[:, 0]).max() < 0.03
    assert len(io.load(path)) == io.inspect(path).splats == 450


def test_chunks_cover_every_file_and_are_bounded(path):
    meta = json.loads(path.read_text())
    runs = {}
    for leaf in leaves(meta["tree"]):
        assert 1 <= leaf["lods"]["0"]["count"] <= CHUNK
        for level, entry in leaf["lods"].items():
            name = meta["filenames"][entry["file"]]
            assert name.startswith(f"{level}_")  # a file holds one level
            runs.setdefault(name, []).append((entry["offset"], entry["count"]))
    assert set(runs) == set(meta["filenames"])
    sums = dict.fromkeys("012", 0)
    for name, spans in runs.items():
        ends = list(itertools.accumulate(count for _, count in sorted(spans)))
        assert [offset for offset, _ in sorted(spans)] == [0, *ends[:-1]]
        assert ends[-1] == io.inspect(path.parent / name).splats <= 4 * CHUNK
        sums[name[0]] += ends[-1]
    assert list(sums.values()) == meta["counts"]
    assert len([name for name in runs if name.startswith("0_")]) == 2


@pytest.mark.filterwarnings("error")
def test_boxes_of_a_scene_at_the_end_of_single_precision_are_finite(tmp_path):
    model = random_splats(60)
    model.means[0], model.log_scales[0] = 3.3e38, 87.5
    write_levels(model, tmp_path / "s", [1, 0.5], layout=LodLayout.SOG, chunk=20, preset="fast")
    meta = json.loads((tmp_path / "s" / "lod-meta.json").read_text())
    assert meta["tree"]["bound"]["max"] == [pytest.approx(float(np.finfo(np.float32).max))] * 3
    assert len(nanogs.load(tmp_path / "s" / "lod-meta.json")) == 60


def test_the_tree_is_binary_and_its_boxes_enclose_the_splats(path):
    meta = json.loads(path.read_text())
    assert_binary(meta["tree"])
    for leaf in leaves(meta["tree"]):
        for entry in leaf["lods"].values():
            rows = np.arange(entry["offset"], entry["offset"] + entry["count"])
            part = io.load(path.parent / meta["filenames"][entry["file"]]).take(rows)
            box = box_around(part, 1.0)
            slack = 0.05 * (box[1] - box[0]).max()  # because positions are quantised
            assert (box[0] >= leaf["bound"]["min"] - slack).all()
            assert (box[1] <= leaf["bound"]["max"] + slack).all()


@pytest.mark.skipif(most_threads() < 2, reason="this machine has one thread")
def test_bytes_are_the_same_for_any_number_of_threads(splats, path, tmp_path):
    for number, threads in enumerate((None, 1, 2)):
        with use_threads(threads):
            write(splats, tmp_path / str(number), threads=threads)
        assert files(tmp_path / str(number)) == files(path.parent)


def test_one_level_of_one_splat_or_of_coincident_splats(tmp_path):
    for number, splats in enumerate(
        (random_splats(1), replace(random_splats(50), means=np.ones((50, 3), np.float32)))
    ):
        write(splats, tmp_path / str(number), ratios=[1.0], chunk=10)
        meta = json.loads((tmp_path / str(number) / "lod-meta.json").read_text())
        assert "lods" in meta["tree"]
        assert len(io.load(tmp_path / str(number) / "lod-meta.json")) == len(splats)


def test_a_level_is_freed_after_it_is_added(tmp_path):
    small = random_splats(200)
    array = weakref.ref(small.sh)
    out = LevelsFolder(tmp_path, overwrite=True, source="", block_layout=StreamedSog(50))
    out = out.open(tmp_path, {})
    out.add(small)
    del small
    assert array() is None


def test_extra_columns_that_are_left_out_are_noted(tmp_path):
    label = {"label": np.arange(90, dtype=np.int32)}
    manifest, _ = write(random_splats(90, extras=label), tmp_path / "a")
    assert manifest.notes == ("Extra columns are left out, .sog has no room for them: label.",)


def test_each_layout_replaces_the_files_of_another(splats, tmp_path):
    folder = tmp_path / "levels"
    for layout, file in ((LodLayout.FILES, "levels.json"), (LodLayout.SOG, "lod-meta.json")) * 2:
        write(
            splats, folder, layout=layout, overwrite=True, ratios=[0.5, 0.1],
            chunk=None if layout is LodLayout.FILES else CHUNK,
        )  # fmt: skip
        assert (folder / file).exists()
        assert set(files(folder)) == made_files(folder)
    with pytest.raises(OutputError, match="overwrite=True"):
        write(splats, folder)
    assert [entry.name for entry in tmp_path.iterdir()] == ["levels"]


@pytest.mark.parametrize("empty", [False, True])
def test_a_replaced_folder_keeps_its_permissions(splats, tmp_path, empty):
    folder = tmp_path / "levels"
    folder.mkdir() if empty else write(splats, folder)
    folder.chmod(0o750)
    write(splats, folder, overwrite=True)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o750


@pytest.mark.parametrize("name", ["", "0_0"])
def test_a_read_only_folder_is_not_replaced(splats, tmp_path, monkeypatch, name):
    folder, access = tmp_path / "levels", os.access
    write(splats, folder)
    (folder / name).chmod(0o500)  # by root, everything can be written
    read_only = os.path.realpath(folder / name)
    monkeypatch.setattr(
        atomic.os, "access", lambda path, mode: str(path) != read_only and access(path, mode)
    )
    before = files(folder)
    with pytest.raises(OutputError) as error:
        write(splats, folder, overwrite=True)
    assert str(error.value) == (
        f"{folder / name} is read-only; change its permissions or the output."
    )
    assert (files(folder), [*tmp_path.iterdir()]) == (before, [folder])


@pytest.mark.parametrize("foreign_path", ["mine.txt", "0_0/mine.txt", "mine/a/b.txt", "empty/"])
def test_foreign_files_in_the_folder_are_never_deleted(splats, tmp_path, foreign_path):
    folder = tmp_path / "levels"
    write(splats, folder)
    if foreign_path.endswith("/"):
        (folder / foreign_path).mkdir()
    else:
        (folder / foreign_path).parent.mkdir(parents=True, exist_ok=True)
        (folder / foreign_path).write_text("mine")
    before = files(folder)
    with pytest.raises(
        OutputError, match=f"also holds '{foreign_path}', which nanogs did not make"
    ):
        write(splats, folder, overwrite=True)
    assert files(folder) == before
    assert (folder / foreign_path).exists()


def test_a_symbolic_link_in_the_folder_is_not_followed(splats, tmp_path):
    write(splats, tmp_path / "levels")
    shutil.copytree(tmp_path / "levels" / "0_0", tmp_path / "other")
    shutil.rmtree(tmp_path / "levels" / "0_0")
    (tmp_path / "levels" / "0_0").symlink_to(tmp_path / "other")
    before = files(tmp_path / "other")
    with pytest.raises(OutputError, match="'0_0', which nanogs did not make"):
        write(splats, tmp_path / "levels", overwrite=True)
    assert files(tmp_path / "other") == before


def test_a_changed_manifest_cannot_name_files_elsewhere(splats, tmp_path):
    write(splats, tmp_path / "levels")
    write(splats, tmp_path / "other")
    path = tmp_path / "levels" / "lod-meta.json"
    meta = json.loads(path.read_text())
    outside = ("../other/0_0/meta.json", "0_0/../../other/0_0/meta.json")
    meta["filenames"] = [*outside, f"{tmp_path}/other/0_0/meta.json", 5, "0_0/x"]
    path.write_text(json.dumps(meta))
    assert made_files(tmp_path / "levels") == {"lod-meta.json"}
    for wrong in ("{", "[]", '{"asset": {"generator": "splat-transform v3"}}', '{"asset": 5}'):
        path.write_text(wrong)
        assert made_files(tmp_path / "levels") is None


def test_an_interrupted_call_leaves_the_old_folder_unchanged(splats, tmp_path):
    folder = tmp_path / "levels"
    write(splats, folder)
    before = files(folder)

    def progress(step):
        if step.stage == "write" and step.number == step.stages:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(splats, folder, ratios=(0.3, 0.1), overwrite=True, progress=progress)
    assert files(folder) == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["levels"]


def test_the_current_folder_and_its_parents_are_not_replaced(tmp_path, monkeypatch):
    (tmp_path / "inner").mkdir()
    monkeypatch.chdir(tmp_path / "inner")
    for path in (Path(), tmp_path / "inner", tmp_path):
        with (
            pytest.raises(OutputError, match="the folder you are in"),
            atomic_folder(path, made_files, overwrite=True),
        ):
            pass


# The command


def test_the_command_reports_and_plans_in_json(scene, tmp_path):
    path = tmp_path / "levels" / "lod-meta.json"
    plan = json.loads(run("lod", scene, path, "--dry-run", "--json").stdout)
    assert plan["layout"] == "streamed sog"
    assert [level["count"] for level in plan["levels"]] == [900, 450, 225, 113]
    assert list(tmp_path.iterdir()) == []
    result = run("lod", scene, path, "--preset", "fast", "--json")
    assert (result.returncode, result.stderr) == (0, "")
    report = json.loads(result.stdout)
    assert (report["layout"], report["output"]) == ("streamed sog", str(path))
    assert [level["count"] for level in report["levels"]] == [900, 450, 225, 113]
    sizes = sum(file.stat().st_size for file in path.parent.rglob("*.*"))
    assert sum(level["bytes"] for level in report["levels"]) == sizes - path.stat().st_size
    assert [level["files"] for level in report["levels"]] == [
        [f"{n}_0/meta.json"] for n in range(4)
    ]
    request_counts = [len(list((path.parent / f"{n}_0").iterdir())) for n in range(4)]
    assert [level["requests"] for level in report["levels"]] == request_counts
    shown = run("lod", scene, path, "--preset", "fast", "-w")
    assert (shown.returncode, shown.stdout) == (0, "")
    assert "0, 1 file" in shown.stderr
    first = bytes_text(report["levels"][3]["bytes"] + path.stat().st_size)
    assert f"first picture takes {1 + request_counts[3]} requests and {first}\n" in shown.stderr
    assert f"4 levels in {path}, {bytes_text(sizes)}" in shown.stderr


@pytest.mark.parametrize(
    ("name", "options", "fragments"),
    [
        ("out/levels.json", [], ["lod-meta.json or tileset.json", "out/lod-meta.json"]),
        ("out/web.json", [], ["lod-meta.json or tileset.json", "out/web/lod-meta.json"]),
        ("out/meta.json", [], ["lod-meta.json or tileset.json", "out/lod-meta.json"]),
        ("out.rad", ["--chunk", "100"], [".rad", "65,536"]),
        ("out.rad", ["--chunk-min", "100"], [".rad", "65,536"]),
        ("out", ["--chunk", "100"], ["chunks", ".ssog", "not divided"]),
        ("out", ["--chunk-min", "100"], ["chunks", ".ssog", "not divided"]),
        ("out/lod-meta.json", ["--chunk-min", "20000"], ["20,000 to 32,768", "at most half"]),
        ("out/lod-meta.json", ["--chunk", "10", "--chunk-min", "6"], ["6 to 10", "at most half"]),
        ("out/lod-meta.json", ["--chunk", "2147483648"], ["at most 2,147,483,647"]),
        ("out/lod-meta.json", ["--chunk-min", "0"], ["at least 1", "0"]),
        ("out/lod-meta.json", ["--chunk", "0"], ["at least 1", "0"]),
        ("out/lod-meta.json", ["--plain"], ["3D Tiles"]),
        ("missing/out/lod-meta.json", [], ["missing"]),
    ],
)
def test_wrong_names_and_options_are_refused(scene, tmp_path, name, options, fragments):
    assert_refused(run("lod", scene, tmp_path / name, *options), *fragments)
    assert list(tmp_path.iterdir()) == []


def test_sizes_of_chunks_may_have_units(tmp_path):
    model, options = tmp_path / "a.ply", ["--levels", "1,0.5", "--preset", "fast"]
    nanogs.save(random_splats(3000, degree=0), model)
    for name, sizes in (
        ("long", ["--chunk", "1000", "--chunk-min", "200"]),
        ("short", ["--chunk", "1k", "--chunk-min", "0.2k"]),
    ):
        target = tmp_path / name / "lod-meta.json"
        assert run("lod", model, target, *options, *sizes).returncode == 0
    first, second = (sorted((tmp_path / name).rglob("*.*")) for name in ("long", "short"))
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]
    assert len(first) > 8


@pytest.mark.parametrize(("chunk", "least"), [(1, None), (3, None), (7, 4), (9, 5)])
def test_any_size_of_chunks_is_possible(chunk, least):
    layout = block_layout_of(LodLayout.SOG, chunk, least, plain=False)
    assert (layout.most, layout.least) == (chunk, least or 1)


def test_the_output_name_determines_the_layout():
    assert output_of(Path("a/lod-meta.json")).layout is LodLayout.SOG
    assert output_of(Path("a/tileset.json")).layout is LodLayout.TILES
    assert output_of(Path("a/b.c")).layout is LodLayout.FILES
    assert output_of(Path("a/b.c")).path == Path("a/b.c")
    assert output_of(Path("a/lod-meta.json")).folder == Path("a")


@pytest.mark.parametrize(
    ("name", "suffix", "layout", "opened", "model"),
    [
        ("web/lod-meta.json", None, "streamed sog", "web/lod-meta.json", "web/level_0.sog"),
        ("web/tileset.json", None, "3d tiles", "web/tileset.json", "web/level_0.glb"),
        ("a.SSOG", None, "streamed sog archive", "a.SSOG", "a.SSOG/level_0.sog"),
        ("a.RAD", None, "spark tree", "a.RAD", "a.RAD/level_0.rad"),
        ("web", None, "files", "web", "web/level_0.ply"),
        ("web", "spz", "files", "web", "web/level_0.spz"),
    ],
)
def test_the_output_has_a_path_to_open_and_models_of_one_format(
    name, suffix, layout, opened, model
):
    output = output_of(Path(name), suffix)
    assert (output.layout, output.path, output.model) == (layout, Path(opened), Path(model))


KINDS = "levels are described by a file called lod-meta.json or tileset.json; name that, as in"
SEVERAL = "but there are several levels: name a folder, as in a/b/"


@pytest.mark.parametrize(
    ("name", "suffix", "message"),
    [
        ("a.ssog", ".ply", "because a.ssog already determines it; leave it out."),
        ("a.RAD", "spz", "because a.RAD already determines it; leave it out."),
        ("a/tileset.json", "ply", "because tileset.json already determines it; name a folder"),
        ("web", "ssog", "`format` is that of a file for each; leave it out, and name web.ssog."),
        ("web", "lod-meta.json", "for each; leave it out, and name web/lod-meta.json."),
        ("a/b.json", None, f"a/b.json: {KINDS} a/b/lod-meta.json, or a folder."),
        ("a/meta.json", None, f"a/meta.json: {KINDS} a/lod-meta.json, or a folder."),
        ("a/b.PNG", None, "a/b.PNG names a picture; name a folder, as in a/b/."),
        ("a/b.spz", None, f'one .spz file, {SEVERAL}, and give `format="spz"`.'),
        ("a/b.ksplat", None, f"one .ksplat file, {SEVERAL}."),
        ("web", "ksplat", "does not write a format 'ksplat'"),
    ],
)
def test_names_of_outputs_that_are_misunderstood_are_refused(name, suffix, message):
    with pytest.raises(OptionError) as caught:
        output_of(Path(name), suffix)
    assert message in str(caught.value).replace(os.sep, "/")


def test_chunks_have_the_usual_sizes_or_a_quarter_of_the_largest_as_the_least():
    for chunk, sizes in ((None, (32768, 8192)), (10**6, (10**6, 8192)), (1000, (1000, 250))):
        for name in ("streamed sog", "streamed sog archive", "3d tiles"):
            layout = block_layout_of(name, chunk, plain=False)
            assert (layout.most, layout.least) == sizes
            assert isinstance(layout, Tiles) == (name == "3d tiles")
    assert [block_layout_of("3d tiles", None, plain=each).packed for each in (True, False)] == [
        False, True,
    ]  # fmt: skip
    assert block_layout_of("spark tree", None, plain=False) == Linked()
    assert block_layout_of("files", None, plain=False) is None
    assert block_layout_of("streamed sog", 2**31 - 1, plain=False).most == 2**31 - 1


@pytest.mark.parametrize(
    ("layout", "options", "message"),
    [
        (
            "other",
            {},
            'There is no layout "other"; choose from "files", "streamed sog", "3d tiles"',
        ),
        ("files", {"chunk": 5}, "levels in separate files are not divided; leave it out"),
        ("files", {"chunk_min": 5}, "levels in separate files are not divided; leave it out"),
        ("spark tree", {"chunk": 5}, "cannot be given for a .rad file"),
        ("spark tree", {"chunk_min": 5}, "cannot be given for a .rad file"),
        ("streamed sog", {"plain": True}, "Plain contents are possible only in 3D Tiles"),
        ("files", {"place": np.eye(4)}, "A place on Earth is possible only in 3D Tiles"),
        ("3d tiles", {"chunk": 2**31}, "not 2147483648, and at most 2,147,483,647."),
        ("3d tiles", {"chunk": 9, "chunk_min": 2.5}, "must be a whole number of splats, not 2.5,"),
    ],
)
def test_options_that_a_layout_lacks_are_refused(layout, options, message):
    with pytest.raises(OptionError, match=re.escape(message)):
        block_layout_of(layout, **{"chunk": None, "plain": False} | options)


def test_levels_of_a_real_scene_have_the_requested_counts(tmp_path):
    model = io.load(scene_path("biker.compressed.ply"))
    manifest, _ = write(model, tmp_path / "biker", chunk=10_000, ratios=[0.5, 0.1, 0.01])
    path = tmp_path / "biker" / "lod-meta.json"
    meta = json.loads(path.read_text())
    assert meta["counts"] == [len(nanogs.load(path, level=level)) for level in range(3)]
    assert meta["counts"] == [76_373, 15_275, 1_528]
    assert len(leaves(meta["tree"])) == 8
    assert manifest.levels[0].bytes < 76_373 * 16


def test_the_command_that_is_printed_works_for_a_name_with_blanks(splats, tmp_path):
    io.save(splats, tmp_path / "a.ply")
    made = run("lod", "a.ply", "my scene/lod-meta.json", "--preset", "fast", cwd=tmp_path)
    assert "\n`nanogs view 'my scene/lod-meta.json'` makes a page" in made.stderr


# The viewer


@pytest.mark.usefixtures("one_tab")
@pytest.mark.filterwarnings("default")  # the driver's own warnings are not ours
def test_supersplat_streams_from_the_coarsest_to_the_finest_level(path, tmp_path):
    """The coarsest level is loaded first, the finest in the end, and the picture is not empty."""
    pixels, requested = render_in_supersplat(path, tmp_path, 450)
    assert requested[:2] == ["scene/lod-meta.json", "scene/2_0/meta.json"]
    assert {"scene/0_0/meta.json", "scene/0_1/meta.json"} <= set(requested)
    assert (pixels.max(axis=2) > 0.16).mean() > 0.05
    assert (pixels.max(axis=2) < 0.03).mean() > 0.05  # and the background around it


@pytest.mark.usefixtures("one_tab")
@pytest.mark.filterwarnings("default")
def test_supersplat_reads_palettes_of_any_size(tmp_path):
    """A .sog file with 300 palette entries looks like the .ply that nanogs converts it to."""
    model = random_splats(900, degree=2, seed=5)
    model = replace(model, sh=model.sh * np.float32(2))
    io.save(model, tmp_path / "a.sog", format_options={"palette": 300})
    io.save(io.load(tmp_path / "a.sog"), tmp_path / "b.ply")
    start = {"position": [6, 6, 6], "target": [0, 0, 0]}
    packed, plain = (
        render_in_supersplat(tmp_path / name, tmp_path, 900, **start)[0]
        for name in ("a.sog", "b.ply")
    )
    assert (plain.max(axis=2) > 0.16).mean() > 0.05
    assert np.abs(packed - plain).mean() < 0.002
