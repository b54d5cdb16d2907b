"""Streamed SOG: the division of space, the folder that `nanogs lod` makes, and the real viewer."""

import hashlib
import itertools
import json
import shutil
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import nanogs
from builders import random_splats
from conftest import scene_path
from launch import run
from nanogs import io
from nanogs.errors import OptionError, OutputError
from nanogs.io.folder import atomic_folder
from nanogs.levels_of_detail import write_levels
from nanogs.lod import streamed_sog
from nanogs.lod.boxes import box_around
from nanogs.lod.cells import LEAF, divide
from nanogs.lod.folder import LevelsFolder, made_files
from nanogs.lod.layout import Layout, output_of
from nanogs.lod.streamed_sog import StreamedSog
from nanogs.threads import use_threads
from supersplatpage import in_supersplat
from test_cli import assert_refused
from test_sog_write import angle, in_order_of

RATIOS = (0.5, 0.1, 0.02)
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


def write(splats, folder, *, layout=Layout.SOG, chunk=CHUNK, ratios=RATIOS, **options):
    return write_levels(
        splats, folder, ratios, source="a.ply", preset="fast", layout=layout, chunk=chunk, **options
    )


def nodes(tree):
    """Every node, with the boxes of all above it."""
    waiting = [(tree, [])]
    while waiting:
        node, above = waiting.pop()
        yield node, above
        waiting += [(child, [*above, node["bound"]]) for child in node.get("children", [])]


def assert_binary(tree):
    """Two children or none, each within all boxes above it."""
    for node, above in nodes(tree):
        assert ("children" in node) != ("lods" in node)
        assert len(node.get("children", [0, 0])) == 2
        for bound in above:
            assert (np.array(bound["min"]) <= node["bound"]["min"]).all()
            assert (np.array(bound["max"]) >= node["bound"]["max"]).all()


def leaves(tree):
    return [node for node, _ in nodes(tree) if "lods" in node]


