"""Decoding SOG: `.sog`, `meta.json` and `lod-meta.json`."""

import json
import math
import re
import struct
import zipfile

import numpy as np
import pytest

import sogfiles
from builders import random_splats
from conftest import scene_path
from damage import outcome
from launch import run as cli
from nanogs import io
from nanogs.errors import FormatError, OptionError
from nanogs.io.sog.chunks import read_chunks
from nanogs.splats import RenderMode
from strategies import assert_same
from test_convert import run

HALF = 1 / math.sqrt(2)


def load(tmp_path, described=None, **replaced):
    return io.load(sogfiles.folder(tmp_path / "m", sogfiles.files(described, **replaced)))


def test_version_2_values_computed_by_hand(tmp_path):
    model = load(tmp_path)
    e = math.e
    assert model.means[0] == pytest.approx([1 - e, 0, e - 1])
    assert model.means[1] == pytest.approx([e - 1, 0, e**2 - 1])
    code = 128 * 256 + np.array([1, 3])
    t = np.array([-1.0, 1.0]) + np.array([2, 1]) * code / 65535
    assert model.means[2, [0, 2]] == pytest.approx(np.sign(t) * (np.exp(abs(t)) - 1))
    assert model.log_scales[1].tolist() == sogfiles.RAMP[253:]
    assert model.sh[0, 0].tolist() == [sogfiles.RAMP[i] for i in (10, 20, 30)]
    assert model.opacity_logits.tolist()[:2] == [-math.inf, math.inf]
    assert model.opacity_logits[2] == pytest.approx(math.log(0.25))
    assert model.quats[0] == pytest.approx([0, HALF, -HALF, -HALF / 255], abs=1e-6)
    assert model.quats[1] == pytest.approx([HALF / 255] * 3 + [1], abs=1e-4)
    assert model.quats[2].tolist() == [1, 0, 0, 0]  # a tag that names no component
    assert model.render_mode is RenderMode.DEFAULT
    assert model.notes == ()


def test_version_1_values_computed_by_hand(tmp_path):
    model = load(tmp_path, sogfiles.meta_1())
    assert model.means[1] == pytest.approx([math.e - 1, 0, math.e**2 - 1])
    assert model.log_scales[1] == pytest.approx([-2 / 255, -2 / 255, 0])
    assert model.sh[2, 0] == pytest.approx([-1, 1 / 255, 1])
    assert model.opacity_logits == pytest.approx([-5, 5, -3])


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("degree", [1, 2, 3])
def test_palette_entries_are_looked_up_by_label(tmp_path, version, degree):
    names = ["shN_centroids.webp", "shN_labels.webp"]
    if version == 2:
        shn = {"count": 70, "bands": degree, "codebook": sogfiles.RAMP, "files": names}
    else:
        shn = {"mins": 0, "maxs": 255, "files": names}
    described = sogfiles.meta(shN=shn) if version == 2 else sogfiles.meta_1(shN=shn)
    replaced = sogfiles.palette(degree, 70) | {"shN_labels.webp": sogfiles.webp([[0], [1], [69]])}
    path = sogfiles.folder(tmp_path, sogfiles.files(described, **replaced))
    model, info = io.load(path), io.inspect(path)
    assert model.sh_degree == info.sh_degree == degree
    book = np.array(sogfiles.RAMP) if version == 2 else np.arange(256)
    for splat, entry in enumerate([0, 1, 69]):
        for coefficient, rgb in enumerate(model.sh[splat, 1:]):
            assert rgb == pytest.approx(book[[entry, entry + 1, coefficient]])


def test_zip_and_folder_give_the_same_model(tmp_path):
    contents = sogfiles.files()
    model = io.load(sogfiles.folder(tmp_path / "m", contents))
    for method in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        path = sogfiles.bundle(tmp_path / "a.SOG", contents, method)
        assert_same(model, io.load(path))
        info = io.inspect(path)
        assert (info.format, info.splats, info.sh_degree) == ("sog", 3, 0)
        assert info.file_bytes == path.stat().st_size
    assert io.inspect(tmp_path / "m" / "meta.json").file_bytes == sum(map(len, contents.values()))


@pytest.mark.parametrize(
    ("name", "mode"),
    [("default", "default"), ("antialiased", "mip"), ("2dgs", "2dgs"), ("new", "default")],
)
def test_render_mode_is_read_and_unknown_ones_are_noted(tmp_path, name, mode):
    path = sogfiles.folder(tmp_path, sogfiles.files(sogfiles.meta(model=name)))
    model = io.load(path)
    assert model.render_mode == io.inspect(path).render_mode == mode
    assert len(model.notes) == (name == "new")
    assert bool(io.inspect(path).render_tag) == (name != "new")


