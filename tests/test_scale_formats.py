"""Models in blocks, of every format: the bytes are those of the same model as a binary `.ply`."""

import gzip
import os

import numpy as np
import pytest

import ksplatfiles
import nanogs
from builders import random_splats
from conftest import scene_path
from crashes import CrashError
from launch import run as run_command
from nanogs.errors import FormatError, OptionError
from nanogs.io.sog import read as sog
from nanogs.io.spz import read as spz
from nanogs.pipeline import run, stages
from nanogs.pipeline.in_blocks import plan_job
from nanogs.pipeline.job import rows as source
from nanogs.pipeline.options.settings import Access
from nanogs.pipeline.options.target import Goal
from nanogs.pipeline.request import Request
from nanogs.pipeline.tasks.unpack import Cost
from plyfiles import BASE, ply
from torchfiles import File

COUNT = 1200
FAST = {"preset": "fast", "block": 500, "threads": 1}
SETTLED = {**FAST, "rounds": 1}


def written(path, splats, **options):
    nanogs.save(splats, path, overwrite=True, **options)
    return path


def text_ply(path, splats):
    values = [*splats.means.T, *splats.sh[:, 0].T, splats.opacity_logits]
    values += [*splats.log_scales.T, *splats.quats.T]
    columns = [(name, "float", column) for name, column in zip(BASE, values, strict=True)]
    path.write_bytes(ply(("vertex", columns), encoding="ascii"))
    return path


def streamed(folder, splats):
    """Two models, of one of which only some rows are of the finest level."""
    manifest = (
        '{"lodLevels": 1, "filenames": ["0_0/meta.json", "0_1.sog"], "tree": {"children":'
        ' [{"lods": {"0": {"file": 0, "offset": 0, "count": 500}}},'
        ' {"lods": {"0": {"file": 1, "offset": 20, "count": 300}}},'
        ' {"lods": {"0": {"file": 1, "offset": 340, "count": 310}}}]}}'
    )
    (folder / "0_0").mkdir()
    written(folder / "0_0" / "meta.json", splats.span(0, 500))
    written(folder / "0_1.sog", splats.span(500, COUNT).with_sh_degree(0))
    (folder / "lod-meta.json").write_text(manifest)
    return folder / "lod-meta.json"


def sections(path):
    made = [ksplatfiles.section(n, 1, 1, capacity=7, seed=n) for n in (700, 3, 500)]
    path.write_bytes(ksplatfiles.ksplat(*made, mode=1))
    return path


MADE = {
    ".splat": lambda folder, splats: written(folder / "a.splat", splats),
    ".compressed.ply": lambda folder, splats: written(folder / "a.compressed.ply", splats),
    ".npz": lambda folder, splats: written(folder / "a.npz", splats),
    ".spz v3": lambda folder, splats: written(folder / "a.spz", splats),
    ".spz v4": lambda folder, splats: written(
        folder / "a.spz", splats, format_options={"spz_version": 4}
    ),
    ".glb": lambda folder, splats: written(folder / "a.glb", splats),
    ".sog": lambda folder, splats: written(folder / "a.sog", splats),
    "meta.json": lambda folder, splats: written(folder / "meta.json", splats),
    "lod-meta.json": streamed,
    ".ksplat": lambda folder, splats: sections(folder / "a.ksplat"),
    "text": lambda folder, splats: text_ply(folder / "a.ply", splats.with_sh_degree(0)),
}


@pytest.fixture(scope="module")
def splats():
    return random_splats(COUNT)


@pytest.fixture
def few(monkeypatch):
    """The frame looks at a few rows, as it does of large models."""
    monkeypatch.setattr(source, "_MOST_SPANS", 3)
    monkeypatch.setattr(source, "SPAN", 64)


@pytest.fixture
def packed(splats, tmp_path):
    """A file that is unpacked first."""
    return written(tmp_path / "a.spz", splats)


