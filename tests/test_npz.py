"""Reading and writing `.npz`."""

import io as bytes_io
import tempfile
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

import nanogs
from builders import random_splats
from damage import mutate, outcome
from nanogs import io
from nanogs.errors import FormatError, OutputError
from nanogs.io import parts, registry
from nanogs.io.npz import read as npz
from nanogs.source import source_of
from nanogs.splats import ExtraElement, RenderMode
from strategies import assert_same, splats

SHARED = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)


def saved(model, path):
    io.save(model, path, overwrite=True)
    return io.load(path)


def write_arrays(path, model, **changes):
    arrays = {name: getattr(model, name) for name in npz.REQUIRED} | changes
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})


@SHARED
@given(model=splats())
def test_saving_and_loading_changes_no_bit(tmp_path, model):
    again = saved(model, tmp_path / "a.npz")
    assert_same(replace(model, comments=(), elements=()), again)
    assert again.notes == ()
    first = (tmp_path / "a.npz").read_bytes()
    io.save(again, tmp_path / "a.npz", overwrite=True)
    assert (tmp_path / "a.npz").read_bytes() == first


@SHARED
@given(model=splats())
def test_the_file_size_is_known_before_writing(tmp_path, model):
    io.save(model, tmp_path / "a.npz", overwrite=True)
    size = registry.sizer(tmp_path / "a.npz")
    assert (tmp_path / "a.npz").stat().st_size == size(model, len(model))
    sizes = [size(model, count) for count in (1, 2, 9, 10, 99, 100, 10**6, 10**9)]
    assert sizes == sorted(sizes)


@pytest.mark.parametrize("limit", [200, 1500, 2500])
def test_the_size_of_an_archive_beyond_2_gib_is_not_underestimated(tmp_path, monkeypatch, limit):
    """Entries and the directory are longer beyond the limit, which is lowered here."""
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", limit)
    model = random_splats(9, degree=1, extras={"label": np.arange(9)})
    io.save(model, tmp_path / "a.npz")
    size = registry.sizer(tmp_path / "a.npz")(model, 9)
    assert 0 <= size - (tmp_path / "a.npz").stat().st_size <= 28 + 76


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize("name", npz.REQUIRED)
def test_a_checksum_that_does_not_fit_is_refused(tmp_path, name, save):
    path = tmp_path / "a.npz"
    save(path, **{each: getattr(random_splats(50), each) for each in npz.REQUIRED})
    with zipfile.ZipFile(path) as archive:
        stated = archive.getinfo(f"{name}.npy").CRC.to_bytes(4, "little")
    path.write_bytes(path.read_bytes().replace(stated, bytes(4)))
    with pytest.raises(FormatError, match="Bad CRC-32"):
        io.load(path)


