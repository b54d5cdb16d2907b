"""3D Tiles: structure, frame, contents, and the checks of other tools."""

import hashlib
import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

import nanogs
from builders import random_splats
from conftest import scene_path
from launch import run
from nanogs import io
from nanogs.errors import OutputError
from nanogs.levels_of_detail import write_levels
from nanogs.lod.cells import divide
from nanogs.lod.chunks import ChunkTree
from nanogs.lod.folder import LevelsFolder, made_files
from nanogs.lod.layout import LodLayout
from nanogs.lod.tiles import Tiles
from nanogs.lod.tileset import describe
from nanogs.splats import RenderMode
from nanogs.threads import most_threads, use_threads
from npm_packages import node, package

RATIOS = (0.5, 0.1, 0.02)
CHUNK = 60
PREFIX = "KHR_gaussian_splatting"
PACKED = f"{PREFIX}_compression_spz_2"


@pytest.fixture(scope="module")
def splats():
    return random_splats(900, degree=1)


@pytest.fixture(scope="module", params=["plain", "spz"])
def command_tileset(request, splats, tmp_path_factory):
    """The `tileset.json` that the command writes, and the form of its contents, plain or spz."""
    folder = tmp_path_factory.mktemp("tiles")
    nanogs.save(splats, folder / "scene.ply")
    path = folder / "levels" / "tileset.json"
    options = ["--levels", "0.5,0.1,0.02", "--preset", "fast", "--chunk", CHUNK, "-q"]
    options += ["--plain"] if request.param == "plain" else []
    result = run("lod", folder / "scene.ply", path, *options)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
    return path, request.param


def write(splats, folder, ratios=RATIOS, **options):
    return write_levels(
        splats, folder, ratios, source="a.ply", preset="fast", layout=LodLayout.TILES, **options
    )


def tileset(path):
    return json.loads(path.read_text())


def tiles(path):
    """Yield every tile with its parent."""
    waiting = [(tileset(path)["root"], None)]
    while waiting:
        tile, parent = waiting.pop()
        yield tile, parent
        waiting += [(child, tile) for child in tile.get("children", [])]


def glb(path):
    """Return the JSON and the binary chunk of a file, as the glTF specification defines them."""
    data = path.read_bytes()
    magic, version, size, length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON")
    document = json.loads(data[20 : 20 + length])
    body, kind = struct.unpack_from("<I4s", data, 20 + length)
    assert (kind, 28 + length + body) == (b"BIN\0", size)
    return document, data[28 + length :]


def content(path, tile):
    """Return the splats of a tile's content, in the frame of the model."""
    return io.load(path.parent / tile["content"]["uri"])


def level_of(tile):
    return int(tile["content"]["uri"].split("_")[0])


def corners(tile):
    """Return the lowest and highest corner of a tile's box; check that it is axis-aligned."""
    box = np.array(tile["boundingVolume"]["box"])
    axes = box[3:].reshape(3, 3)
    assert (axes == np.diag(np.diag(axes))).all()
    return box[:3] - np.diag(axes), box[:3] + np.diag(axes)


def test_the_tile_tree_follows_the_specification(command_tileset):
    path, form = command_tileset
    data = tileset(path)
    assert data["asset"]["version"] == "1.1"
    assert data["extensionsUsed"] == list(data["extensions"]) == ["3DTILES_content_gltf"]
    used = [PREFIX] if form == "plain" else [PREFIX, PACKED]
    assert data["extensions"]["3DTILES_content_gltf"]["extensionsUsed"] == used
    assert "extensionsRequired" not in data
    assert data["root"]["transform"] == np.eye(4).ravel().tolist()
    assert data["root"]["refine"] == "REPLACE"
    assert data["geometricError"] >= data["root"]["geometricError"]
    for tile, parent in tiles(path):
        assert len(tile["boundingVolume"]["box"]) == 12
        assert tile.get("refine", "REPLACE") == "REPLACE"
        assert ("children" in tile) == (tile["geometricError"] > 0)
        if parent:
            assert tile["geometricError"] <= parent["geometricError"]
            assert "transform" not in tile
            assert level_of(tile) == level_of(parent) - 1
            inner, outer = corners(tile), corners(parent)
            assert (inner[0] >= outer[0] - 1e-9).all()
            assert (inner[1] <= outer[1] + 1e-9).all()
    files = {entry.name for entry in path.parent.iterdir()}
    assert files == made_files(path.parent)
    assert files == {"tileset.json"} | {tile["content"]["uri"] for tile, _ in tiles(path)}


