"""Streamed SOG as one file: `.ssog`, a zip of what `lod-meta.json` describes."""

import json
import zipfile

import numpy as np
import pytest

import nanogs
from builders import random_splats
from launch import run
from nanogs import io
from nanogs.errors import ExistsError, FormatError, OptionError
from nanogs.io.registry import LEVELS
from nanogs.lod.archive import write_archive

FAST = ("--preset", "fast", "--chunk", "500")


@pytest.fixture(scope="module")
def archive_folder(tmp_path_factory):
    """A model, the folder of its levels and the same levels as one file."""
    folder = tmp_path_factory.mktemp("archive")
    nanogs.save(random_splats(3000, degree=1), folder / "a.ply")
    for out in ("web/lod-meta.json", "a.ssog"):
        result = run("lod", folder / "a.ply", folder / out, *FAST, "-q")
        assert result.returncode == 0, result.stderr
    return folder


def test_an_archive_holds_the_files_of_the_folder(archive_folder):
    with zipfile.ZipFile(archive_folder / "a.ssog") as archive:
        names = archive.namelist()
        assert all(entry.compress_type == zipfile.ZIP_STORED for entry in archive.infolist())
        files = {name: archive.read(name) for name in names}
    web = archive_folder / "web"
    paths = {path.relative_to(web).as_posix(): path for path in web.rglob("*") if path.is_file()}
    assert files == {name: path.read_bytes() for name, path in paths.items()}
    # The files that a first picture needs come first: lod-meta.json, then the coarsest level.
    levels = [int(name.split("_")[0]) for name in names[1:]]
    assert names[0] == LEVELS
    assert levels == sorted(levels, reverse=True)
    assert levels[0] == 3
    assert sorted(path.name for path in archive_folder.iterdir()) == ["a.ply", "a.ssog", "web"]


@pytest.mark.parametrize("name", ["a.ssog", "a.rad"])
def test_the_table_counts_no_files_of_levels_in_one_file(archive_folder, tmp_path, name):
    options = ("--preset", "fast", "--levels", "1,0.5")
    table = run("lod", archive_folder / "a.ply", tmp_path / name, *options).stderr
    rows = [line.split() for line in table.splitlines()]
    assert ["0", "1", "3,000"] in [row[:3] for row in rows]
    assert ["1", "0.5", "1,500"] in [row[:3] for row in rows]


@pytest.mark.parametrize("level", [0, 3])
def test_a_level_is_the_same_as_from_the_folder(archive_folder, level):
    folder = io.open(archive_folder / "web" / LEVELS, level=level)
    archive = io.open(archive_folder / "a.ssog", level=level)
    assert archive.levels == folder.levels == (3000, 1500, 750, 375)
    assert archive.files == (archive_folder / "a.ssog",)
    info = archive.info
    assert (info.format, info.splats) == ("streamed sog", archive.levels[level])
    assert info.file_bytes == (archive_folder / "a.ssog").stat().st_size
    ours, theirs = archive.load(), folder.load()
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        assert np.array_equal(getattr(ours, name), getattr(theirs, name))


@pytest.mark.parametrize("name", ["noname.bin", "noname"])
def test_zips_of_any_name_are_read_if_their_format_is_given(archive_folder, tmp_path, name):
    io.save(random_splats(300, degree=1), tmp_path / "a.sog")
    for known, suffix in ((tmp_path / "a.sog", ".sog"), (archive_folder / "a.ssog", ".ssog")):
        renamed = tmp_path / name
        renamed.write_bytes(known.read_bytes())
        ours, theirs = io.load(renamed, format=suffix), io.load(known)
        assert np.array_equal(ours.means, theirs.means)
        with io.open(renamed, format=suffix) as source:
            assert source.files == (renamed,)
            assert source.info.splats == len(theirs)


def test_commands_take_an_archive(archive_folder, tmp_path):
    shown = json.loads(run("info", archive_folder / "a.ssog", "--json").stdout)
    assert shown["levels"] == [3000, 1500, 750, 375]
    result = run("convert", archive_folder / "a.ssog", tmp_path / "c.ply", "--level", "2", "-q")
    assert result.returncode == 0, result.stderr
    assert len(nanogs.load(tmp_path / "c.ply")) == 750
    data = (archive_folder / "a.ssog").read_bytes()
    result = run("convert", "-", tmp_path / "d.ply", "--from", "ssog", "-q", data=data)
    assert result.returncode == 0, result.stderr
    assert len(nanogs.load(tmp_path / "d.ply")) == 3000


