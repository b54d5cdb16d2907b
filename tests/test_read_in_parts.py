"""Files read in parts: in every format, each span equals the same rows of the whole file."""

import gzip
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import fuzz_seeds
import ksplatfiles
import spzfiles
from builders import random_splats
from conftest import scene_path
from nanogs import io
from nanogs.errors import FormatError
from nanogs.io import parts, registry
from nanogs.io.parts import Packed, Whole
from nanogs.io.sog import read as sog
from part_reading import in_parts, load_whole
from strategies import assert_same, splats

# Names of seeds, and suffixes, of files that are never read in parts.
WHOLE = (".pt", ".pt, old", ".ckpt", ".pth", ".usda", "tileset.json", ".glb, packed")
SCENES = ("biker.spz", "biker.compressed.ply", "chair.splat", "skull.sog", "playbot/lod-meta.json")
WRITTEN = [".ply", ".compressed.ply", ".splat", ".npz", ".spz", ".rad", ".glb"]


def assert_spans(path, spans):
    """Assert that spans of a file read in parts equal the same rows of the whole."""
    expected = load_whole(path)
    with in_parts(path) as read:
        for start, stop in spans:
            part = read(start, stop)
            assert_same(part, expected.span(start, stop))
            assert {*part.notes} <= {*expected.notes} or "negative" in str(part.notes)


def some_spans(count, rng, many):
    """Return random spans, the whole, the first row and the last."""
    ends = np.sort(rng.integers(0, count + 1, (many, 2)), axis=1)
    return [(0, count), (0, 1), (count - 1, count), *((a, b) for a, b in ends.tolist() if a < b)]


@pytest.mark.parametrize("suffix", WRITTEN)
@given(model=splats(max_n=600, wild=False), data=st.data())
def test_spans_of_any_model_equal_the_rows_of_the_whole(tmp_path_factory, suffix, model, data):
    path = tmp_path_factory.mktemp("spans") / f"a{suffix}"
    with path.open("wb") as file:  # because `save` waits for the disk
        registry.writer(path)(model, file)
    starts = data.draw(st.lists(st.integers(0, len(model) - 1), min_size=1, max_size=4))
    spans = [(start, data.draw(st.integers(start + 1, len(model)))) for start in starts]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parts, "BLOCK_ROWS", 37)
        assert_spans(path, spans)


SECTIONS = st.lists(
    st.tuples(st.integers(0, 60), st.integers(1, 9), st.integers(0, 99)), min_size=1, max_size=4
).filter(lambda sections: any(n for n, _, _ in sections))


@given(SECTIONS, st.integers(0, 2), st.integers(0, 3), st.data())
def test_spans_of_ksplat_sections_equal_the_rows_of_the_whole(
    tmp_path_factory, sections, mode, degree, data
):
    made = [
        ksplatfiles.section(n, mode, degree, capacity=capacity, seed=seed, spare=seed % 3)
        for n, capacity, seed in sections
    ]
    path = tmp_path_factory.mktemp("ksplat") / "a.ksplat"
    path.write_bytes(ksplatfiles.ksplat(*made, mode=mode))
    count = sum(n for n, _, _ in sections)
    starts = data.draw(st.lists(st.integers(0, count - 1), min_size=1, max_size=4))
    spans = [(start, data.draw(st.integers(start + 1, count))) for start in starts]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parts, "BLOCK_ROWS", data.draw(st.integers(2, 40)))
        assert_spans(path, spans)


def test_empty_buckets_hold_no_row(tmp_path):
    header, body, model = ksplatfiles.section(9, 1, 0, capacity=20, seed=4)
    lengths = np.frombuffer(body, "<u4", 5).tolist()
    used = lengths[: next(i for i in range(6) if sum(lengths[:i]) == 9)]
    with_gaps = [0, *used[:1], 0, 0, *used[1:], 0]
    centres = np.frombuffer(body, "<f4", 3 * len(used), offset=4 * len(used)).reshape(-1, 3)
    wide = np.full((len(with_gaps), 3), 1e9, "<f4")
    wide[[1, *range(4, 3 + len(used))]] = centres
    header = bytearray(header)
    header[12:16] = header[36:40] = len(with_gaps).to_bytes(4, "little")
    rest = body[16 * len(used) :]
    packed = np.array(with_gaps, "<u4").tobytes() + wide.tobytes() + rest
    (tmp_path / "a.ksplat").write_bytes(ksplatfiles.ksplat((bytes(header), packed, model), mode=1))
    assert np.abs(io.load(tmp_path / "a.ksplat").means).max() < 1e3
    assert_spans(tmp_path / "a.ksplat", [(a, b) for a in range(9) for b in range(a + 1, 10)])


