"""Reading 3D Tiles: those that nanogs wrote, and other trees as a viewer draws them."""

import json
from dataclasses import replace

import numpy as np
import pytest

import nanogs
from builders import random_splats
from launch import run
from nanogs import io
from nanogs.errors import FormatError, OptionError
from nanogs.io.gltf import read as gltf
from nanogs.levels_of_detail import write_levels
from nanogs.lod.layout import LodLayout

RATIOS = (0.5, 0.1, 0.02)
BOX = {"box": [0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1]}


@pytest.fixture(scope="module")
def splats():
    return random_splats(900, degree=1)


@pytest.mark.parametrize("unpacked", [True, False])
def test_levels_that_nanogs_wrote_are_read_back(splats, tmp_path, unpacked):
    options = {"source": "a", "preset": "fast", "layout": LodLayout.TILES, "chunk": 100}
    write_levels(splats, tmp_path / "t", RATIOS, plain=unpacked, **options)
    path = tmp_path / "t" / "tileset.json"
    for level, (small, _) in enumerate(nanogs.levels(splats, RATIOS, preset="fast")):
        again, expected = io.load(path, level=level), small
        assert len(again) == len(small)
        # Centres are rounded by the size of their splats, so sorting does not match the rows.
        distances = np.linalg.norm(again.means[:, None] - expected.means, axis=2)
        nearest = distances.argmin(axis=0)
        assert np.array_equal(np.sort(nearest), np.arange(len(small)))
        assert distances.min(axis=0).max() < (1e-9 if unpacked else 2e-3)
        again = again.take(nearest)
        step = 0.5 / 255 / 0.15 + 1e-6
        assert np.abs(again.sh[:, 0] - expected.sh[:, 0]).max() < (1e-9 if unpacked else step)
        assert any(f"Level {level} of 3 was read" in note for note in again.notes)
    with pytest.raises(OptionError, match="levels 0 to 2; level 3"):
        io.load(path, level=3)
    info = io.inspect(path)
    assert (info.format, info.splats, info.sh_degree) == ("3d tiles", 450, 1)
    read = io.open(path).files
    assert info.file_bytes == sum(file.stat().st_size for file in read)
    assert {file.name[0] for file in read} == {"t", "0"}


def test_blocks_without_a_splat_of_a_level_add_none_to_it(splats, tmp_path):
    nanogs.save(splats, tmp_path / "a.ply")
    options = {
        "preset": "fast",
        "layout": LodLayout.TILES,
        "chunk": 100,
        "block": 100,
        "threads": 1,
    }
    write_levels(tmp_path / "a.ply", tmp_path / "t", (1, 0.5, 0.005), **options)
    path = tmp_path / "t" / "tileset.json"
    assert [len(io.load(path, level=level)) for level in range(3)] == [900, 450, 5]
    assert io.open(path).levels == (900, 450, 5)


def test_each_tile_is_opened_once_to_describe_a_tileset(splats, tmp_path, monkeypatch):
    options = {"source": "a", "preset": "fast", "layout": LodLayout.TILES, "chunk": 100}
    write_levels(splats, tmp_path / "t", RATIOS, **options)
    opened, open_gltf = [], gltf.open_gltf
    monkeypatch.setattr(gltf, "open_gltf", lambda path: opened.append(path) or open_gltf(path))
    source = io.open(tmp_path / "t" / "tileset.json")
    for _ in range(2):
        assert (source.info.splats, source.packed, len(source.levels)) == (450, True, 3)
        assert len(source.files) > 2
    assert sorted(opened) == sorted((tmp_path / "t").glob("*.glb"))


def test_commands_read_what_lod_packs_as_spz(splats, tmp_path):
    """The tileset, a level of it and a single tile: the same splats as SPZ files of them."""
    nanogs.save(splats, tmp_path / "a.ply")
    result = run("lod", tmp_path / "a.ply", tmp_path / "t" / "tileset.json", "--levels", "1,0.5",
                 "--preset", "fast", "--chunk", "100")  # fmt: skip
    assert result.returncode == 0, result.stderr
    one = min((tmp_path / "t").glob("0_*.glb"))
    for model, count, more in (
        (tmp_path / "t", 900, ()),
        (tmp_path / "t" / "tileset.json", 450, ("--level", "1")),
        (one, io.inspect(one).splats, ()),
    ):
        info = run("info", model)
        assert info.returncode == 0, info.stderr
        assert "gzip; columns: 1 int24" in info.stdout
        result = run("convert", model, tmp_path / "b.ply", "-w", *more)
        assert result.returncode == 0, result.stderr
        assert io.inspect(tmp_path / "b.ply").splats == count
    whole = nanogs.convert(tmp_path / "t" / "tileset.json", tmp_path / "c.ply")
    assert whole.splats == 900
    nanogs.convert(tmp_path / "a.ply", tmp_path / "a.spz")
    read, packed = nanogs.load(tmp_path / "c.ply"), nanogs.load(tmp_path / "a.spz")
    for column in ("log_scales", "opacity_logits"):
        first, second = (np.sort(getattr(each, column), axis=0) for each in (read, packed))
        assert np.allclose(first, second, atol=1e-6), column


