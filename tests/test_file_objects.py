"""Open files in place of paths."""

import io
import tempfile
import zipfile

import pytest

import nanogs
from builders import random_splats
from nanogs.errors import FormatError, OptionError, OutputError
from nanogs.io import registry
from nanogs.source import InMemory
from strategies import assert_same

WRITTEN = [known.suffix for known in registry.formats() if known.write]


@pytest.fixture(autouse=True)
def own_temporary_folder(tmp_path, monkeypatch):
    """Use a temporary folder for this test alone, which must be empty at the end."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    yield
    assert list(folder.iterdir()) == []


@pytest.fixture(scope="module")
def model():
    return random_splats(60, degree=1)


@pytest.mark.parametrize("suffix", WRITTEN)
def test_an_open_file_gets_the_bytes_of_a_saved_file(model, suffix, tmp_path):
    path, file = tmp_path / f"a{suffix}", io.BytesIO()
    nanogs.save(model, path)
    nanogs.save(model, file, format=suffix.removeprefix("."))
    assert file.getvalue() == path.read_bytes()
    if registry.find(path).readable:
        file.seek(0)
        assert_same(nanogs.load(file, format=suffix), nanogs.load(path))


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".spz", ".sog", ".glb", ".npz"])
def test_the_format_is_recognised_by_the_first_bytes(model, suffix):
    file = io.BytesIO()
    nanogs.save(model, file, format=suffix)
    file.seek(0)
    assert len(nanogs.load(file)) == 60


def test_the_format_is_recognised_by_the_name_of_an_open_file(model, tmp_path):
    path = tmp_path / "a.splat"
    with path.open("wb") as file:
        nanogs.save(model, file)
    with path.open("rb") as file:
        assert len(nanogs.load(file)) == 60


def test_reading_and_writing_start_at_the_file_position(model):
    file = io.BytesIO(b"head")
    file.seek(4)
    nanogs.save(model, file, format=".splat")
    assert file.getvalue()[:4] == b"head"
    file.seek(4)
    assert len(nanogs.load(file, format=".splat")) == 60


def test_members_of_zip_archives_are_written_and_read(model, tmp_path):
    path = tmp_path / "all.zip"
    with zipfile.ZipFile(path, "w") as archive, archive.open("scene.spz", "w") as member:
        nanogs.save(model, member, format=".spz", format_options={"spz_version": 3})
    with zipfile.ZipFile(path) as archive, archive.open("scene.spz") as member:
        assert len(nanogs.load(member)) == 60


def test_a_given_format_replaces_the_suffix_of_a_path(model, tmp_path):
    path = tmp_path / "model.bin"
    nanogs.save(model, path, format=".splat")
    assert path.stat().st_size == 60 * 32
    assert len(nanogs.load(path, format="splat")) == 60
    with pytest.raises(FormatError, match="unknown suffix"):
        nanogs.load(path)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda m: nanogs.load(io.BytesIO(b"abc")), OptionError, "does not say its format"),
        (lambda m: nanogs.load(io.BytesIO(b"abc"), format="obj"), FormatError, "a format 'obj';"),
        (lambda m: nanogs.load(io.BytesIO(b""), format=".ply"), FormatError, r"^stream\.ply is em"),
        (lambda m: nanogs.load(io.BytesIO(b"ply\n")), FormatError, r"^stream\.ply"),
        (lambda m: nanogs.load(io.StringIO("ply")), OptionError, 'as text; open it with "rb"'),
        (lambda m: nanogs.load(7), OptionError, "path or an open file is needed to read .*not int"),
        (lambda m: nanogs.load(io.BytesIO(b""), level=1), OptionError, "no levels"),
        (lambda m: nanogs.save(m, io.BytesIO()), OptionError, "has no format by itself"),
        (lambda m: nanogs.save(m, io.StringIO(), format=".ply"), OptionError, 'with "wb"'),
        (lambda m: nanogs.load("a.bin", format="usd"), FormatError, r"^nanogs .* \.usd files;"),
        (lambda m: nanogs.open("a.bin", format="foo"), FormatError, "^nanogs does not read a"),
        (lambda m: nanogs.save(m, "a.bin", format="foo"), OptionError, "^nanogs does not write a"),
        (lambda m: nanogs.save(m, "a.bin", format="lcc"), OptionError, "format 'lcc'; it writes"),
        (lambda m: nanogs.save(m, 7), OptionError, "is needed to write a model, not int"),
        (lambda m: nanogs.save(m, io.BytesIO(), format="ksplat"), OptionError, "does not write"),
        (
            lambda m: nanogs.save(
                m, io.BytesIO(), format=".ply", format_options={"spz_version": 4}
            ),
            OptionError,
            "spz",
        ),
    ],
)
def test_unusable_files_and_formats_are_refused(model, call, error, message):
    with pytest.raises(error, match=message):
        call(model)


def test_files_that_are_closed_or_opened_for_the_other_direction_are_refused(model, tmp_path):
    path = tmp_path / "a.ply"
    with path.open("wb") as file:
        nanogs.save(model, file)
        with pytest.raises(OptionError, match='not opened for reading; open it with "rb"'):
            nanogs.load(file)
    with pytest.raises(OptionError, match="is closed already; read the model before"):
        nanogs.load(file)
    with pytest.raises(OptionError, match="is closed already; write the model before"):
        nanogs.save(model, file)
    with (
        path.open("rb") as file,
        pytest.raises(OptionError, match='not opened for writing; open it with "wb"'),
    ):
        nanogs.save(model, file)
    assert_same(nanogs.load(path), model)


def test_a_format_that_is_a_folder_is_refused_for_an_open_file(model):
    with pytest.raises(OptionError, match="folder of files"):
        nanogs.save(model, io.BytesIO(), format="meta.json")


class Broken(io.RawIOBase):
    """A file on a full disk or a failing connection."""

    def write(self, data):
        raise OSError(28, "No space left on device")

    def read(self, size=-1):
        raise OSError(5, "Input/output error")


def test_errors_of_the_file_object_are_reported(model):
    with pytest.raises(OutputError, match=r"cannot be written \(No space left"):
        nanogs.save(model, Broken(), format=".ply")
    with pytest.raises(OutputError, match=r"cannot be copied .*\(Input/output error\)"):
        nanogs.load(Broken(), format=".ply")


def test_nothing_is_written_if_the_format_cannot_hold_the_model(model):
    file = io.BytesIO()
    bad = random_splats(3, extras={"a\0b": model.opacity_logits[:3]})
    with pytest.raises(OutputError, match="cannot hold the name"):
        nanogs.save(bad, file, format=".npz")
    assert file.getvalue() == b""


def test_large_files_are_buffered_on_disk(model, monkeypatch):
    from nanogs.io import file_objects

    monkeypatch.setattr(file_objects, "_IN_MEMORY", 16)
    file = io.BytesIO()
    nanogs.save(model, file, format=".ply")
    file.seek(0)
    assert_same(nanogs.load(file), model)


@pytest.mark.parametrize("suffix", WRITTEN)
def test_models_without_splats_are_refused_by_every_format(tmp_path, suffix):
    nothing = random_splats(3)[:0]
    with pytest.raises(
        OutputError, match=rf"has no splats, but a \{suffix} file needs at least one"
    ):
        nanogs.save(nothing, tmp_path / f"a{suffix}")
    assert not (tmp_path / f"a{suffix}").exists()


@pytest.mark.parametrize("suffix", WRITTEN)
def test_a_refusal_of_models_without_splats_is_told_beforehand(suffix):
    nothing = random_splats(3)[:0]
    told = (f"The model has no splats, {suffix} refuses it.",)
    assert nanogs.io.losses(nothing, f"a{suffix}") == told
    assert nanogs.io.losses(InMemory(nothing), f"a{suffix}") == told
    with pytest.raises(OutputError, match="has no splats"):
        nanogs.io.derived_options(nothing, f"a{suffix}", {})
