"""Levels of detail that are made in blocks, for models that do not fit into memory."""

import errno
import hashlib
import itertools
import json
import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import nanogs
from builders import random_splats
from crashes import CrashError, crash_at
from launch import run
from nanogs import io
from nanogs.block_layouts import BlockChunks
from nanogs.errors import FormatError, NotEnoughMemoryError, OptionError, OutputError
from nanogs.levels_of_detail import write_levels
from nanogs.lod import folder as levels_folder
from nanogs.lod.cells import divide
from nanogs.lod.folder import made_files
from nanogs.lod.layout import LodLayout
from nanogs.lod.streamed_sog import StreamedSog
from nanogs.lod.tiles import Tiles
from nanogs.pipeline import run as scale_run
from nanogs.pipeline import stages
from nanogs.pipeline.estimates.block_plan import plan_blocks
from nanogs.pipeline.job.folder import MANIFEST
from nanogs.pipeline.options.presets import PRESETS
from nanogs.pipeline.tasks.chunked import group_blocks
from nanogs.source import Layout as Columns
from nanogs.splats import concatenate
from supersplat_page import render_in_supersplat
from test_lod_stream import assert_binary, files, leaves
from test_scale_runs import wall
from test_tiles import corners, level_of, tiles

RATIOS = (0.5, 0.1, 0.02)
CHUNK = 60
BLOCK = 400


@pytest.fixture(scope="module")
def splats():
    return random_splats(1200, degree=1)


def write(scene, folder, layout, *, ratios=RATIOS, progress=None, **options):
    settings = {"preset": "fast", "rounds": 1, "block": BLOCK, "max_memory": None}
    if layout is not LodLayout.FILES:
        settings["chunk"] = CHUNK
    if layout is LodLayout.TILES:
        settings["plain"] = True
    return write_levels(
        scene, folder, ratios, layout=layout, threads=1, progress=progress, **(settings | options),
    )  # fmt: skip


@pytest.fixture(scope="module")
def levels_by_layout(scene, tmp_path_factory):
    """For each layout: its folder, its manifest and the reports of its levels."""
    folder = tmp_path_factory.mktemp("made")
    return {
        layout: (folder / layout.name, *write(scene, folder / layout.name, layout))
        for layout in LodLayout
        # Layouts of a single file are tested in test_rad_lod.py and test_lod_archive.py.
        if layout not in (LodLayout.TREE, LodLayout.ARCHIVE)
    }


@pytest.fixture(scope="module")
def plain(levels_by_layout):
    """The levels of the layout of plain files, finest first."""
    return [
        nanogs.load(levels_by_layout[LodLayout.FILES][0] / f"level_{n}.ply")
        for n in range(len(RATIOS))
    ]


def in_order(splats):
    return splats.take(np.lexsort(splats.means.T))


def tile_parts(path):
    """Load the contents of all tiles, listed by level."""
    parts = {}
    for tile, _ in tiles(path):
        if "content" in tile:
            parts.setdefault(level_of(tile), []).append(
                io.load(path.parent / tile["content"]["uri"])
            )
    return parts


# Contents of the levels


def test_every_layout_has_the_requested_counts(levels_by_layout):
    for layout, (folder, manifest, reports) in levels_by_layout.items():
        assert [level.count for level in manifest.levels] == [600, 120, 24]
        assert [report.achieved_count for report in reports] == [600, 120, 24]
        assert reports[0].blocks.blocks > 2
        assert set(files(folder)) == made_files(folder)
        if layout is not LodLayout.FILES:
            named = {name for level in manifest.levels for name in level.files}
            assert all((folder / name).exists() for name in named)
            index = {"tileset.json", "lod-meta.json"}
            sizes = [(folder / name).stat().st_size for name in set(files(folder)) - index]
            assert sum(level.bytes for level in manifest.levels) == sum(sizes)


def test_the_tiles_of_a_level_together_equal_the_plain_level(levels_by_layout, plain):
    """The same splats bit for bit, none twice and none missing."""
    parts = tile_parts(levels_by_layout[LodLayout.TILES][0] / "tileset.json")
    for level, expected in enumerate(map(in_order, plain)):
        assert all(1 <= len(part) <= CHUNK for part in parts[level])
        whole = in_order(concatenate(parts[level]))
        assert np.array_equal(whole.means, expected.means)
        assert np.array_equal(whole.sh, expected.sh)