def test_geometric_errors_are_smaller_for_finer_levels(command_tileset):
    path, _ = command_tileset
    errors = {}
    for tile, _ in tiles(path):
        errors.setdefault(level_of(tile), []).append(tile["geometricError"])
    means = [np.mean(errors[level]) for level in range(3)]
    assert 0 == means[0] < means[1] < means[2]


def test_the_tiles_of_a_level_contain_exactly_its_splats(splats, command_tileset):
    """Bit for bit if uncompressed, so that no splat is missing or duplicated."""
    path, form = command_tileset
    parts = {}
    for tile, _ in tiles(path):
        part = content(path, tile)
        assert 1 <= len(part) <= CHUNK
        parts.setdefault(level_of(tile), []).append(part)
    for level, (small, _) in enumerate(nanogs.levels(splats, RATIOS, preset="fast")):
        means = np.concatenate([part.means for part in parts[level]])
        sh = np.concatenate([part.sh for part in parts[level]])
        assert len(means) == len(small)
        order, expected = np.lexsort(means.T), np.lexsort(small.means.T)
        if form == "plain":
            assert np.array_equal(means[order], small.means[expected])
            assert np.array_equal(sh[order], small.sh[expected])
        else:
            distances, rows = cKDTree(means).query(small.means)
            assert sorted(rows) == list(range(len(means)))
            assert distances.max() < 2e-3  # of coordinates within ±1, of splats of some hundredths
            assert np.abs(sh[rows, 0] - small.sh[:, 0]).max() < 0.5 / 255 / 0.15 + 1e-6


def test_contents_are_inside_their_boxes_after_all_transforms(command_tileset):
    """Contents are transformed by the node's transform and then from y up to z up."""
    path, _ = command_tileset
    for tile, _ in tiles(path):
        document, _ = glb(path.parent / tile["content"]["uri"])
        scene_node = document["nodes"][0]
        if "matrix" in scene_node:
            turn = np.reshape(scene_node["matrix"], (4, 4)).T[:3, :3]
        else:
            assert scene_node["rotation"] == [0, 0, 1, 0]  # xyzw: half a turn about z
            turn = np.diag([-1, -1, 1])
        z_up = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # y becomes z
        part = content(path, tile)
        means = part.means @ (z_up @ turn).T
        low, high = corners(tile)
        assert (means >= low).all()
        assert (means <= high).all()
        bounds = document["accessors"][
            document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
        ]
        assert np.allclose(bounds["min"], part.means.min(axis=0), atol=1e-3)
        # The splats reach the box: three deviations along some axis of the scene.
        if level_of(tile) == 0:
            reach = 3 * part.scales().max()
            assert ((means.min(axis=0) - low) <= reach + 1e-4).all()


def test_up_of_the_model_becomes_z(tmp_path):
    """A model high above the origin, along -y in a 3DGS file, is high along z in the tileset."""
    splats = random_splats(200)
    splats.means[:, 1] -= 50
    write(splats, tmp_path / "t", ratios=[1.0])
    low, high = corners(tileset(tmp_path / "t" / "tileset.json")["root"])
    assert low[2] > 40
    assert high[2] < 60


def test_several_top_tiles_share_a_root_without_content(splats, tmp_path):
    write(splats, tmp_path / "t", ratios=[0.9, 0.5], chunk=100)
    data = tileset(tmp_path / "t" / "tileset.json")
    root = data["root"]
    assert "content" not in root
    assert len(root["children"]) > 4
    low, high = corners(root)
    diagonal = np.linalg.norm(high - low)
    assert root["geometricError"] == pytest.approx(diagonal)
    assert data["geometricError"] == root["geometricError"]
    assert {level_of(tile) for tile in root["children"]} == {1}


def laid_out(folder, layout, levels):
    """Write a tileset of the given levels, and return the path of its `tileset.json`."""
    _, report = nanogs.simplify(random_splats(20), ratio=0.5, preset="fast")
    with LevelsFolder(folder, overwrite=False, source="a.ply", block_layout=layout).filled() as out:
        for level in levels:
            out.add(level)
        out.finish([report] * len(levels))
    return folder / "tileset.json"