def tile(*children, uri=None, error=1, **more):
    content = {"content": {"uri": uri}} if uri else {}
    below = {"children": list(children)} if children else {}
    return {"boundingVolume": BOX, "geometricError": error} | content | below | more


@pytest.fixture
def tileset(tmp_path):
    """A function that writes a tileset; there are models of 1, 2, 4 and 8 splats, named so."""

    def write(root, name="tileset.json"):
        path = tmp_path / name
        path.write_text(json.dumps({"asset": {"version": "1.1"}, "root": root}))
        return path

    for count in (1, 2, 4, 8):
        io.save(random_splats(count, seed=count), tmp_path / f"{count}.glb")
    return write


def counts(path):
    """Return the number of splats of each level."""
    found = []
    while True:
        try:
            found.append(len(io.load(path, level=len(found))))
        except OptionError:
            return found


def test_a_level_is_what_a_viewer_draws_down_to_that_depth(tileset):
    replacing = tile(tile(uri="1.glb"), tile(tile(uri="4.glb"), uri="2.glb"), uri="8.glb")
    assert counts(tileset(replacing)) == [5, 3, 8]
    assert counts(tileset(replacing | {"refine": "ADD"})) == [15, 11, 8]
    nested = tile(tile(tile(uri="4.glb"), uri="2.glb", refine="REPLACE"), uri="8.glb", refine="ADD")
    assert counts(tileset(nested)) == [12, 10, 8]


def test_tiles_without_contents_are_passed_through(tileset):
    assert counts(tileset(tile(tile(uri="1.glb"), tile(tile(uri="2.glb"))))) == [3, 3]
    assert counts(tileset(tile(tile(tile(uri="4.glb"), uri="2.glb"), tile(tile(uri="8.glb"))))) == [
        12,
        10,
    ]


def test_nested_tilesets_are_read_in_place_of_the_tile_that_names_them(tileset, tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "4.glb").write_bytes((tmp_path / "4.glb").read_bytes())
    tileset(tile(tile(uri="4.glb"), uri="../8.glb"), "sub/inner.json")
    with pytest.raises(FormatError, match="in the same folder or below it"):
        io.load(tileset(tile(uri="sub/inner.json")))
    tileset(tile(tile(uri="4.glb")), "sub/inner.json")
    assert counts(tileset(tile(tile(uri="sub/inner.json"), tile(uri="1.glb")))) == [5, 5]


def test_a_tile_may_have_several_contents(tileset):
    both = {"contents": [{"uri": "1.glb"}, {"url": "./2.glb?v=3"}]}
    assert counts(tileset(tile() | both)) == [3]


def test_tiles_of_different_render_modes_are_noted(tileset, tmp_path):
    path = tileset(tile(tile(uri="1.glb"), tile(uri="2.glb")))
    assert not any("render mode" in note for note in io.load(path).notes)
    mip = replace(random_splats(2), render_mode="mip")
    io.save(mip, tmp_path / "2.glb", overwrite=True)
    read = io.load(path)
    assert read.render_mode == "default"
    assert any("different render modes (default, mip)" in note for note in read.notes)


def test_notes_of_tiles_are_added_up(tileset, tmp_path):
    for count in (1, 2):
        path = tmp_path / f"{count}.glb"
        opaque = np.full(count, np.inf, np.float32)
        io.save(replace(random_splats(count), opacity_logits=opaque), path, overwrite=True)
        one, two = (np.float32(alpha).tobytes() for alpha in (1, 2))
        path.write_bytes(path.read_bytes().replace(one, two))
    read = io.load(tileset(tile(tile(uri="1.glb"), tile(uri="2.glb"))))
    assert "3 opacities are not from 0 to 1 and became NaN." in read.notes


def test_the_level_is_noted_once_whatever_the_name(tileset, tmp_path):
    path = tileset(tile(tile(uri="1.glb"), uri="8.glb"), "city_tileset.json")
    notes = nanogs.convert(path, tmp_path / "a.ply").notes
    assert notes == ("Level 0 of 2 was read; level 0 is the finest.",)


def test_the_only_level_is_not_noted(tileset, tmp_path):
    path = tileset(tile(uri="8.glb"))
    assert io.load(path).notes == nanogs.convert(path, tmp_path / "a.ply").notes == ()


def matrix(rotation, shift):
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = rotation, shift
    return whole.T.ravel().tolist()