def test_a_streamed_level_equals_the_plain_level_up_to_quantisation(levels_by_layout, plain):
    path = levels_by_layout[LodLayout.SOG][0] / "lod-meta.json"
    assert json.loads(path.read_text())["counts"] == [600, 120, 24]
    for level, expected in enumerate(plain):
        loaded = nanogs.load(path, level=level)
        assert len(loaded) == len(expected)
        fine = 0.03 * float(np.median(expected.scales()))  # positions are quantised finer than this
        for axis in range(3):  # quantisation changes the order of the splats
            found, target = np.sort(loaded.means[:, axis]), np.sort(expected.means[:, axis])
            assert np.abs(found - target).max() < fine


def test_blocks_with_few_remaining_splats_share_files(levels_by_layout, scene, tmp_path):
    """No file has fewer splats than the minimum of a chunk, unless its whole level has fewer."""
    path = levels_by_layout[LodLayout.SOG][0] / "lod-meta.json"
    for level, counts in counts_by_file(path).items():
        assert min(counts) >= min(CHUNK // 4, sum(counts)), level
        assert max(counts) <= 4 * CHUNK
    write(scene, tmp_path / "fewer", LodLayout.SOG, chunk_min=30)
    found = counts_by_file(tmp_path / "fewer" / "lod-meta.json")
    assert [sum(counts) for counts in found.values()] == [600, 120, 24]
    assert min(found[0]) >= min(found[1]) >= 30
    assert found[2] == [24]


def counts_by_file(path):
    """Return the splat counts of the files by level; the tree must cover each row exactly once."""
    meta, spans = json.loads(path.read_text()), {}
    for leaf in leaves(meta["tree"]):
        for level, entry in leaf["lods"].items():
            key = int(level), entry["file"]
            spans.setdefault(key, []).append((entry["offset"], entry["count"]))
    found = {}
    for (level, file), spans_of_file in sorted(spans.items()):
        ends = list(itertools.accumulate(count for _, count in sorted(spans_of_file)))
        assert [offset for offset, _ in sorted(spans_of_file)] == [0, *ends[:-1]]
        assert ends[-1] == io.inspect(path.parent / meta["filenames"][file]).splats
        found.setdefault(level, []).append(ends[-1])
    return found


@given(counts=st.lists(st.integers(0, 20), min_size=1, max_size=40), fewest=st.integers(0, 30))
def test_blocks_are_grouped_until_each_group_has_enough_splats(counts, fewest):
    groups = group_blocks(counts, fewest)
    assert [number for group in groups for number in group] == list(range(len(counts)))
    if fewest == 0:
        assert len(groups) == len(counts)
    for group in groups:
        held = [counts[number] for number in group]
        assert sum(held) >= min(fewest, sum(counts))
        assert len(groups) == 1 or sum(held) <= 2 * fewest + max(held)


def test_plain_levels_can_be_written_in_any_format(scene, tmp_path, plain):
    manifest, _ = write(scene, tmp_path / "levels", LodLayout.FILES, suffix=".spz")
    assert [level.file for level in manifest.levels] == [f"level_{n}.spz" for n in range(3)]
    for level, expected in zip(manifest.levels, plain, strict=True):
        nanogs.save(expected, tmp_path / level.file)
        written = (tmp_path / "levels" / level.file).read_bytes()
        assert written == (tmp_path / level.file).read_bytes()
        assert level.sha256 == hashlib.sha256(written).hexdigest()


def test_the_planner_decides_between_memory_and_blocks(tmp_path):
    nanogs.save(random_splats(100_000, degree=0), tmp_path / "a.ply")
    options = {"preset": "fast", "rounds": 0, "threads": 1}
    _, [whole] = nanogs.write_levels(tmp_path / "a.ply", tmp_path / "whole", [0.01], **options)
    assert (whole.blocks, whole.read_count) == (None, 100_000)
    options["max_memory"] = "240MB"
    manifest, [report] = nanogs.write_levels(
        [tmp_path / "a.ply"], tmp_path / "l", [0.01], layout="3d tiles", chunk=100, **options
    )
    assert report.blocks.blocks > 1
    assert (manifest.source, manifest.levels[0].count) == ("a.ply", 1000)
    with pytest.raises(
        NotEnoughMemoryError, match=r"Measuring takes about .* leave out the measurement"
    ):
        nanogs.write_levels(tmp_path / "a.ply", tmp_path / "m", [0.01], measured=True, **options)
    assert not (tmp_path / "m.job").exists()  # refused before any work begins
    with pytest.raises(OptionError, match="job is for files"):
        nanogs.write_levels(random_splats(9), tmp_path / "m", [0.5], job=tmp_path / "j", **options)
    with pytest.raises(NotEnoughMemoryError):
        nanogs.write_levels(nanogs.open(tmp_path / "a.ply"), tmp_path / "m", [0.01], **options)


def test_levels_too_large_for_formats_that_are_written_whole_are_refused(tmp_path):
    def refuse(count, **given):
        sink = levels_folder.LevelsFolder(tmp_path / "l", overwrite=False, source="a", **given)
        sink.refuse_large(count, 200, 10**8)

    for options in ({}, {"suffix": ".spz"}, {"block_layout": Tiles(100)}):
        refuse(10**6, **options)
    refuse(10**5 // 2, suffix=".sog")  # palettes take seven times as much, and fit
    with pytest.raises(
        OptionError, match=r"\.sog is not written block by block, .*; leave the for"
    ):
        refuse(10**6, suffix=".sog")
    with pytest.raises(OptionError, match=r"\.spz with a palette is not written block by block"):
        refuse(10**6, suffix=".spz", format_options={"palette": 256})


def test_geometric_errors_have_one_scale_for_the_whole_scene(levels_by_layout):
    """Errors follow from the splats alone, not from the block that a tile belongs to."""
    path = levels_by_layout[LodLayout.TILES][0] / "tileset.json"
    blocks, errors = set(), {0: [], 1: [], 2: []}
    for tile, parent in tiles(path):
        inner = tile.get("children", [])
        if parent:
            assert tile["geometricError"] <= parent["geometricError"]
            low, high = corners(parent)
            assert (corners(tile)[0] >= low - 1e-9).all()
            assert (corners(tile)[1] <= high + 1e-9).all()
        if "content" not in tile:
            continue
        level, block, _ = tile["content"]["uri"].split("_")
        blocks.add(block)
        part = io.load(path.parent / tile["content"]["uri"])
        tile_error = 4 * float(np.median(part.scales().max(axis=1))) if inner else 0
        expected = max([tile_error, *(child["geometricError"] for child in inner)])
        assert tile["geometricError"] == pytest.approx(expected)
        errors[int(level)].append(tile["geometricError"])
        assert all(level_of(c) == int(level) - 1 for c in inner if "content" in c)
    assert len(blocks) > 2
    assert 0 == np.mean(errors[0]) < np.mean(errors[1]) < np.mean(errors[2])


def test_the_streamed_tree_is_binary_and_covers_every_row_once(levels_by_layout):
    path = levels_by_layout[LodLayout.SOG][0] / "lod-meta.json"
    meta = json.loads(path.read_text())
    assert_binary(meta["tree"])
    spans = {}
    for leaf in leaves(meta["tree"]):
        assert 1 <= leaf["lods"]["0"]["count"] <= CHUNK
        for level, entry in leaf["lods"].items():
            name = meta["filenames"][entry["file"]]
            assert name.startswith(f"{level}_")
            spans.setdefault(name, []).append((entry["offset"], entry["count"]))
    assert set(spans) == set(meta["filenames"])
    for name, each in spans.items():
        ends = [0, *itertools.accumulate(count for _, count in sorted(each))]
        assert [offset for offset, _ in sorted(each)] == ends[:-1]
        assert ends[-1] == io.inspect(path.parent / name).splats <= 4 * CHUNK


@pytest.mark.filterwarnings("default")  # the driver's own warnings are not ours
def test_supersplat_streams_levels_that_were_made_in_blocks(levels_by_layout, tmp_path):
    """SuperSplat loads the coarsest level first, and in the end every file of the finest."""
    path = levels_by_layout[LodLayout.SOG][0] / "lod-meta.json"
    pixels, requested = render_in_supersplat(path, tmp_path, 600)
    names = json.loads(path.read_text())["filenames"]
    assert {f"scene/{name}" for name in names if name.startswith("0_")} <= set(requested)
    assert requested[1].startswith("scene/2_")
    assert (pixels.max(axis=2) > 0.16).mean() > 0.05


@pytest.mark.parametrize("layout", [LodLayout.SOG, LodLayout.TILES])
@pytest.mark.parametrize("ratios", [(0.5, 0.005, 0.0001), (0.004, 0.0001), (1.0,)])
def test_very_small_and_full_ratios_give_the_requested_counts(scene, tmp_path, layout, ratios):
    """Some blocks keep fewer splats than their forest can be cut to, or none at all."""
    folder = tmp_path / "levels"
    manifest, _ = write(scene, folder, layout, ratios=ratios)
    expected = [int(np.ceil(1200 * ratio)) for ratio in ratios]
    assert [level.count for level in manifest.levels] == expected
    if layout is LodLayout.SOG:
        found = [len(nanogs.load(folder / "lod-meta.json", level=n)) for n in range(len(ratios))]
    else:
        path = folder / "tileset.json"
        for tile, _ in tiles(path):
            assert ("children" in tile) == (tile["geometricError"] > 0)
        parts = tile_parts(path)
        found = [sum(map(len, parts[level])) for level in range(len(ratios))]
    assert found == expected


def test_coarse_splats_may_be_in_blocks_without_splats_of_the_finest_level(tmp_path):
    """With seed 9, one of the two coarse splats is in a block with none of the three finer ones."""
    nanogs.save(random_splats(1200, degree=0, seed=9), tmp_path / "a.ply")
    options = {"ratios": (0.0021, 0.0012)}
    packed, _ = write(tmp_path / "a.ply", tmp_path / "p", LodLayout.TILES, plain=False, **options)
    assert [level.count for level in packed.levels] == [3, 2]
    write(tmp_path / "a.ply", tmp_path / "t", LodLayout.TILES, **options)
    parts = tile_parts(tmp_path / "t" / "tileset.json")
    assert [sum(map(len, parts[level])) for level in range(2)] == [3, 2]


def test_a_coarser_tile_is_never_smaller_than_the_finer_tile_below():
    """Merging can move more splats into cells than the finer level had: its tile is not divided."""
    cells = divide(np.arange(12.0).reshape(4, 3), 2)
    counts = np.array([[1, 1], [2, 1]])
    assert cells.cut(counts[0], 2, cells.all_leaves()) == [0]
    assert cells.cut(counts[1], 2, frozenset([0])) == [0]
    assert cells.cut(counts[1], 2, cells.all_leaves()) == [1, 2]


def test_data_that_are_left_out_are_noted_once_for_all_blocks(tmp_path):
    label = {"label": np.arange(900, dtype=np.int32)}
    splats = random_splats(900, extras=label)
    splats.log_scales[:] = 6.5
    nanogs.save(splats, tmp_path / "a.ply")
    manifest, _ = write(
        tmp_path / "a.ply", tmp_path / "t", LodLayout.TILES, plain=False, ratios=[0.5]
    )
    assert sum("label" in note for note in manifest.notes) == 1
    assert any(note.startswith("450 splats have log-scales") for note in manifest.notes)


# Interrupted jobs, workers


@pytest.mark.parametrize("layout", [LodLayout.SOG, LodLayout.TILES])
def test_resuming_a_job_that_crashed_anywhere_gives_the_same_bytes(
    scene, tmp_path, levels_by_layout, layout, monkeypatch
):
    folder, events = tmp_path / "levels", []
    move = levels_folder.move_folder

    def move_then_crash(*args, **options):
        move(*args, **options)
        if events.count("moved") < 1:
            events.append("moved")
            raise CrashError  # the folder has its final name, but its job is not removed yet

    monkeypatch.setattr(scale_run, "do", crash_at(stages.do, events, 1, 5, 20, 31, 46, 57))
    filling = levels_folder.ChunksFilling
    monkeypatch.setattr(filling, "_write", crash_at(filling._write, events, 1, 5))
    monkeypatch.setattr(levels_folder, "move_folder", move_then_crash)
    for _ in range(20):
        try:
            write(scene, folder, layout, resume=True)
            break
        except CrashError:
            assert (tmp_path / "levels.job" / MANIFEST).exists()
            assert folder.exists() == ("moved" in events)
    assert events.count("crash") == 8
    assert "moved" in events
    assert files(folder) == files(levels_by_layout[layout][0])
    assert [path.name for path in tmp_path.iterdir()] == ["levels"]


def test_levels_that_changed_after_they_were_moved_are_not_the_finished_ones(
    scene, tmp_path, monkeypatch
):
    def crash(*_):
        raise CrashError

    with monkeypatch.context() as patch:
        patch.setattr("nanogs.pipeline.job.stored.BlockJob._remove", crash)
        with pytest.raises(CrashError):
            write(scene, tmp_path / "levels", LodLayout.TILES)
    tile = max((tmp_path / "levels").glob("*.glb"))
    tile.write_bytes(tile.read_bytes()[:-1])
    with pytest.raises(OutputError, match="exists"):
        write(scene, tmp_path / "levels", LodLayout.TILES, resume=True)


def test_a_job_is_not_resumed_with_another_layout_or_chunk_size(scene, tmp_path):
    def crash(step):
        if step.stage == "chunk":
            raise CrashError

    with pytest.raises(CrashError):
        write(scene, tmp_path / "levels", LodLayout.SOG, progress=crash)
    for options in ({"layout": LodLayout.TILES}, {"layout": LodLayout.SOG, "chunk": 61}):
        with pytest.raises(OutputError, match=r"differs: how levels .* Earth\)"):
            write(scene, tmp_path / "levels", resume=True, **options)


def test_folders_with_foreign_files_are_not_replaced(scene, tmp_path):
    folder = tmp_path / "levels"
    write(scene, folder, LodLayout.TILES, ratios=[0.1])
    with pytest.raises(OutputError, match="overwrite=True"):
        write(scene, folder, LodLayout.SOG)
    write(scene, folder, LodLayout.SOG, overwrite=True)
    assert not (folder / "tileset.json").exists()
    (folder / "mine.txt").write_text("mine")
    before = files(folder)
    with pytest.raises(OutputError, match="mine"):
        write(scene, folder, LodLayout.TILES, overwrite=True)
    assert files(folder) == before
    assert [path.name for path in tmp_path.iterdir()] == ["levels"]


@pytest.fixture
def elsewhere(tmp_path):
    """A folder on another file system."""
    folders = [path for path in map(Path, ("/dev/shm", "/var/tmp")) if path.is_dir()]
    others = [path for path in folders if path.stat().st_dev != tmp_path.stat().st_dev]
    if not others:
        pytest.skip("there is no other file system")
    with tempfile.TemporaryDirectory(dir=others[0]) as folder:
        yield Path(folder)


@pytest.mark.parametrize("layout", [LodLayout.TILES, LodLayout.SOG])
def test_the_job_folder_may_be_on_another_file_system(
    scene, tmp_path, elsewhere, levels_by_layout, layout
):
    write(scene, tmp_path / "levels", layout, job=elsewhere / "job")
    assert list(elsewhere.iterdir()) == []
    assert files(tmp_path / "levels") == files(levels_by_layout[layout][0])
    assert [path.name for path in tmp_path.iterdir()] == ["levels"]


def test_a_disk_that_is_full_when_the_folder_is_moved_is_named_once(
    scene, tmp_path, elsewhere, monkeypatch
):
    tried = []

    def full(_source, target):
        tried.append(target)
        raise OSError(errno.ENOSPC, "No space left on device", str(target))

    monkeypatch.setattr(shutil, "copy2", full)
    with pytest.raises(OutputError) as caught:
        write(scene, tmp_path / "levels", LodLayout.TILES, job=elsewhere / "job")
    place = tmp_path / "levels"
    assert (
        str(caught.value) == f"{place}: the disk or quota is full; free some space and run again."
    )
    assert len(tried) == 1
    assert list(tmp_path.iterdir()) == []
    monkeypatch.undo()
    write(scene, place, LodLayout.TILES, job=elsewhere / "job", resume=True)
    assert list(elsewhere.iterdir()) == []


def test_file_names_cannot_lead_out_of_the_folder(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    sink = levels_folder.LevelsFolder(
        tmp_path / "levels", overwrite=False, source="a.ply", block_layout=Tiles(100)
    )
    with pytest.raises(FormatError, match="mine"):
        sink.open(tmp_path / "made", {}).add_blocks(
            [BlockChunks({}, 1, (), [("../mine.txt", b"theirs")])]
        )
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_a_folder_holds_only_what_the_last_attempt_made(tmp_path):
    """All its files are listed, for a resumed job to find out whether they are in place."""
    sink = levels_folder.LevelsFolder(
        tmp_path / "levels", overwrite=False, source="a.ply", block_layout=Tiles(20)
    )
    splats = random_splats(50, degree=0)
    report = nanogs.simplify(splats, ratio=1, preset="fast")[1]
    for count in (50, 15):  # the first attempt has more files
        filling = sink.open(tmp_path / "made", {})
        filling.add(splats.take(np.arange(count)))
        filling.finish([report])
    names = sink.files(tmp_path / "made")
    assert names == ("tileset.json", "0_0.glb")
    assert sorted(files(tmp_path / "made")) == sorted(names)
    (tmp_path / "levels").mkdir()
    shutil.copy(tmp_path / "made" / "tileset.json", tmp_path / "levels")  # appears meanwhile
    with pytest.raises(OutputError, match="exists"):
        sink.move(tmp_path / "made")


def test_a_tile_is_not_divided_again_at_any_coarser_level(tmp_path):
    sink = levels_folder.LevelsFolder(
        tmp_path / "levels", overwrite=False, source="a.ply", block_layout=Tiles(8)
    )
    splats = random_splats(16, degree=0)
    report = nanogs.simplify(splats, ratio=1, preset="fast")[1]
    with sink.filled() as filling:
        for rows in (np.arange(16), np.arange(8), np.arange(12)):  # the last has more again
            filling.add(splats.take(rows))
        assert filling.names == [["0_0.glb", "0_1.glb"], ["1_0.glb"], ["2_0.glb"]]
        filling.finish([report] * 3)


@pytest.mark.filterwarnings("ignore")
def test_workers_make_the_same_bytes(scene, tmp_path, levels_by_layout):
    distributed = pytest.importorskip("distributed")
    with distributed.Client(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None,
        set_as_default=False,
    ) as client:  # fmt: skip
        write(scene, tmp_path / "levels", LodLayout.TILES, executor=client)
    assert files(tmp_path / "levels") == files(levels_by_layout[LodLayout.TILES][0])


# Memory


def test_the_memory_limit_bounds_the_size_of_blocks_and_chunks():
    layout = Columns(3, False, (), "default", (), ())

    def plan(max_memory, chunks):
        return plan_blocks(10**7, layout, PRESETS["fast"], (0.5,), max_memory, None, chunks)

    plain, small, large = (
        plan(500_000_000, chunks) for chunks in (None, StreamedSog(2000), StreamedSog(32_768))
    )
    assert large.block < small.block <= plain.block
    assert max(large.memory, small.memory, plain.memory) <= 500_000_000
    assert plain.seconds < large.seconds
    assert plan(10**9, Tiles(32_768, packed=False)).block == plan(10**9, None).block
    with pytest.raises(OptionError, match="a smaller `chunk`"):
        plan(300_000_000, StreamedSog(32_768))
    with pytest.raises(OptionError, match="a larger `chunk`"):
        plan(500_000_000, Tiles(100, packed=False))


def test_the_memory_for_files_follows_the_largest_level_and_file():
    row, chunks = 236, StreamedSog(1000, 250)  # a file has four chunks at most

    def planned(splats, *shares):
        return chunks.encoding(row, 3, splats, shares)

    assert planned(3000, 0.1, 1).file == planned(3000, 1, 0.1).file == planned(3000, 1).file
    assert planned(10**6, 1).file == planned(4000, 1).file
    assert planned(4000, 1).file - planned(2000, 1).file > 2000 * row
    assert planned(1, 1).file > 10**7  # the libraries
    assert planned(10**6, 1).joined > 250 * row
    assert Tiles(1000).encoding(row, 3, 10**6, (1,)).joined == 0


# The command


def test_the_command_makes_streamed_levels_in_blocks(tmp_path):
    scene = tmp_path / "scene.ply"
    nanogs.save(random_splats(200_000, degree=0), scene)
    path = tmp_path / "web" / "lod-meta.json"
    options = ["--levels", "0.05,0.001", "--preset", "fast", "--chunk", "2000"]
    options += ["--max-memory", "250MB"]
    planned = json.loads(run("lod", scene, path, *options, "--dry-run", "--json").stdout)
    assert planned["blocks"]["blocks"] > 1
    assert planned["blocks"]["memory"] <= 250_000_000
    plan = run("lod", scene, tmp_path / "web" / "tileset.json", *options, "--dry-run").stderr
    assert "of at most" in plan
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene.ply"]
    result = run("lod", scene, path, *options, "--json", "--threads", "1")
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert [level["count"] for level in report["levels"]] == [10_000, 200]
    assert (report["output"], report["layout"]) == (str(path), "streamed sog")
    assert report["reports"][0]["blocks"]["blocks"] > 1
    assert path.exists()
    assert {entry.name for entry in tmp_path.iterdir()} == {"scene.ply", "web"}


# Borders


def coverage(splats, size=160):
    """Render a wall from the front, all white, without its margins: the opacity of each pixel."""
    from nanogs.raster.camera import Camera
    from nanogs.raster.rendering import prepare, render

    pose = np.eye(4)
    pose[2, 3] = 2.0
    camera = Camera(size, size, float(size), float(size), size / 2, size / 2, pose)
    white = np.full((len(splats), 1, 3), 0.5 / 0.28209479, np.float32)
    shown = nanogs.Splats(
        splats.means, splats.log_scales, splats.quats, splats.opacity_logits, white
    )
    return render(prepare(shown), camera).shown()[12:-12, 12:-12, 0]


@pytest.mark.parametrize("rounds", [0, 2])
def test_no_gap_opens_between_blocks(tmp_path, rounds):
    """Neither within a level nor where blocks of two levels meet, as happens in viewers."""
    original = wall()
    nanogs.save(original, tmp_path / "wall.ply")
    ratios, folder = (0.3, 0.05), tmp_path / "levels"
    write(tmp_path / "wall.ply", folder, LodLayout.TILES, ratios=ratios, block=2600, rounds=rounds)
    parts = {}
    for path in folder.glob("*.glb"):
        level, block, _ = path.stem.split("_")
        parts.setdefault((int(level), int(block)), []).append(nanogs.load(path))
    blocks = 1 + max(block for _, block in parts)
    assert blocks >= 4
    levels = [
        coverage(concatenate([p for b in range(blocks) for p in parts[level, b]]))
        for level in range(2)
    ]
    whole = [
        coverage(small)
        for small, _ in nanogs.levels(original, ratios, preset="fast", rounds=rounds)
    ]
    for in_blocks, other in zip(levels, whole, strict=True):
        assert in_blocks.min() > other.min() - 0.05
        assert np.quantile(in_blocks, 0.01) > np.quantile(other, 0.01) - 0.02
    for fine in range(blocks):
        mixed = [p for b in range(blocks) for p in parts[int(b != fine), b]]
        shown = coverage(concatenate(mixed))
        assert shown.min() > min(whole[0].min(), whole[1].min()) - 0.1
        assert np.quantile(shown, 0.01) > np.quantile(whole, 0.01, axis=(1, 2)).min() - 0.03