def test_no_tile_has_a_smaller_error_than_its_children(tmp_path):
    """A coarser level whose splats are smaller than a finer level's takes that level's error."""
    splats = random_splats(30)
    wide = replace(splats, log_scales=splats.log_scales + np.float32(3))
    root = tileset(laid_out(tmp_path / "levels", Tiles(100), (splats, wide, splats)))["root"]
    assert root["geometricError"] == root["children"][0]["geometricError"] > 10


def test_boxes_of_tiles_cover_three_standard_deviations(tmp_path):
    model = random_splats(1)
    model.means[:] = 1, 2, 3
    model.log_scales[:] = np.log([0.5, 0.1, 0.2])
    model.quats[:] = 1, 0, 0, 0
    low, high = corners(tileset(laid_out(tmp_path / "levels", Tiles(100), (model,)))["root"])
    assert (high - low) / 2 == pytest.approx([1.5, 0.6, 0.3])  # z up


class Counted:
    """An array that counts how often it is read."""

    def __init__(self, array):
        self.array, self.reads = array, 0

    def __getitem__(self, key):
        self.reads += 1
        return self.array[key]


def test_tiles_are_described_in_time_proportional_to_their_number():
    """A tile does not look at every tile of the finer level."""
    cells = divide(np.random.default_rng(1).normal(size=(500, 3)), 1)
    leaves = Counted(cells.leaves)
    box = [[0, 0, 0], [1, 1, 1]]
    level = [[node, f"{node}.glb", box, 1.0] for node in sorted(cells.all_leaves())]
    trees = [ChunkTree(replace(cells, leaves=leaves), [level, level])]
    root = json.loads(describe(trees, 2, {}))["root"]
    for tile, (_, name, *_) in zip(root["children"], level, strict=True):
        assert [tile["content"], *(t["content"] for t in tile["children"])] == [{"uri": name}] * 2
    assert leaves.reads <= 3 * 500


def test_a_tile_without_splats_has_no_content_but_has_children(tmp_path):
    """Merging has moved all of a coarser level's splats to one side."""
    rng = np.random.default_rng(0)
    means = rng.normal(0, 0.1, (40, 3)).astype(np.float32)
    means[20:, 0] += 10
    fine = replace(random_splats(40), means=means)
    levels = fine, fine.take(np.r_[np.arange(20), np.arange(5)]), fine.take(np.arange(10))
    path = laid_out(tmp_path / "levels", Tiles(20, packed=False), levels)
    root = tileset(path)["root"]
    assert root["content"]["uri"] == "2_0.glb"
    full, empty = sorted(root["children"], key=lambda tile: "content" not in tile)
    assert full["content"]["uri"] == "1_0.glb"
    assert "content" not in empty
    assert 0 < empty["geometricError"] <= root["geometricError"]
    assert [tile["content"]["uri"] for tile in empty["children"]] == ["0_1.glb"]
    # More than the chunk size, but all of one finer cell.
    assert len(io.load(path.parent / "1_0.glb")) == 25


@pytest.mark.skipif(most_threads() < 2, reason="this machine has one thread")
@pytest.mark.parametrize("unpacked", [False, True])
def test_same_bytes_for_any_number_of_threads(splats, tmp_path, unpacked):
    digests = []
    for threads in (1, 2):
        with use_threads(threads):
            write(splats, tmp_path / str(threads), chunk=CHUNK, threads=threads, plain=unpacked)
        files = sorted((tmp_path / str(threads)).iterdir())
        digests.append([hashlib.sha256(file.read_bytes()).digest() for file in files])
    assert digests[0] == digests[1]


def test_overwriting_replaces_only_the_files_of_a_tileset(splats, tmp_path):
    write(splats, tmp_path / "t", chunk=CHUNK)
    with pytest.raises(OutputError, match="overwrite=True"):
        write(splats, tmp_path / "t")
    write(splats, tmp_path / "t", overwrite=True)
    assert len(list((tmp_path / "t").iterdir())) == 4
    (tmp_path / "t" / "9_9.glb").write_text("mine")
    with pytest.raises(OutputError, match=r"9_9\.glb"):
        write(splats, tmp_path / "t", overwrite=True)