def test_null_in_the_codebook_is_filled(tmp_path):
    described = sogfiles.meta(scales={"codebook": [None, *range(1, 256)], "files": ["scales.webp"]})
    assert load(tmp_path, described).log_scales[0] == pytest.approx([1 - 254 / 255, 1, 2])


def test_files_other_than_those_named_are_not_read(tmp_path):
    assert_same(load(tmp_path), load(tmp_path, **{"zzz.webp": b"garbage"}))


def changed(**tables):
    """A description with fields of its tables replaced, or left out where None."""
    described = sogfiles.meta()
    for name, fields in tables.items():
        kept = {**described.get(name, {}), **fields} if isinstance(fields, dict) else fields
        described[name] = kept
    return described


FAR = [1e30, 1e30, 1e30]
REFUSED = {
    "version": (changed(version=3), "has version '3'; nanogs reads 1 and 2"),
    "version true": (changed(version=True), "has version 'True'"),
    "no count": (changed(count=None), "count must be an integer from 1"),
    "no splats": (changed(count=0), "count must be an integer from 1"),
    "half a splat": (changed(count=1.5), "count must be an integer"),
    "true": (changed(count=True), "count must be an integer"),
    "too many": (changed(count=10**9), "count must be an integer"),
    "many in a small file": (changed(count=10**8), "far more than splats can be compressed"),
    "more than the textures": (changed(count=17), "do not fit the model"),
    "table": (changed(means=[]), "means must be a JSON object"),
    "bounds": (changed(means={"mins": [0, 0]}), "mins must be a list of 3"),
    "text": (changed(means={"mins": [0, 0, "0"]}), "must hold finite numbers"),
    "NaN": (changed(means={"mins": [0, 0, math.nan]}), "must hold finite numbers"),
    "long": (changed(means={"mins": [0, 0, 10**400]}), "must hold finite numbers"),
    "far": (changed(means={"maxs": FAR}), "beyond single precision"),
    "codebook": (changed(scales={"codebook": [0.0]}), "codebook must be a list of 256"),
    "no codebook": (changed(sh0={"codebook": None}), "codebook must be a list of 256"),
    "bands": (changed(shN={"bands": 4}), "bands must be an integer from 0 to 3"),
    "no files": (changed(quats={"files": []}), "files must be a list of 1"),
    "missing": (changed(quats={"files": ["gone.webp"]}), "no such file"),
    "itself": (changed(quats={"files": ["meta.json"]}), "is no WebP file"),
    "JSON": (b"[1, 2]", "must be a JSON object"),
    "cut": (b'{"version": 2, "count"', "is no JSON or is cut short"),
    "deep": (b"[" * 100_000, "is no JSON or is cut short"),
    "empty": (b"", "is empty"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_bad_descriptions_are_refused(tmp_path, case):
    described, message = REFUSED[case]
    with pytest.raises(FormatError, match=message) as caught:
        load(tmp_path, described)
    assert str(caught.value).endswith(".")


@pytest.mark.parametrize(
    "name",
    [
        "../quats.webp",
        "/etc/passwd",
        "a/quats.webp",
        "..",
        ".",
        "",
        "C:x",
        "a\\b",
        "a\0b",
        7,
        "NUL",
        "aux.webp",
        "com1 .webp",
        "LPT².b",
        "a.",
        "a ",
    ],
)
def test_file_names_outside_the_folder_are_refused(tmp_path, name):
    (tmp_path / "quats.webp").write_bytes(sogfiles.textures()["quats.webp"])
    with pytest.raises(FormatError, match="must name a file in the same folder"):
        load(tmp_path, changed(quats={"files": [name]}))


def bomb(width, height):
    """A WebP file whose header states a size, and that has no data."""
    body = struct.pack("<BI", 0x2F, width - 1 | height - 1 << 14) + b"\0" * 8
    chunk = b"VP8L" + struct.pack("<I", len(body)) + body
    return b"RIFF" + struct.pack("<I", 4 + len(chunk)) + b"WEBP" + chunk


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (bomb(16383, 16383), "16383 x 16383 texels, which do not fit"),
        (bomb(4, 4), "cannot be decoded"),
        (sogfiles.textures()["quats.webp"][:40], "cannot be decoded"),
        (b"RIFF", "is no WebP file"),
        (sogfiles.webp([[0] * 4], lossless=False, exact=False), "is a lossy WebP file"),
        (sogfiles.textures()["quats.webp"] + b"\0" * 10**6, "larger than its texels can be"),
    ],
)
def test_bad_textures_are_refused(tmp_path, data, message):
    with pytest.raises(FormatError, match=message):
        load(tmp_path, **{"quats.webp": data})


