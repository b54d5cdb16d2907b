"""Names and comments in any encoding or none, in every format and on the terminal."""

import json
import os
import struct
import subprocess
import sys
from dataclasses import replace
from io import BytesIO, TextIOWrapper

import numpy as np
import pytest
import typer

import nanogs
from builders import model_bytes, random_splats
from nanogs import io
from nanogs.cli.standard_streams import named_stdout
from nanogs.errors import OutputError
from nanogs.splats import ExtraElement, Splats

LATIN = "caf\udce9"  # how Python represents bytes that are not UTF-8
UNENCODABLE = "a\ud800b"  # cannot come from a file, but JSON can hold it
JSON_FORMATS = [".rad", ".glb", ".gltf"]  # their JSON is UTF-8 and holds comments


@pytest.fixture
def latin(tmp_path):
    """A file with names and comments that are not UTF-8."""
    label = {LATIN: np.arange(9, dtype=np.int32)}
    rows = np.array([(1.5,)], [("a", "f8")])
    model = random_splats(9, extras=label)
    model = replace(model, comments=[LATIN, "é"], elements=[ExtraElement(LATIN, rows)])
    io.save(model, tmp_path / "a.ply")
    return tmp_path / "a.ply"


@pytest.mark.parametrize("suffix", JSON_FORMATS)
def test_comments_that_are_not_utf_8_are_read_back_as_latin_1(latin, tmp_path, suffix):
    nanogs.convert(latin, tmp_path / f"b{suffix}")
    io.save(io.load(latin), tmp_path / f"c{suffix}")
    assert (tmp_path / f"b{suffix}").read_bytes() == (tmp_path / f"c{suffix}").read_bytes()
    loaded = io.load(tmp_path / f"b{suffix}")
    assert loaded.comments == io.inspect(tmp_path / f"b{suffix}").comments == ("café", "é")
    nanogs.convert(tmp_path / f"b{suffix}", tmp_path / "d.ply")
    assert b"comment caf\xc3\xa9\ncomment \xc3\xa9\n" in (tmp_path / "d.ply").read_bytes()


@pytest.mark.parametrize("suffix", [".ply", *JSON_FORMATS])
def test_comments_that_no_file_can_hold_are_refused(tmp_path, suffix):
    model = replace(random_splats(3), comments=[UNENCODABLE])
    with pytest.raises(OutputError, match=r"'a\\ud800b' cannot be encoded"):
        io.save(model, tmp_path / f"a{suffix}")
    assert list(tmp_path.iterdir()) == []


def test_obj_info_is_kept_in_blocks_too(latin, tmp_path):
    latin.write_bytes(latin.read_bytes().replace(b"comment", b"obj_info num 3\ncomment", 1))
    report = nanogs.convert(latin, tmp_path / "b.rad")
    assert "1 obj_info line was kept as a comment." in report.notes
    assert io.load(tmp_path / "b.rad").comments == ("café", "é", "num 3")


def test_comments_of_gltf_that_utf_8_cannot_hold_are_left_out(tmp_path):
    """JSON can hold what UTF-8 cannot; extras may be anything, by specification."""
    io.save(replace(random_splats(3), comments=["first", "second"]), tmp_path / "a.glb")
    data = (tmp_path / "a.glb").read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    content = json.loads(data[20 : 20 + size])
    content["meshes"][0]["primitives"][0]["extras"]["comments"] = ["first", UNENCODABLE, LATIN]
    text = json.dumps(content, separators=(",", ":")).encode().ljust(size)
    assert len(text) == size
    (tmp_path / "a.glb").write_bytes(data[:20] + text + data[20 + size :])
    assert io.load(tmp_path / "a.glb").comments == ("first",)
    for suffix in (".ply", *JSON_FORMATS):
        nanogs.convert(tmp_path / "a.glb", tmp_path / f"b{suffix}")
        assert io.load(tmp_path / f"b{suffix}").comments == ("first",)


def test_notes_on_losses_can_be_printed(latin, tmp_path):
    losses = nanogs.convert(latin, tmp_path / "a.spz").losses
    assert "Extra columns are left out, .spz has no room for them: café." in losses
    assert "Further elements are left out, .spz has no room for them: café." in losses
    assert nanogs.info(latin).losses[".spz"] == losses
    never = replace(random_splats(3), extras={UNENCODABLE: np.zeros(3, np.float32)})
    "".join(io.losses(never, tmp_path / "a.spz")).encode()


def test_every_extra_column_keeps_its_name(latin, tmp_path):
    io.save(io.load(latin), tmp_path / "b.ply")
    loaded = io.load(tmp_path / "b.ply")
    assert list(loaded.extras) == [LATIN]
    assert model_bytes(loaded) == model_bytes(io.load(latin))
    assert isinstance(loaded, Splats)


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are text elsewhere")
@pytest.mark.parametrize("encoding", ["utf-8:strict", "ascii:strict"])
def test_info_escapes_what_stdout_cannot_encode(latin, encoding):
    """With UTF-8, Python refuses lone surrogates on stdout; with LANG=C it lets them pass."""
    path = latin.with_name(f"{LATIN}.ply")
    latin.rename(path)
    result = subprocess.run(
        [sys.executable, "-m", "nanogs", "info", path], capture_output=True, check=False,
        env=os.environ | {"PYTHONIOENCODING": encoding},
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    stdout = result.stdout.decode(encoding.partition(":")[0])
    shown = "café" if encoding.startswith("utf") else r"caf\xe9"
    assert r"caf\udce9.ply (ply, " in stdout
    assert f"extra columns       {shown}" in stdout
    assert f"elements            {shown} (1 row)" in stdout


def test_stdout_escapes_what_it_cannot_encode(monkeypatch):
    """Tables of `nanogs bench` are plain text, with the names of files and signs such as ∞."""
    written = BytesIO()
    monkeypatch.setattr(sys, "stdout", TextIOWrapper(written, encoding="cp1252"))
    with named_stdout():
        typer.echo("PSNR ∞ of caf\udce9", nl=False)
        sys.stdout.flush()
    assert written.getvalue() == rb"PSNR \u221e of caf\udce9"