def left(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("name", MADE)
def test_the_bytes_are_those_of_the_same_model_as_ply(tmp_path, splats, name, few):
    (tmp_path / "in").mkdir()
    path = MADE[name](tmp_path / "in", splats)
    before = left(tmp_path / "in")
    plain = written(tmp_path / "plain.ply", nanogs.load(path))
    found, expected = tmp_path / "found.ply", tmp_path / "expected.ply"
    report = nanogs.simplify_blocks(path, found, ratio=0.3, **SETTLED)
    nanogs.simplify_blocks(plain, expected, ratio=0.3, **SETTLED)
    assert report.blocks.blocks > 2
    assert found.read_bytes() == expected.read_bytes()
    assert left(tmp_path) == ["expected.ply", "found.ply", "in", "plain.ply"]
    assert left(tmp_path / "in") == before


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kitchen.spz", "chair.splat"])
def test_a_real_scene_comes_out_as_if_it_had_been_converted(tmp_path, name):
    origin, plain = scene_path(name), tmp_path / "plain.ply"
    run_command("convert", origin, plain, "-q")
    outs = [tmp_path / "found.ply", tmp_path / "expected.ply"]
    for path, out in zip((origin, plain), outs, strict=True):
        nanogs.simplify_blocks(path, out, ratio=0.05, **FAST | {"block": 40_000})
    assert outs[0].read_bytes() == outs[1].read_bytes()


def test_files_of_all_kinds_make_one_scene(tmp_path, splats, few):
    """One read in parts, one unpacked, one small enough to be read whole, one that must be."""
    inputs = [
        written(tmp_path / "a.splat", splats.with_sh_degree(0)),
        written(tmp_path / "b.spz", random_splats(900, seed=1)),
        written(tmp_path / "c.sog", random_splats(400, seed=2)),
        tmp_path / "d.pt",
    ]
    last = random_splats(300, degree=0, seed=3)
    trained = {name: getattr(last, name) for name in ("means", "quats")}
    trained |= {"scales": last.log_scales, "opacities": last.opacity_logits, "sh0": last.sh}
    inputs[-1].write_bytes(File({"splats": trained}).bytes())
    settings = planned(*inputs)[0]
    ways = [file.access for file in settings.inputs]
    assert ways == [Access.ROWS, Access.PACKED, Access.PACKED, Access.WHOLE]
    assert settings.unpacked == (1,)
    plain = [written(path.with_suffix(".ply"), nanogs.load(path)) for path in inputs]
    outs = [tmp_path / "found.ply", tmp_path / "expected.ply"]
    for paths, out in zip((inputs, plain), outs, strict=True):
        report = nanogs.simplify_blocks(paths, out, ratio=0.3, **SETTLED)
    assert report.input_count == COUNT + 900 + 400 + 300
    assert outs[0].read_bytes() == outs[1].read_bytes()


def test_a_link_is_read_by_its_own_name(tmp_path, splats):
    """As of caches, whose files are called by their checksums."""
    for suffix in (".ply", ".spz"):
        blob, link = tmp_path / f"blob{suffix[1:]}", tmp_path / f"a{suffix}"
        blob.write_bytes(written(tmp_path / f"b{suffix}", splats).read_bytes())
        link.symlink_to(blob)
        nanogs.simplify_blocks(link, tmp_path / "small.ply", ratio=0.3, overwrite=True, **FAST)


def test_what_is_said_of_parts_becomes_one_sentence(tmp_path):
    row = np.zeros(COUNT, [("f", "<f4", 6), ("b", "u1", 8)])
    row["f"] = np.random.default_rng(0).uniform(0.1, 1, (COUNT, 6))
    row["b"] = 200
    row["f"][[3, 700, 1100], 4] = -1
    (tmp_path / "a.splat").write_bytes(row.tobytes())
    report = nanogs.simplify_blocks(tmp_path / "a.splat", tmp_path / "b.ply", ratio=0.3, **FAST)
    assert report.dropped_nonfinite == 3
    assert report.notes == ("3 splats have a negative scale, which became NaN.",)


# ---- what was begun -------------------------------------------------------------------------


def crash_at(monkeypatch, stage, times=1):
    """Stop before a task of a stage; what was called is kept."""
    do, called = stages.do, []

    def crash(context, task):
        called.append(task.stage)
        if task.stage == stage and called.count(stage) <= times:
            raise CrashError
        return do(context, task)

    monkeypatch.setattr(run, "do", crash)
    return called


@pytest.mark.parametrize("stage", ["unpack", "frame", "segment", "part"])
def test_a_job_that_was_cut_off_gives_the_same_bytes(packed, tmp_path, monkeypatch, stage):
    out, expected = tmp_path / "small.ply", tmp_path / "expected.ply"
    nanogs.simplify_blocks(packed, expected, ratio=0.3, **SETTLED)
    called = crash_at(monkeypatch, stage)
    with pytest.raises(CrashError):
        nanogs.simplify_blocks(packed, out, ratio=0.3, resume=True, **SETTLED)
    tables = sorted((tmp_path / "small.ply.job" / "scratch").glob("unpack*.npy"))
    assert bool(tables) == (stage != "unpack")
    for path in tables[: stage == "segment"]:  # damage is mended
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
    nanogs.simplify_blocks(packed, out, ratio=0.3, resume=True, **SETTLED)
    assert called.count("unpack") == (2 if stage in ("unpack", "segment") else 1)
    assert out.read_bytes() == expected.read_bytes()


@pytest.mark.parametrize("name", [".spz v3", "lod-meta.json"])
@pytest.mark.parametrize("stage", ["unpack", "segment"])
def test_a_file_that_changes_is_not_read_on(tmp_path, splats, monkeypatch, name, stage):
    path, do = MADE[name](tmp_path, splats), stages.do
    changing = path if name != "lod-meta.json" else tmp_path / "0_0" / "quats.webp"

    def change(context, task):
        if task.stage == stage:
            os.utime(changing, (1, 2_000_000_000))
        return do(context, task)

    monkeypatch.setattr(run, "do", change)
    with pytest.raises(FormatError, match="has changed since the job began"):
        nanogs.simplify_blocks(path, tmp_path / "small.ply", ratio=0.3, **FAST)


def test_a_file_that_changes_while_it_is_unpacked_is_not_read_on(packed, tmp_path, monkeypatch):
    real = spz.body_pieces

    def pieces(*given):
        yield from real(*given)
        os.utime(packed, (1, 1))

    monkeypatch.setattr(spz, "body_pieces", pieces)
    with pytest.raises(FormatError, match="has changed since the job began"):
        nanogs.simplify_blocks(packed, tmp_path / "small.ply", ratio=0.3, **FAST)
    assert not list((tmp_path / "small.ply.job" / "scratch").glob("unpack*.json"))  # its record


def damaged(name, folder, splats):
    """A file whose header is whole, and whose rest is not."""
    path = MADE[name](folder, splats)
    if name == "lod-meta.json":
        path = folder / "0_1.sog"
    data = path.read_bytes()
    if name == ".spz v3":
        path.write_bytes(gzip.compress(gzip.decompress(data)[:-1000]))
    else:
        half = len(data) // 2
        path.write_bytes(data[:half] + bytes(200) + data[half + 200 :])
    return folder / "lod-meta.json" if name == "lod-meta.json" else path


@pytest.mark.parametrize("name", [".spz v3", ".spz v4", ".npz", ".sog", "lod-meta.json", "text"])
def test_damage_is_said_in_one_sentence(tmp_path, splats, name):
    path = damaged(name, tmp_path, splats)
    with pytest.raises(FormatError) as caught:
        nanogs.simplify_blocks(path, tmp_path / "small.ply", ratio=0.3, **FAST)
    assert len(str(caught.value).splitlines()) == 1
    assert not (tmp_path / "small.ply").exists()


def test_damage_is_said_by_the_command(tmp_path):
    splats = random_splats(60_000, degree=0)
    path = damaged(".spz v3", tmp_path, splats)
    done = run_command("simplify", path, tmp_path / "b.ply", "-r", "0.1", "--preset", "fast",
                       "--max-memory", "260MB")  # fmt: skip
    assert done.returncode == 2
    assert "the columns end before 60,000 splats" in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr


# ---- what it takes --------------------------------------------------------------------------


def planned(*paths, block=500, memory=None):
    request = Request(goal=Goal(ratio=0.3), inputs=paths, output=paths[0], preset="fast")
    return plan_job(request, memory, block)


@pytest.mark.parametrize(
    ("name", "row"), [(".spz v3", 20 + 9), (".splat", 0), (".npz", 4 * 23), (".sog", 19)]
)
def test_the_plan_counts_what_is_unpacked(tmp_path, splats, name, row):
    path = MADE[name](tmp_path, splats)
    degree = 0 if name == ".splat" else 1
    plain = written(tmp_path / "plain.ply", splats.with_sh_degree(degree))
    more = planned(path)[1].scratch - planned(plain)[1].scratch
    palette = more - row * COUNT
    assert palette == 0 if name != ".sog" else 0 < palette < 100_000
    assert planned(path, block=COUNT)[1].scratch == planned(plain, block=COUNT)[1].scratch


def test_textures_too_large_for_the_memory_are_refused(tmp_path, splats, monkeypatch):
    path = MADE[".sog"](tmp_path, splats)
    monkeypatch.setattr(sog, "_TEXEL", 1 << 20)
    assert planned(path)[1].memory > (1 << 20) * COUNT
    with pytest.raises(OptionError, match=r"at least 643 MB to unpack a\.sog; raise it, or"):
        planned(path)[1].unpacking(Cost(0, 400_000_000, "a.sog"), 500_000_000)