def test_labels_beyond_the_palette_are_refused(tmp_path):
    names = ["shN_centroids.webp", "shN_labels.webp"]
    shn = {"count": 2, "bands": 1, "codebook": sogfiles.RAMP, "files": names}
    with pytest.raises(FormatError, match="beyond the palette's 2"):
        load(tmp_path, sogfiles.meta(shN=shn), **sogfiles.palette(1, 2))


@pytest.mark.parametrize("entries", [256, 257, 1 << 16])
def test_a_texture_of_the_palette_has_room_for_its_entries(tmp_path, entries):
    names = ["shN_centroids.webp", "shN_labels.webp"]
    shn = {"count": entries, "bands": 1, "codebook": sogfiles.RAMP, "files": names}
    textures = sogfiles.palette(1, 3)  # of four rows of 64 entries
    if entries == 256:
        assert load(tmp_path, sogfiles.meta(shN=shn), **textures).sh_degree == 1
        return
    with pytest.raises(FormatError, match="has 192 x 4 texels, which do not fit the model"):
        load(tmp_path, sogfiles.meta(shN=shn), **textures)


def test_a_texture_of_the_palette_beyond_the_largest_label_is_refused(tmp_path):
    names = ["shN_centroids.webp", "shN_labels.webp"]
    shn = {"count": 3, "bands": 1, "codebook": sogfiles.RAMP, "files": names}
    textures = sogfiles.palette(1, 3) | {"shN_centroids.webp": bomb(192, 1025)}
    with pytest.raises(FormatError, match="has 192 x 1025 texels, which do not fit the model"):
        load(tmp_path, sogfiles.meta(shN=shn), **textures)


def test_zip_entries_are_checked(tmp_path):
    contents = sogfiles.files()
    del contents["quats.webp"]
    with pytest.raises(FormatError, match=r"a\.sog: quats\.webp is missing"):
        io.load(sogfiles.bundle(tmp_path / "a.sog", contents))
    contents = sogfiles.files(b"[" + b" " * (1 << 23) + b"]")
    packed = sogfiles.bundle(tmp_path / "b.sog", contents, zipfile.ZIP_DEFLATED)
    with pytest.raises(FormatError, match="too large for a description"):
        io.load(packed)
    packed = sogfiles.bundle(tmp_path / "c.sog", sogfiles.files(), zipfile.ZIP_BZIP2)
    with pytest.raises(FormatError, match="another method than deflate"):
        io.load(packed)
    (tmp_path / "d.sog").write_bytes(b"PK but no zip")
    with pytest.raises(FormatError, match="is no zip file or is cut short"):
        io.load(tmp_path / "d.sog")


@pytest.mark.parametrize("name", ["a.sog", "a.npz"])
def test_damage_is_reported_in_a_short_message(tmp_path, name):
    """Python's own message quotes a name of the length that a damaged entry states."""
    io.save(random_splats(2_000), tmp_path / name)
    data = bytearray((tmp_path / name).read_bytes())
    for offset in (m.start() for m in re.finditer(rb"PK\x03\x04", bytes(data))):
        data[offset + 26 : offset + 28] = b"\xff\x3f"
    (tmp_path / name).write_bytes(data)
    with pytest.raises(FormatError, match="is damaged") as caught:
        io.load(tmp_path / name)
    assert len(str(caught.value)) < len(str(tmp_path)) + 250


def test_damaged_bundles_give_an_error_or_a_model(tmp_path):
    rng, path = np.random.default_rng(5), tmp_path / "a.sog"
    names = ["shN_centroids.webp", "shN_labels.webp"]
    shn = {"count": 3, "bands": 1, "codebook": sogfiles.RAMP, "files": names}
    contents = sogfiles.files(sogfiles.meta(shN=shn), **sogfiles.palette(1, 3))
    outcomes = {"model": 0, "refused": 0}
    for turn in range(400):
        # Below the zip's checksums, and in the zip itself.
        name = rng.choice(sorted(contents))
        inner = contents | {str(name): flip(rng, contents[name])} if turn % 2 else contents
        sogfiles.bundle(path, inner)
        if turn % 2 == 0:
            path.write_bytes(flip(rng, path.read_bytes()))
        outcomes[outcome(path)] += 1
    assert min(outcomes.values()) > 5, outcomes