@pytest.mark.parametrize("name", fuzz_seeds.FORMATS)
def test_spans_of_small_files_of_every_format_equal_the_whole(tmp_path, name):
    rng = np.random.default_rng(3)
    for number, files in enumerate(fuzz_seeds.format_named(name).seeds):
        path = fuzz_seeds.write_files(tmp_path / str(number), files)
        if name in WHOLE or path.suffix in WHOLE:
            assert isinstance(io.open(path), Whole)
        else:
            assert_spans(path, some_spans(io.inspect(path).splats, rng, 4))


@pytest.mark.parametrize("name", [name for name in fuzz_seeds.FORMATS if name not in WHOLE])
def test_damaged_files_give_the_same_in_parts_and_whole(tmp_path, name):
    damaged_format, rng, read = fuzz_seeds.format_named(name), np.random.default_rng(11), 0
    for number in range(40):
        path = fuzz_seeds.write_files(tmp_path / str(number), damaged_format.damaged(rng))
        try:
            expected = load_whole(path)
        except FormatError:
            expected = None
        try:
            found = halves(path)
        except FormatError:
            assert expected is None
            continue
        assert expected is not None
        assert sum(map(len, found)) == len(expected)
        assert_same(found[-1], expected.span(len(found[0]), len(expected)))
        read += 1
    assert read > 0


def halves(path):
    """Read a file in two halves, or in one part if it has a single row."""
    count = io.inspect(path).splats
    with in_parts(path) as read:
        return [read(a, b) for a, b in ((0, count // 2), (count // 2, count)) if a < b]


@pytest.mark.parametrize("degree", [0, 2])
@pytest.mark.parametrize("name", ["a.sog", "meta.json"])
def test_spans_of_sog_textures_equal_the_rows_of_the_whole(tmp_path, name, degree):
    (tmp_path / "model").mkdir()
    path = tmp_path / "model" / name
    io.save(random_splats(700, degree=degree), path, overwrite=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sog, "_ROWS", 64)
        assert_spans(path, some_spans(700, np.random.default_rng(1), 12))


@pytest.mark.parametrize("name", SCENES)
def test_spans_of_real_scenes_equal_the_rows_of_the_whole(name):
    path = scene_path(name)
    count = io.inspect(path).splats
    rng = np.random.default_rng(5)
    spans = [(a, min(a + int(rng.integers(1, 9000)), count)) for a in rng.integers(0, count, 8)]
    assert_spans(path, [*spans, (0, 1), (count - 1, count)])


# ---- memory ---------------------------------------------------------------------------------

MANY, FEW = 400_000, 2000


def large(suffix):
    """Return the bytes of a file of many splats that is quick to make."""
    if suffix == ".splat":
        return bytes(range(1, 33)) * MANY
    if suffix == ".ksplat":
        header, body, model = ksplatfiles.section(40_000, 1, 0, capacity=4)
        return ksplatfiles.ksplat(*[(header, body, model)] * (MANY // 40_000), mode=1)
    if suffix == ".spz":
        head = gzip.decompress(spzfiles.encode([spzfiles.row()], 3))[:16]
        head = head[:8] + MANY.to_bytes(4, "little") + head[12:]
        noise = np.random.default_rng(0).integers(0, 256, MANY * 20, np.uint8)
        return gzip.compress(head + noise.tobytes(), 1)
    raise AssertionError(suffix)


@pytest.mark.parametrize("suffix", [".splat", ".ksplat", ".spz", ".compressed.ply", ".ply"])
def test_a_span_takes_no_memory_for_the_rest(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    if suffix.endswith(".ply"):
        (tmp_path / "a.splat").write_bytes(large(".splat"))
        splats = io.load(tmp_path / "a.splat")
        splats.log_scales[:] = splats.quats[:, :3] = splats.means[:] = 1
        splats.sh[:] = 0
        io.save(splats, path)
    else:
        path.write_bytes(large(suffix))
    tracemalloc.start()
    with in_parts(path) as read:
        _, unpacking = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        before, _ = tracemalloc.get_traced_memory()
        for start in (0, MANY // 2 + 77, MANY - FEW):
            assert len(read(start, start + FEW)) == FEW
        _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak - before < 2_500_000
    source = io.open(path)
    assert unpacking < (source.memory if isinstance(source, Packed) else 1_000_000)