def test_blocks_give_the_same_bytes_for_any_number_of_threads(archive_folder, tmp_path):
    options = {"preset": "fast", "layout": "streamed sog archive", "chunk": 500, "block": 1000}
    for number in (1, 2):
        nanogs.write_levels(
            archive_folder / "a.ply", tmp_path / f"{number}.ssog", **options, threads=number
        )
    assert (tmp_path / "1.ssog").read_bytes() == (tmp_path / "2.ssog").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1.ssog", "2.ssog"]
    assert io.open(tmp_path / "1.ssog").levels == (3000, 1500, 750, 375)


@pytest.mark.parametrize(
    ("layout", "name", "message"),
    [
        ("streamed sog archive", "web", r'archive" is one \.ssog file; name that, .* web\.ssog\.$'),
        ("streamed sog archive", ".", r"is one \.ssog file; name that, as in scene\.ssog\.$"),
        ("spark tree", "/", r"is one \.rad file; name that, as in .scene\.rad\.$"),
        ("spark tree", "web.ply", r"is one \.rad file; name that, .* web\.rad\.$"),
        ("streamed sog", "web/lod-meta.json", r'"streamed sog" is a folder; .* as in web\.$'),
        ("3d tiles", "web/tileset.json", r'"3d tiles" is a folder; name that, as in web\.$'),
        ("files", "web.sog", r'one file, but the layout "files" is a folder; .* as in web\.$'),
    ],
)
def test_in_python_the_name_of_the_output_fits_the_layout(
    tmp_path, monkeypatch, layout, name, message
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "web").mkdir()
    with pytest.raises(OptionError, match=message):
        nanogs.write_levels(random_splats(50), name, [0.5], layout=layout, preset="fast")
    assert [each.name for each in tmp_path.rglob("*")] == ["web"]


def test_an_existing_file_is_replaced_only_with_w(archive_folder, tmp_path):
    (tmp_path / "a.ssog").write_bytes(b"mine")
    refused = run("lod", archive_folder / "a.ply", tmp_path / "a.ssog", *FAST)
    assert (refused.returncode, "exists already" in refused.stderr) == (2, True)
    assert (tmp_path / "a.ssog").read_bytes() == b"mine"
    assert run("lod", archive_folder / "a.ply", tmp_path / "a.ssog", *FAST, "-w").returncode == 0
    assert (tmp_path / "a.ssog").read_bytes() == (archive_folder / "a.ssog").read_bytes()
    with pytest.raises(OptionError, match="levels of detail; make them with `nanogs lod`"):
        nanogs.save(random_splats(3), tmp_path / "b.ssog")


@pytest.mark.parametrize(
    ("layout", "name"), [("streamed sog archive", "a.ssog"), ("spark tree", "a.rad")]
)
def test_an_existing_file_is_refused_before_anything_is_computed(tmp_path, layout, name):
    (tmp_path / name).write_bytes(b"mine")
    steps = []
    options = {"layout": layout, "preset": "fast", "progress": steps.append}
    with pytest.raises(ExistsError):
        nanogs.write_levels(random_splats(50), tmp_path / name, [0.5], **options)
    assert steps == []


def test_an_archive_can_hold_a_file_above_the_limit_of_old_zips(tmp_path, monkeypatch):
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", 1000)
    (tmp_path / "large").write_bytes(data := bytes(2000))
    write_archive(tmp_path, ["large"], tmp_path / "a.ssog")
    with zipfile.ZipFile(tmp_path / "a.ssog") as archive:
        assert archive.read("large") == data


def write_changed(source, target, change):
    """Write a copy of an archive after `change` has edited its files."""
    with zipfile.ZipFile(source) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    change(files)
    with zipfile.ZipFile(target, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda files: files.pop(LEVELS), "lod-meta.json is missing"),
        (lambda files: files.pop("0_0/meta.json"), "0_0/meta.json is missing"),
        (lambda files: files.update({LEVELS: b"{"}), "is no JSON"),
        (
            lambda files: files.update({LEVELS: files[LEVELS].replace(b"0_0/", b"../")}),
            "must name files below its own folder",
        ),
        (
            lambda files: files.update({LEVELS: files[LEVELS].replace(b"0_0/meta.json", b"a.sog")}),
            "must name a meta.json in a folder of the zip",
        ),
    ],
    ids=["no description", "no model", "no JSON", "outside", "no folder"],
)
def test_a_damaged_archive_is_refused_in_a_sentence(archive_folder, tmp_path, change, message):
    write_changed(archive_folder / "a.ssog", tmp_path / "b.ssog", change)
    with pytest.raises(FormatError, match=message):
        io.open(tmp_path / "b.ssog").load()