def test_large_textures_are_read_without_pillows_warning(tmp_path, monkeypatch, recwarn):
    """Pillow warns above `MAX_IMAGE_PIXELS`, and refuses twice that."""
    path = tmp_path / "a.sog"
    splats = random_splats(2000, degree=0)
    io.save(splats, path)
    monkeypatch.setattr("PIL.Image.MAX_IMAGE_PIXELS", 1500)
    assert len(io.load(path)) == 2000
    assert len(recwarn) == 0
    monkeypatch.setattr("PIL.Image.MAX_IMAGE_PIXELS", 900)
    with pytest.raises(FormatError, match="cannot be decoded"):
        io.load(path)


def flip(rng, data):
    out = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        index = int(rng.integers(len(out)))
        if rng.random() < 0.2:
            del out[index:]
            out += b"}"
        else:
            out[index] = rng.integers(256)
    return bytes(out)


def leaf(**lods):
    names = ("file", "offset", "count")
    return {"lods": {key[1:]: dict(zip(names, v, strict=True)) for key, v in lods.items()}}


@pytest.fixture
def streamed(tmp_path):
    """A writer of a manifest for level 0 in two models, level 1 in one, and an environment."""
    for name, colour in (("0_0", 1), ("0_1", 2), ("1_0", 3), ("env", 4)):
        chunk_files = {"sh0.webp": sogfiles.webp([[colour, row, 0, 255] for row in range(3)])}
        sogfiles.folder(tmp_path / name, sogfiles.files(**chunk_files))
    manifest = {
        "lodLevels": 2,
        "filenames": ["1_0/meta.json", "0_0/meta.json", "0_1/meta.json"],
        "tree": {
            "children": [
                leaf(_0=(2, 1, 2), _1=(0, 0, 2)),
                leaf(_0=(1, 0, 3)),
                {"children": [leaf(_0=(2, 0, 1))]},
            ]
        },
    }

    def write(**more):
        text = json.dumps(manifest | more)
        (tmp_path / "lod-meta.json").write_text(text)
        return tmp_path / "lod-meta.json"

    return write


def colours(model):
    return [(round(128 * r + 128), round(128 * g + 128)) for r, g, _ in model.sh[:, 0]]