def test_a_modified_tileset_never_names_files_elsewhere_as_its_own(tmp_path):
    data = {
        "asset": {"extras": {"generator": "nanogs 1"}},
        "root": {
            "content": {"uri": "../mine.glb"},
            "children": [{"content": {"uri": "a.glb"}, "children": 3}, 5, {"content": "b.glb"}],
        },
    }
    (tmp_path / "tileset.json").write_text(json.dumps(data))
    assert made_files(tmp_path) == {"tileset.json", "a.glb"}
    data["asset"]["extras"] = "nanogs"
    (tmp_path / "tileset.json").write_text(json.dumps(data))
    assert made_files(tmp_path) is None


@pytest.mark.parametrize("unpacked", [False, True])
def test_notes_name_what_is_left_out(tmp_path, unpacked):
    label = {"label": np.arange(60, dtype=np.int32)}
    splats = replace(
        random_splats(60, degree=4, extras=label), comments=["mine"], render_mode=RenderMode.SURFEL
    )
    splats.log_scales[:] = 6.5
    manifest, _ = write(splats, tmp_path / "t", ratios=[0.5, 0.1], plain=unpacked)
    notes = " ".join(manifest.notes)
    if not unpacked:
        assert "  30 splats have log-scales" in "  ".join(manifest.notes)
        assert "  Level 1: 6 splats have log-scales" in "  ".join(manifest.notes)
    for word in ("label", "comment", "degree 3"):
        assert word in notes
    assert ("log-scales" in notes) == ("render mode" in notes) == (not unpacked)


def test_packed_contents_name_the_attributes_of_the_draft(command_tileset):
    path, form = command_tileset
    document, body = glb(path.parent / "2_0.glb")
    primitive = document["meshes"][0]["primitives"][0]
    if form == "plain":
        assert "extensionsRequired" not in document
        return
    assert document["extensionsRequired"] == document["extensionsUsed"] == [PREFIX, PACKED]
    assert primitive["extensions"][PREFIX]["extensions"][PACKED] == {"bufferView": 0}
    names = [f"{PREFIX}:SH_DEGREE_1_COEF_{n}" for n in range(3)]
    expected = ["POSITION", "COLOR_0", f"{PREFIX}:ROTATION", f"{PREFIX}:SCALE", *names]
    assert list(primitive["attributes"]) == expected
    assert {accessor["count"] for accessor in document["accessors"]} == {18}
    assert not any("bufferView" in accessor for accessor in document["accessors"])
    assert body[:2] == b"\x1f\x8b"  # gzip: SPZ up to version 3


def test_the_khronos_validator_finds_no_fault(command_tileset):
    """The validator does not know the extension yet, and so neither its attribute names."""
    package("gltf-validator")
    path, _ = command_tileset
    script = (
        "const fs = require('fs'), v = require('gltf-validator');"
        "Promise.all(process.argv.slice(1).map(f => v.validateBytes("
        "new Uint8Array(fs.readFileSync(f)), {maxIssues: 0})))"
        ".then(all => console.log(JSON.stringify(all.map(r => r.issues.messages))))"
    )
    reports = json.loads(node(script, *sorted(path.parent.glob("*.glb"))))
    assert len(reports) > 10
    for issues in reports:
        other = [
            issue["code"]
            for issue in issues
            if not issue["pointer"].split("/")[-1].startswith(PREFIX)
        ]
        # To the validator, data that only the extension refers to are unused.
        assert set(other) <= {"UNSUPPORTED_EXTENSION", "UNUSED_OBJECT"}


def test_a_real_scene_keeps_its_counts_in_tiles(tmp_path):
    model = io.load(scene_path("biker.compressed.ply"))
    manifest, reports = write(model, tmp_path / "biker", ratios=[0.5, 0.1, 0.01], plain=True)
    counts = dict.fromkeys(range(3), 0)
    for tile, _ in tiles(tmp_path / "biker" / "tileset.json"):
        info = io.inspect(tmp_path / "biker" / tile["content"]["uri"])
        counts[level_of(tile)] += info.splats
    assert list(counts.values()) == [report.achieved_count for report in reports]
    assert list(counts.values()) == [76_373, 15_275, 1_528]
    assert [len(level.files) for level in manifest.levels] == [4, 1, 1]