def test_transforms_are_applied_except_the_place_on_earth(tileset, tmp_path):
    """A shift along z, up in the tileset, is one along -y in the model."""
    before = io.load(tmp_path / "2.glb")
    quarter = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # about z: x becomes y
    inner = tile(uri="2.glb", transform=matrix(np.eye(3), [0, 0, 5]))
    outer = tile(inner, transform=matrix(quarter, [0, 0, 0]))
    root = tile(outer, transform=matrix(np.eye(3), [6e6, 0, 0]))
    again = io.load(tileset(root))
    # The model's x is the tileset's -x, its y the tileset's -z, its z the tileset's -y.
    x, y, z = before.means.T
    assert again.means == pytest.approx(np.column_stack([-z, y - 5, x]), abs=1e-5)
    assert any("position of the scene on Earth was left out" in note for note in again.notes)
    assert not any("Earth" in note for note in io.load(tileset(tile(uri="1.glb"))).notes)


def test_a_place_on_earth_below_the_root_is_left_out_too(tileset, tmp_path):
    """For example in a tileset of other tilesets, each with a place of its own."""
    before = io.load(tmp_path / "2.glb").means
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "2.glb").write_bytes((tmp_path / "2.glb").read_bytes())
    tileset(tile(uri="2.glb", transform=matrix(np.eye(3), [6e6, 0, 0])), "sub/inner.json")
    away = tile(uri="2.glb", transform=matrix(np.eye(3), [6e6, 0, 3]))
    again = io.load(tileset(tile(tile(uri="sub/inner.json"), away)))
    assert np.array_equal(again.means[:2], before)
    assert again.means[2:] == pytest.approx(before - [0, 3, 0], abs=1e-5)
    assert any("position of the scene on Earth was left out" in note for note in again.notes)


def test_a_root_transform_with_a_small_shift_is_applied(tileset, tmp_path):
    before = io.load(tmp_path / "2.glb").means
    again = io.load(tileset(tile(uri="2.glb", transform=matrix(2 * np.eye(3), [0, 0, 5]))))
    assert again.means == pytest.approx(2 * before - [0, 5, 0], abs=1e-5)
    assert not any("Earth" in note for note in again.notes)


REFUSED = {
    "nothing": (tile(), "names no content"),
    "no root": (None, "root must be a JSON object"),
    "twice": (tile(tile(uri="1.glb"), tile(uri="1.glb")), "names 1.glb twice"),
    "itself": (tile(uri="tileset.json"), "names tileset.json twice"),
    "above": (tile(uri="../1.glb"), "in the same folder or below it"),
    "web": (tile(uri="https://a/1.glb"), "in the same folder or below it"),
    "old": (tile(uri="a.b3dm"), "names a.b3dm, where glTF files are needed"),
    "missing": (tile(uri="9.glb"), "9.glb: no such file"),
    "implicit": (tile(implicitTiling={}), "uses implicit tiling"),
    "refine": (tile(refine="BOTH"), "must be ADD or REPLACE"),
    "transform": (tile(tile(uri="1.glb", transform=[1, 2])), "a list of 16"),
    "flat": (
        tile(
            tile(uri="1.glb"),
            tile(uri="2.glb", transform=matrix(np.eye(3), [1, 0, 0])),
            transform=matrix(np.zeros((3, 3)), [6e6, 0, 0]),
        ),
        "flattens",
    ),
    "mirror": (
        tile(tile(uri="1.glb", transform=matrix(np.diag([-1, 1, 1]), [0, 0, 0]))),
        "mirrors or flattens",
    ),
    "children": (tile(children=[3]), "must be a JSON object"),
    "by rows": (
        tile(tile(uri="1.glb", transform=[1, 0, 0, 5, 0, 1, 0, 6, 0, 0, 1, 7, 0, 0, 0, 1])),
        "last row is not 0, 0, 0, 1, perhaps because its rows were written as columns",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_unreadable_tilesets_are_refused(tileset, name):
    root, words = REFUSED[name]
    with pytest.raises(FormatError, match=words):
        io.load(tileset(root))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("shift", [0, 1e30])
def test_transforms_that_overflow_together_are_refused(tileset, shift):
    """Each is in the range of single precision; a dozen of them are beyond double."""
    step = {"transform": matrix(1e38 * np.eye(3), [shift, 0, 0])}
    root = tile(uri="1.glb", **step)
    for _ in range(12):
        root = tile(root, **step)
    for read in (io.load, io.inspect):
        with pytest.raises(
            FormatError, match="too large after its transform and those of the tiles above it"
        ):
            read(tileset(root))


def test_save_refuses_to_write_a_tileset_and_convert_reads_one(tileset, tmp_path):
    path = tileset(tile(uri="4.glb"))
    with pytest.raises(OptionError, match="make them with `nanogs lod`"):
        io.save(random_splats(3), tmp_path / "b" / "tileset.json")
    result = run("convert", path, tmp_path / "a.ply", "--level", "0")
    assert result.returncode == 0, result.stderr
    assert len(io.load(tmp_path / "a.ply")) == 4
    assert "note:" not in result.stderr
