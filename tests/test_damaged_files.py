"""Damaged files of every format (benchmarks/mutate.py reads 10,000 of each), and bombs."""

import io as bytes_io
import json
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest
import zstandard

import fuzz_seeds
import sogfiles
import spzfiles
from builders import random_splats
from damage import outcome
from nanogs import io
from nanogs.errors import FormatError

COUNT = 200
MANY = 3_000_000  # splats of a bomb, 168 MB in memory


@pytest.mark.parametrize("name", fuzz_seeds.FORMATS)
def test_damaged_files_give_an_error_of_nanogs_or_a_model(tmp_path, name):
    damaged_format, rng = fuzz_seeds.format_named(name), np.random.default_rng(7)
    found = {"model": 0, "refused": 0}
    for number in range(COUNT):
        folder = tmp_path / str(number)
        found[outcome(fuzz_seeds.write_files(folder, damaged_format.damaged(rng)))] += 1
    assert min(found.values()) > 0, found


def test_every_readable_format_has_damaged_files():
    known = {
        next(iter(files))
        for name in fuzz_seeds.FORMATS
        for files in fuzz_seeds.format_named(name).seeds
    }
    suffixes = {known.suffix for known in io.registry.formats() if known.readable}
    assert all(any(name.endswith(suffix) for name in known) for suffix in suffixes)


def gzip_bomb():
    """Only zeros, with a header that states their true size."""
    return {"a.spz": spzfiles.encode([], 3, count=MANY, records=bytes(20 * MANY // 10) * 10)}


def zstd_bomb():
    data = spzfiles.encode([spzfiles.row()], 4)
    streams = [zstandard.compress(bytes(width * MANY)) for width in (9, 1, 3, 3, 4)]
    table = b"".join(
        struct.pack("<QQ", len(stream), width * MANY)
        for stream, width in zip(streams, (9, 1, 3, 3, 4), strict=True)
    )
    head = data[:8] + struct.pack("<I", MANY) + data[12:32]
    return {"a.spz": head + table + b"".join(streams)}


def zip_bomb():
    """Arrays of zeros, compressed as NumPy does it."""
    file = bytes_io.BytesIO()
    shapes = {"means": (3,), "log_scales": (3,), "quats": (4,), "opacity_logits": (), "sh": (1, 3)}
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, rest in shapes.items():
            with archive.open(f"{name}.npy", "w") as member:
                zeros = np.broadcast_to(np.float32(0), (MANY, *rest))
                np.lib.format.write_array_header_1_0(
                    member, np.lib.format.header_data_from_array_1_0(zeros)
                )
                for _ in range(10):
                    member.write(bytes(zeros.nbytes // 10))
    return {"a.npz": file.getvalue()}


def webp_bomb(method=zipfile.ZIP_STORED):
    """Pictures of one colour that state the largest possible size; they are never decoded."""
    side = 2**14 - 1
    picture = sogfiles.textures()["sh0.webp"]
    sides = (side - 1) | (side - 1) << 14 | struct.unpack_from("<I", picture, 21)[0] & 0xF000_0000
    picture = picture[:21] + struct.pack("<I", sides) + picture[25:]
    contents = sogfiles.files(sogfiles.meta(count=side**2))
    contents = {n: picture if n.endswith(".webp") else d for n, d in contents.items()}
    file = bytes_io.BytesIO()
    sogfiles.bundle(file, contents, method)
    return {"a.sog": file.getvalue()}


def canvas_bomb():
    """A small picture on a canvas of the largest size, for which decoders allocate memory."""
    texture = sogfiles.textures()["sh0.webp"]
    canvas = b"VP8X" + struct.pack("<I", 10) + bytes(4) + (2**14 - 2).to_bytes(3, "little") * 2
    picture = b"RIFF" + struct.pack("<I", len(texture) - 8 + 18) + b"WEBP" + canvas + texture[12:]
    contents = sogfiles.files(**{"sh0.webp": picture})
    return {"meta.json": contents.pop("meta.json")} | contents


def repeated_model():
    """A streamed scene that names one model a thousand times."""
    ((name, manifest), *rest) = fuzz_seeds.format_named("lod-meta.json").seeds[0].items()
    content = json.loads(manifest)
    content["filenames"] = content["filenames"][:1] * 1000
    lods = [{"lods": {"0": {"file": i, "offset": 0, "count": 3}}} for i in range(1000)]
    content["tree"] = {"children": lods}
    return {name: json.dumps(content).encode()} | dict(rest)


def checkpoint(pickled):
    """Return a checkpoint whose pickle is replaced."""
    ((name, data),) = fuzz_seeds.format_named(".pt").seeds[0].items()
    file = bytes_io.BytesIO()
    with zipfile.ZipFile(bytes_io.BytesIO(data)) as old, zipfile.ZipFile(file, "w") as new:
        for member in old.namelist():
            new.writestr(member, pickled if member.endswith("data.pkl") else old.read(member))
    return {name: file.getvalue()}


def long_pickle():
    """A list of empty lists; each takes 64 bytes in memory for one byte in the file."""
    return checkpoint(b"\x80\2](" + b"]" * 3_000_000 + b"e.")


def nested_pickle(again):
    """A dictionary whose key is a tuple of twice the same tuple, and so on, 60 levels deep."""
    return checkpoint(b"\x80\2})" + again * 60 + b"Ns.")


BOMBS = {
    "gzip": (gzip_bomb, "far more than splats can be compressed"),
    "zstd": (zstd_bomb, "far more than splats can be compressed"),
    "zip": (zip_bomb, "far more than splats can be compressed"),
    "WebP": (webp_bomb, "far more than splats can be compressed"),
    "WebP in a packed zip": (lambda: webp_bomb(zipfile.ZIP_DEFLATED), "far more than splats"),
    "canvas": (canvas_bomb, "damaged WebP"),
    "repeated model": (repeated_model, "names a file twice"),
    "tuples": (lambda: nested_pickle(b"2\x86"), "nested in each other"),
    "tuples by memo": (lambda: nested_pickle(b"q\0h\0\x86"), "nested in each other"),
    "pickle": (long_pickle, "packed or has 3000006 bytes"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_bombs_are_refused_before_they_take_memory(tmp_path, name):
    make, words = BOMBS[name]
    path = fuzz_seeds.write_files(tmp_path, make())
    tracemalloc.start()
    with pytest.raises(FormatError, match=words):
        io.load(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10_000_000


@pytest.mark.parametrize("suffix", [".sog", ".spz", ".npz"])
def test_equal_splats_are_not_taken_for_a_bomb(tmp_path, suffix):
    """Equal splats compress best of all, but their file is valid."""
    model = random_splats(1).take(np.zeros(100_000, np.int64))
    path = tmp_path / f"a{suffix}"
    io.save(model, path)
    assert len(io.load(path)) == 100_000