def test_levels_are_read_one_at_a_time(streamed):
    path = streamed()
    finest = io.load(path)
    assert colours(finest) == [(1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (2, 2)]
    assert finest.notes == ()
    assert colours(io.load(path, level=1)) == [(3, 0), (3, 1)]
    info = io.inspect(path)
    assert (info.splats, info.format, info.sh_degree) == (6, "streamed sog", 0)
    with pytest.raises(OptionError, match="has levels 0 to 1; level 2 is not among them"):
        io.load(path, level=2)
    result = run(path, path.parent / "coarse.ply", "--level", "1")
    assert result.returncode == 0, result.stderr
    assert "note: Level 1 of 2 was read; level 0 is the finest." in result.stderr
    assert colours(io.load(path.parent / "coarse.ply")) == [(3, 0), (3, 1)]


def test_rows_of_regions_are_those_of_the_level_that_is_read(streamed):
    """The tree may name the regions in any order; a level is read file by file."""
    box = {"bound": {"min": [0, 0, 0], "max": [1, 2, 3]}}
    leaves = [leaf(_0=(2, 1, 2), _1=(0, 0, 2)), leaf(_0=(1, 0, 3)), leaf(_0=(2, 0, 1))]
    path = streamed(tree={"children": [each | box for each in leaves]})
    found = read_chunks(path)
    assert found.starts.tolist() == [[4, 0], [0, 0], [3, 0]]
    assert found.counts.tolist() == [[2, 2], [3, 0], [1, 0]]
    assert colours(io.load(path))[4:] == [(2, 1), (2, 2)]


@pytest.mark.parametrize("bundled", [False, True], ids=["folder", ".sog"])
def test_the_environment_belongs_to_every_level(streamed, tmp_path, bundled):
    if bundled:
        sogfiles.bundle(tmp_path / "sky.sog", sogfiles.files())
    path = streamed(environment="sky.sog" if bundled else "env/meta.json")
    sky = [(10, 20), (40, 50), (0, 128)] if bundled else [(4, 0), (4, 1), (4, 2)]
    assert colours(io.load(path, level=1)) == [(3, 0), (3, 1), *sky]
    with io.open(path) as source:
        assert (source.count, source.levels, source.environment) == (9, (9, 5), 3)
        assert colours(source.read(5, 8)) == [(2, 2), *sky[:2]]
        named = {str(file.relative_to(tmp_path)) for file in source.files}
    assert ("sky.sog" if bundled else "env/sh0.webp") in named
    shown = json.loads(cli("info", path, "--json").stdout)
    assert (shown["splats"], shown["levels"], shown["environment"]) == (9, [9, 5], 3)
    assert "3 of the splats of every level" in cli("info", path).stdout
    assert run(path, tmp_path / "all.ply").returncode == 0
    assert colours(io.load(tmp_path / "all.ply"))[-3:] == sky


def test_a_model_without_levels_has_only_level_0(tmp_path):
    io.save(random_splats(3), tmp_path / "a.ply")
    assert len(io.load(tmp_path / "a.ply", level=0)) == 3
    with pytest.raises(OptionError, match="has no levels of detail, so there is no level 1"):
        io.load(tmp_path / "a.ply", level=1)
    result = run(tmp_path / "a.ply", tmp_path / "b.ply", "--level", "1")
    assert result.returncode == 2
    assert "no level 1" in result.stderr
    assert not (tmp_path / "b.ply").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"filenames": ["1_0/meta.json", "../0_0/meta.json", "0_1/meta.json"]}, "below its own"),
        ({"filenames": ["1_0/meta.json", "/etc/x/meta.json", "0_1/meta.json"]}, "below its own"),
        ({"filenames": ["1_0/meta.json", 5, "0_1/meta.json"]}, "below its own"),
        ({"filenames": ["1_0/meta.json"]}, "file must be an integer from 0 to 0"),
        ({"filenames": ["1_0/meta.json", "gone/meta.json", "0_1/meta.json"]}, "no such file"),
        ({"filenames": ["0_0/meta.json", "0_1/meta.json", "0_1/meta.json"]}, "names a file twice"),
        ({"lodLevels": 1}, "lods must be an integer from 0 to 0"),
        ({"lodLevels": 0}, "lodLevels must be an integer"),
        ({"version": 2}, "newer version"),
        ({"tree": None}, "tree must be a JSON object"),
        ({"tree": {}}, "has no splats of level 0"),
        ({"tree": leaf(_x=(0, 0, 1))}, "lods must be an integer"),
        ({"tree": leaf(**{"_" + "9" * 5000: (0, 0, 1)})}, "lods must be an integer"),
        ({"tree": leaf(_0=(0, 0, 9))}, "fewer than its lod-meta.json says"),
        ({"tree": {"children": [leaf(_0=(0, 0, 2)), leaf(_0=(0, 1, 2))]}}, "twice in a level"),
        ({"environment": "../env/meta.json"}, "environment must name files below its own"),
        ({"environment": "https://a.b/meta.json"}, "environment must name files below its own"),
        ({"environment": 5}, "environment must name files below its own"),
        ({"environment": "1_0/meta.json"}, "is also a model of the levels"),
        ({"environment": "gone/meta.json"}, "no such file"),
    ],
)
def test_bad_manifests_are_refused(streamed, changes, message):
    with pytest.raises(FormatError, match=message):
        io.load(streamed(**changes))


@pytest.mark.parametrize(
    ("name", "count", "degree"),
    [
        ("skull.sog", 94_936, 3),
        ("flowers/lod-meta.json", 542_104, 2),
        ("playbot/lod-meta.json", 500_000, 2),
    ],
)
def test_real_scenes(name, count, degree):
    path = scene_path(name)
    model, info = io.load(path), io.inspect(path)
    assert len(model) == info.splats == count
    assert model.sh_degree == info.sh_degree == degree
    assert model.finite().all()


def test_real_scene_agrees_with_gsply():
    pytest.importorskip("imagecodecs")
    gsply = pytest.importorskip("gsply")
    path = scene_path("skull.sog")
    model, other = io.load(path), gsply.sogread(str(path))
    assert np.array_equal(model.log_scales, other.scales)
    assert np.array_equal(model.sh[:, 0], other.sh0)
    assert np.array_equal(model.sh[:, 1:], other.shN)
    assert model.means == pytest.approx(other.means, abs=1e-6)
    assert model.quats == pytest.approx(other.quats, abs=1e-6)
    # gsply keeps alpha a millionth away from 0 and 1.
    assert model.opacity_logits.clip(-13.8, 13.8) == pytest.approx(
        other.opacities.clip(-13.8, 13.8), abs=1e-5
    )