def files(folder):
    """Every file's digest by its path."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


# Cells


@st.composite
def clouds(draw):
    """Points of which some coincide or share a coordinate."""
    n = draw(st.integers(1, 60))
    grid = draw(st.sampled_from([1, 2, 5, 1000]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    dtype = draw(st.sampled_from([np.float32, np.float64]))
    return rng.integers(-grid, grid, (n, 3)).astype(dtype) / 7


@given(points=clouds(), most=st.integers(1, 70))
def test_no_cell_holds_too_much_and_none_is_empty(points, most):
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
    """Bounds of a chunk of which each can be had."""
    most = draw(st.integers(1, 40))
    return most, draw(st.integers(1, (most + 1) // 2))


@given(points=clouds(), bounds=sizes())
def test_no_cell_holds_too_few(points, bounds):
    """But where no plane leaves enough on both sides, as in a heap that shares its coordinates."""
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
            assert all(
                min((own[:, axis] < plane).sum(), (own[:, axis] >= plane).sum()) < least
                for axis in range(3)
                for plane in np.unique(own[:, axis])
            )
    if all(len(np.unique(column)) == len(points) for column in points.T):
        assert counts.max() <= most
        assert counts.min() >= min(least, len(points))


@given(counts=st.lists(st.integers(0, 10), min_size=1, max_size=60), least=st.integers(1, 10))
def test_files_hold_neither_too_much_nor_too_little(counts, least):
    """Cells of no more than a quarter of a file, each in one file, in their order."""
    runs = streamed_sog._runs(np.array(counts), 40, least)
    held = [sum(counts[first:end]) for first, end in runs]
    assert sum(held) == sum(counts)
    assert all(end == first for (_, end), (first, _) in itertools.pairwise(runs))
    assert max(held, default=0) <= 40
    assert min(held, default=least) >= min(least, sum(counts))


@given(counts=st.lists(st.integers(0, 100), min_size=1, max_size=60), least=st.integers(1, 10))
def test_cells_that_are_too_large_take_others_into_their_files(counts, least):
    runs = streamed_sog._runs(np.array(counts), 40, least)
    held = [sum(counts[first:end]) for first, end in runs]
    assert sum(held) == sum(counts)
    assert min(held, default=least) >= min(least, sum(counts))


@given(points=clouds(), others=clouds(), most=st.integers(1, 70))
def test_cells_fill_all_of_space(points, others, most):
    """A centre lies in the one leaf whose planes say so, whatever the cells were made from."""
    cells = divide(points, most)
    for other, found in zip(100 * others, cells.leaf_of(100 * others), strict=True):
        node = 0
        while not cells.is_leaf(node):
            node = cells.children[node, int(other[cells.axes[node]] >= cells.planes[node])]
        assert cells.leaves[node].tolist() == [found, found + 1]


@given(points=clouds(), most=st.integers(1, 30), seed=st.integers(0, 99))
def test_coarser_cuts_hold_whole_finer_cells(points, most, seed):
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


def test_boxes_enclose_the_ellipsoids_and_touch_them():
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


# The folder


def test_every_level_is_what_the_library_makes(splats, path):
    meta = json.loads(path.read_text())
    made = list(nanogs.levels(splats, RATIOS, preset="fast"))
    assert meta["counts"] == [len(small) for small, _ in made] == [450, 90, 18]
    assert (meta["count"], meta["lodLevels"], meta["version"]) == (558, 3, 1)
    for level, (small, _) in enumerate(made):
        back = in_order_of(small, nanogs.load(path, level=level))
        logarithms = [np.log1p(np.abs(m.means)) for m in (small, back)]
        assert np.abs(logarithms[0] - logarithms[1]).max() < 1e-3
        assert angle(small, back).max() < 0.035
        assert np.abs(small.log_scales - back.log_scales).max() < 0.03
        assert np.abs(small.opacities() - back.opacities()).max() <= 0.5 / 255 + 1e-9
        assert np.abs(small.sh[:, 0] - back.sh[:, 0]).max() < 0.03
    assert len(io.load(path)) == io.inspect(path).splats == 450


def test_runs_cover_every_file_and_chunks_are_bounded(path):
    meta = json.loads(path.read_text())
    runs = {}
    for leaf in leaves(meta["tree"]):
        assert 1 <= leaf["lods"]["0"]["count"] <= CHUNK
        for level, place in leaf["lods"].items():
            name = meta["filenames"][place["file"]]
            assert name.startswith(f"{level}_")  # a file holds one level
            runs.setdefault(name, []).append((place["offset"], place["count"]))
    assert set(runs) == set(meta["filenames"])
    sums = dict.fromkeys("012", 0)
    for name, spans in runs.items():
        ends = list(itertools.accumulate(count for _, count in sorted(spans)))
        assert [offset for offset, _ in sorted(spans)] == [0, *ends[:-1]]
        assert ends[-1] == io.inspect(path.parent / name).splats <= 4 * CHUNK
        sums[name[0]] += ends[-1]
    assert list(sums.values()) == meta["counts"]
    assert len([name for name in runs if name.startswith("0_")]) == 2


def test_the_tree_is_binary_and_its_boxes_enclose_the_splats(path):
    meta = json.loads(path.read_text())
    assert_binary(meta["tree"])
    for leaf in leaves(meta["tree"]):
        for place in leaf["lods"].values():
            rows = np.arange(place["offset"], place["offset"] + place["count"])
            part = io.load(path.parent / meta["filenames"][place["file"]]).take(rows)
            box = box_around(part, 1.0)
            slack = 0.05 * (box[1] - box[0]).max()  # for the quantisation
            assert (box[0] >= leaf["bound"]["min"] - slack).all()
            assert (box[1] <= leaf["bound"]["max"] + slack).all()


def test_same_bytes_again_and_for_any_number_of_threads(splats, path, tmp_path):
    for number, threads in enumerate((None, 1, 2)):
        try:
            with use_threads(threads):
                write(splats, tmp_path / str(number), threads=threads)
        except OptionError:
            pytest.skip("this machine has one thread")
        assert files(tmp_path / str(number)) == files(path.parent)


def test_one_level_and_one_splat_and_coincident_ones(tmp_path):
    for number, splats in enumerate(
        (random_splats(1), replace(random_splats(50), means=np.ones((50, 3), np.float32)))
    ):
        write(splats, tmp_path / str(number), ratios=[1.0], chunk=10)
        meta = json.loads((tmp_path / str(number) / "lod-meta.json").read_text())
        assert "lods" in meta["tree"]
        assert len(io.load(tmp_path / str(number) / "lod-meta.json")) == len(splats)


def test_nothing_of_a_level_is_kept(tmp_path):
    small = random_splats(200)
    array = weakref.ref(small.sh)
    out = LevelsFolder(tmp_path, overwrite=True, source="", chunks=StreamedSog(50))
    out = out.open(tmp_path, {})
    out.add(small)
    del small
    assert array() is None


def test_what_is_left_out_is_said(tmp_path):
    label = {"label": np.arange(90, dtype=np.int32)}
    manifest, _ = write(random_splats(90, extras=label), tmp_path / "a")
    assert manifest.notes == ("Extra columns are left out, .sog has no room for them: label.",)


def test_other_layouts_take_each_others_place(splats, tmp_path):
    folder = tmp_path / "levels"
    for layout, file in ((Layout.FILES, "levels.json"), (Layout.SOG, "lod-meta.json")) * 2:
        write(
            splats, folder, layout=layout, overwrite=True, ratios=[0.5, 0.1],
            chunk=None if layout is Layout.FILES else CHUNK,
        )  # fmt: skip
        assert (folder / file).exists()
        assert set(files(folder)) == made_files(folder)
    with pytest.raises(OutputError, match="overwrite=True"):
        write(splats, folder)
    assert [entry.name for entry in tmp_path.iterdir()] == ["levels"]


@pytest.mark.parametrize("place", ["mine.txt", "0_0/mine.txt", "mine/a/b.txt", "empty/"])
def test_what_others_made_is_never_deleted(splats, tmp_path, place):
    folder = tmp_path / "levels"
    write(splats, folder)
    if place.endswith("/"):
        (folder / place).mkdir()
    else:
        (folder / place).parent.mkdir(parents=True, exist_ok=True)
        (folder / place).write_text("mine")
    before = files(folder)
    with pytest.raises(OutputError, match=f"also holds '{place}', which nanogs did not make"):
        write(splats, folder, overwrite=True)
    assert files(folder) == before
    assert (folder / place).exists()


def test_a_folder_linked_into_it_is_not_followed(splats, tmp_path):
    write(splats, tmp_path / "levels")
    shutil.copytree(tmp_path / "levels" / "0_0", tmp_path / "other")
    shutil.rmtree(tmp_path / "levels" / "0_0")
    (tmp_path / "levels" / "0_0").symlink_to(tmp_path / "other")
    before = files(tmp_path / "other")
    with pytest.raises(OutputError, match="'0_0', which nanogs did not make"):
        write(splats, tmp_path / "levels", overwrite=True)
    assert files(tmp_path / "other") == before


def test_a_changed_manifest_leads_to_no_file_elsewhere(splats, tmp_path):
    write(splats, tmp_path / "levels")
    write(splats, tmp_path / "other")
    path = tmp_path / "levels" / "lod-meta.json"
    meta = json.loads(path.read_text())
    meta["filenames"] = ["../other/0_0/meta.json", f"{tmp_path}/other/0_0/meta.json", 5, "0_0/x"]
    path.write_text(json.dumps(meta))
    assert made_files(tmp_path / "levels") == {"lod-meta.json"}
    for wrong in ("{", "[]", '{"asset": {"generator": "splat-transform v3"}}', '{"asset": 5}'):
        path.write_text(wrong)
        assert made_files(tmp_path / "levels") is None


def test_a_failure_half_way_leaves_what_was(splats, tmp_path, monkeypatch):
    folder = tmp_path / "levels"
    write(splats, folder)
    before = files(folder)

    def progress(step):
        if step.stage == "write" and step.number == step.stages:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(splats, folder, overwrite=True, progress=progress)
    assert files(folder) == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["levels"]


def test_the_folder_one_is_in_is_not_replaced(tmp_path, monkeypatch):
    (tmp_path / "inner").mkdir()
    monkeypatch.chdir(tmp_path / "inner")
    for path in (Path(), tmp_path / "inner", tmp_path):
        with (
            pytest.raises(OutputError, match="the folder you are in"),
            atomic_folder(path, made_files, overwrite=True),
        ):
            pass


# The command


def test_json_report_and_plan(scene, tmp_path):
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
    of_each = [len(list((path.parent / f"{n}_0").iterdir())) for n in range(4)]
    assert [level["requests"] for level in report["levels"]] == of_each
    shown = run("lod", scene, path, "--preset", "fast", "-w")
    assert (shown.returncode, shown.stdout) == (0, "")
    assert "0, 1 file" in shown.stderr
    assert f"first picture takes {1 + of_each[3]} requests and " in shown.stderr


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("out/levels.json", [], ["lod-meta.json or tileset.json", "out/levels/lod-meta.json"]),
        ("out/meta.json", [], ["lod-meta.json or tileset.json"]),
        ("out", ["--chunk", "100"], ["chunks", ".ssog", "not divided"]),
        ("out", ["--chunk-min", "100"], ["chunks", ".ssog", "not divided"]),
        ("out/lod-meta.json", ["--chunk-min", "20000"], ["20,000 to 32,768", "at most half"]),
        ("out/lod-meta.json", ["--chunk-min", "0"], ["at least 1", "0"]),
        ("out/lod-meta.json", ["--chunk", "0"], ["at least 1", "0"]),
        ("out/lod-meta.json", ["--plain"], ["3D Tiles"]),
        ("missing/out/lod-meta.json", [], ["missing"]),
    ],
)
def test_refused(scene, tmp_path, name, options, words):
    assert_refused(run("lod", scene, tmp_path / name, *options), *words)
    assert list(tmp_path.iterdir()) == []


def test_names_tell_the_layout():
    assert output_of(Path("a/lod-meta.json")).layout is Layout.SOG
    assert output_of(Path("a/tileset.json")).layout is Layout.TILES
    assert output_of(Path("a/b.c")).layout is Layout.FILES
    assert output_of(Path("a/b.c")).path == Path("a/b.c")
    assert output_of(Path("a/lod-meta.json")).folder == Path("a")


def test_real_scene(tmp_path):
    model = io.load(scene_path("biker.compressed.ply"))
    manifest, _ = write(model, tmp_path / "biker", chunk=10_000, ratios=[0.5, 0.1, 0.01])
    path = tmp_path / "biker" / "lod-meta.json"
    meta = json.loads(path.read_text())
    assert meta["counts"] == [len(nanogs.load(path, level=level)) for level in range(3)]
    assert meta["counts"] == [76_373, 15_275, 1_528]
    assert len(leaves(meta["tree"])) == 8
    assert manifest.levels[0].bytes < 76_373 * 16


# The viewer


@pytest.mark.filterwarnings("default")  # the driver's own warnings are not ours
def test_the_viewer_streams_it(path, tmp_path):
    """From the coarsest level, which it shows first, to the finest, and something is seen."""
    pixels, scene = in_supersplat(path, tmp_path, 450)
    assert scene[:2] == ["scene/lod-meta.json", "scene/2_0/meta.json"]
    assert {"scene/0_0/meta.json", "scene/0_1/meta.json"} <= set(scene)
    assert (pixels.max(axis=2) > 0.16).mean() > 0.05
    assert (pixels.max(axis=2) < 0.03).mean() > 0.05  # and the background around it


@pytest.mark.filterwarnings("default")
def test_the_viewer_reads_palettes_of_any_size(tmp_path):
    """A file of 300 entries looks as what nanogs reads of it does as .ply."""
    model = random_splats(900, degree=2, seed=5)
    model = replace(model, sh=model.sh * np.float32(2))
    io.save(model, tmp_path / "a.sog", format_options={"palette": 300})
    io.save(io.load(tmp_path / "a.sog"), tmp_path / "b.ply")
    start = {"position": [6, 6, 6], "target": [0, 0, 0]}
    packed, plain = (
        in_supersplat(tmp_path / name, tmp_path, 900, **start)[0] for name in ("a.sog", "b.ply")
    )
    assert (plain.max(axis=2) > 0.16).mean() > 0.05
    assert np.abs(packed - plain).mean() < 0.002