def test_numpy_reads_saved_files_without_pickle(tmp_path):
    model = replace(random_splats(5, extras={"label": np.arange(5)}), render_mode=RenderMode.MIP)
    io.save(model, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as arrays:
        assert np.array_equal(arrays["sh"], model.sh)
        assert np.array_equal(arrays["extra:label"], np.arange(5))
        assert arrays["render_mode"].item() == "mip"


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_files_written_by_numpy_are_read(tmp_path, save):
    model = random_splats(50, degree=2)
    arrays = {name: getattr(model, name) for name in npz.REQUIRED}
    arrays["quats"] = np.asfortranarray(arrays["quats"])
    arrays["means"] = arrays["means"].astype(">f4")
    save(tmp_path / "a.npz", **arrays, camera=np.eye(4))
    again = io.load(tmp_path / "a.npz")
    assert_same(model, again)
    assert again.notes == ("Arrays nanogs does not know were left out: camera.",)
    assert again.quats.flags.c_contiguous
    with io.open(tmp_path / "a.npz") as source:  # the array in Fortran order is held whole
        assert source.memory - (8 << 20) == 2 * again.quats.nbytes
    again.means[0] = 1  # the arrays belong to the model


def test_inspect_agrees_with_the_model(tmp_path):
    extras = {"label": np.arange(7, dtype=np.int16), "name": np.array(["ab"] * 7)}
    model = random_splats(7, degree=3, extras=extras)
    model = replace(model, means=model.means.astype(np.float64), render_mode=RenderMode.SURFEL)
    io.save(model, tmp_path / "a.npz")
    info = io.inspect(tmp_path / "a.npz")
    assert (info.splats, info.sh_degree, info.double_means) == (7, 3, True)
    assert (info.format, info.encoding, info.render_mode) == ("npz", "zip", RenderMode.SURFEL)
    assert info.render_tag == "its array render_mode"
    assert info.extras == ("label", "name")
    assert dict(info.properties)["label"] == "short"
    assert info.extra_bytes() == 2 + 8
    assert info.file_bytes == (tmp_path / "a.npz").stat().st_size


def test_comments_and_elements_are_reported_as_losses(tmp_path):
    element = ExtraElement("camera", np.zeros(1, [("x", "f4")]))
    model = replace(random_splats(2), comments=["made by hand"], elements=[element])
    assert io.losses(model, tmp_path / "a.npz") == (
        "Further elements are left out, .npz has no room for them: camera.",
        "1 comment line is left out, .npz has no room for it.",
    )
    assert io.losses(random_splats(2, extras={"a": np.zeros(2)}), tmp_path / "a.npz") == ()


@pytest.mark.parametrize(
    "extras",
    [
        {"a": np.array([None, 1])},
        {"a\0b": np.zeros(2)},
        {"\udcff": np.zeros(2)},
        {"\\": np.zeros(2)},
        {"a" * 65530: np.zeros(2)},
    ],
)
def test_unstorable_columns_are_refused(tmp_path, extras):
    model = random_splats(2, extras=extras)
    with pytest.raises(OutputError, match="cannot hold"):
        io.save(model, tmp_path / "a.npz")
    with pytest.raises(OutputError, match="cannot hold"):  # before anything is computed
        registry.writable(tmp_path / "a.npz").check_columns(source_of(model).columns)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sh": None}, "lacks the arrays sh"),
        ({"quats": np.zeros((3, 3), np.float32)}, "quats must be"),
        ({"log_scales": np.zeros((3, 3))}, "log_scales must be .* float32"),
        ({"sh": np.zeros((3, 5, 3), np.float32)}, "sh must be"),
        ({"means": np.float32(1)}, "no splats"),
        ({"means": np.zeros((0, 3), np.float32)}, "no splats"),
        ({"extra:a": np.zeros(2)}, "extra column 'a'"),
        ({"extra:a": np.zeros(3, "f4,f4")}, "no plain array"),
        ({"render_mode": np.array("raster")}, "render_mode"),
        ({"render_mode": np.array(["mip", "mip"])}, "damaged|render_mode"),
    ],
)
def test_arrays_that_are_no_model_are_refused(tmp_path, changes, message):
    write_arrays(tmp_path / "a.npz", random_splats(3), **changes)
    with pytest.raises(FormatError, match=message):
        io.load(tmp_path / "a.npz")


def test_pickles_are_refused_unread(tmp_path):
    class Trap:
        def __reduce__(self):
            return (pytest.fail, ("a pickle was executed",))

    out = bytes_io.BytesIO()
    np.lib.format.write_array(out, np.array([Trap()], dtype=object), allow_pickle=True)
    write_arrays(tmp_path / "a.npz", random_splats(1))
    with zipfile.ZipFile(tmp_path / "a.npz", "a") as archive:
        archive.writestr("extra:a.npy", out.getvalue())
    with pytest.raises(FormatError, match="no plain array"):
        io.load(tmp_path / "a.npz")


@pytest.mark.parametrize(("count", "data"), [(4000000000, b""), (1, bytes(8))])
def test_stated_sizes_other_than_the_data_are_refused(tmp_path, count, data):
    write_arrays(tmp_path / "a.npz", random_splats(1))
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({count},), }}".encode()
    member = b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header + data
    with zipfile.ZipFile(tmp_path / "a.npz", "a") as archive:
        archive.writestr("extra:a.npy", member)
    with pytest.raises(FormatError, match="does not have the size"):
        io.load(tmp_path / "a.npz")


@pytest.mark.parametrize("shape", [f"({10**20}, 0)", f"({2**62}, {2**62}, 0)"])
def test_shapes_that_no_array_can_have_are_refused(tmp_path, shape):
    write_arrays(tmp_path / "a.npz", random_splats(1))
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".encode()
    with zipfile.ZipFile(tmp_path / "a.npz", "a") as archive:
        archive.writestr("extra:a.npy", b"\x93NUMPY\1\0" + bytes([len(header), 0]) + header)
    with pytest.raises(FormatError, match="unknown type or shape"):
        io.load(tmp_path / "a.npz")


@pytest.mark.parametrize("kind", ["M8[s]", "m8[ns]", "U3", "S2", "c8", "?"])
def test_columns_of_every_plain_type_are_read_in_parts(tmp_path, kind):
    column = np.arange(5).astype(kind)
    io.save(random_splats(5, extras={"a": column}), tmp_path / "a.npz")
    assert_same(io.open(tmp_path / "a.npz").read(1, 3), io.load(tmp_path / "a.npz").span(1, 3))
    nanogs.convert(tmp_path / "a.npz", tmp_path / "b.npz")
    assert_same(io.load(tmp_path / "b.npz"), io.load(tmp_path / "a.npz"))


def test_no_file_stays_open_if_unpacking_fails(tmp_path, monkeypatch):
    io.save(random_splats(5000, extras={"a": np.arange(5000)}), tmp_path / "a.npz")
    data = (tmp_path / "a.npz").read_bytes()
    at = data.index(np.arange(5000).tobytes())
    (tmp_path / "a.npz").write_bytes(data[:at] + b"\1" + data[at + 1 :])
    files = []

    def opened(**options):
        files.append(tempfile.TemporaryFile(**options))  # noqa: SIM115 - closed by the source
        return files[-1]

    monkeypatch.setattr(parts, "TemporaryFile", opened)
    source = io.open(tmp_path / "a.npz")
    for _ in range(2):
        with pytest.raises(FormatError, match="damaged"):
            source.read(1, 3)
    assert [file.closed for file in files] == [True, True]


@pytest.mark.parametrize(
    ("at", "value", "message"),
    [(8, 1, "is damaged .*encrypted"), (6, 99, "is damaged .*zip file version 9.9")],
    ids=["encrypted", "version"],
)
def test_archives_that_cannot_be_opened_are_refused(tmp_path, at, value, message):
    io.save(random_splats(1), tmp_path / "a.npz")
    data = bytearray((tmp_path / "a.npz").read_bytes())
    data[data.index(b"PK\1\2") + at] = value
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(FormatError, match=message):
        io.load(tmp_path / "a.npz")


def test_other_compression_than_numpy_uses_is_refused(tmp_path):
    io.save(random_splats(1), tmp_path / "a.npz")
    with (
        zipfile.ZipFile(tmp_path / "a.npz") as old,
        zipfile.ZipFile(tmp_path / "b.npz", "w", zipfile.ZIP_BZIP2) as new,
    ):
        for name in old.namelist():
            new.writestr(name, old.read(name))
    with pytest.raises(FormatError, match="packed in a way that NumPy never uses"):
        io.load(tmp_path / "b.npz")


@pytest.mark.parametrize("version", [(2, 0), (3, 0)])
def test_later_versions_of_the_arrays_are_read(tmp_path, version):
    """Their headers state their length in four bytes."""
    model = random_splats(5)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        for name in npz.REQUIRED:
            out = bytes_io.BytesIO()
            np.lib.format.write_array(out, getattr(model, name), version)
            archive.writestr(f"{name}.npy", out.getvalue())
    assert_same(io.load(tmp_path / "a.npz"), model)


def test_an_array_that_is_there_twice_is_refused(tmp_path):
    io.save(random_splats(1), tmp_path / "a.npz")
    with zipfile.ZipFile(tmp_path / "a.npz", "a") as archive:
        member = archive.read("sh.npy")
        with pytest.warns(UserWarning, match="Duplicate name"):
            archive.writestr("sh.npy", member)
    with pytest.raises(FormatError, match="overlap"):
        io.load(tmp_path / "a.npz")


def test_a_stored_member_cannot_be_larger_than_the_file(tmp_path):
    io.save(random_splats(1), tmp_path / "a.npz")
    data = bytearray((tmp_path / "a.npz").read_bytes())
    offset = data.index(b"PK\1\2")
    data[offset + 20 : offset + 28] = (2**31).to_bytes(4, "little") * 2
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(FormatError, match="overlap"):
        io.load(tmp_path / "a.npz")


def repacked(rng, data):
    """Mutate one array of the archive and correct its checksum."""
    out = bytes_io.BytesIO()
    with zipfile.ZipFile(bytes_io.BytesIO(data)) as old, zipfile.ZipFile(out, "w") as new:
        chosen = rng.integers(len(old.namelist()))
        for i, name in enumerate(old.namelist()):
            content = old.read(name)
            head = mutate(rng, content[:128]) + content[128:]
            new.writestr(name, head if i == chosen else content)
    return out.getvalue()


@pytest.mark.parametrize("damage", [mutate, repacked])
@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_damaged_files_give_a_format_error_or_a_model(tmp_path, damage, save):
    rng, path = np.random.default_rng(5), tmp_path / "fuzz.npz"
    model = random_splats(20, extras={"label": np.arange(20)})
    arrays = {name: getattr(model, name) for name in npz.REQUIRED}
    save(path, **arrays, render_mode=np.array("mip"), **{"extra:label": np.arange(20)})
    seed = path.read_bytes()
    outcomes = {"model": 0, "refused": 0}
    for _ in range(400):
        path.write_bytes(damage(rng, seed))
        outcomes[outcome(path)] += 1
    assert outcomes["refused"] > 0


def test_every_truncation_is_refused(tmp_path):
    io.save(random_splats(2), tmp_path / "a.npz")
    data = (tmp_path / "a.npz").read_bytes()
    for size in range(0, len(data), 7):
        (tmp_path / "b.npz").write_bytes(data[:size])
        with pytest.raises(FormatError):
            io.load(tmp_path / "b.npz")
