"""Input files of all formats in blocks: results have the bytes of those for a binary `.ply`."""

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
from nanogs import io
from nanogs.errors import FormatError, OptionError
from nanogs.io.sog import read as sog
from nanogs.io.spz import read as spz
from nanogs.pipeline import run, stages
from nanogs.pipeline.in_blocks import plan_job
from nanogs.pipeline.job import rows as source
from nanogs.pipeline.job.inputs import check_unchanged, input_file
from nanogs.pipeline.options.settings import Access
from nanogs.pipeline.options.target import Goal
from nanogs.pipeline.request import Request
from nanogs.pipeline.tasks.unpack import Cost
from plyfiles import BASE, ply
from torchfiles import TorchFile

COUNT = 1200
FAST = {"preset": "fast", "block": 500, "threads": 1}
REASSIGNED = {**FAST, "rounds": 1}


def saved(path, splats, **options):
    nanogs.save(splats, path, overwrite=True, **options)
    return path


def text_ply(path, splats):
    values = [*splats.means.T, *splats.sh[:, 0].T, splats.opacity_logits]
    values += [*splats.log_scales.T, *splats.quats.T]
    columns = [(name, "float", column) for name, column in zip(BASE, values, strict=True)]
    path.write_bytes(ply(("vertex", columns), encoding="ascii"))
    return path


def streamed_sog(folder, splats):
    """Write streamed SOG of two files; only some rows of the second are of the finest level."""
    manifest = (
        '{"lodLevels": 1, "filenames": ["0_0/meta.json", "0_1.sog"], "tree": {"children":'
        ' [{"lods": {"0": {"file": 0, "offset": 0, "count": 500}}},'
        ' {"lods": {"0": {"file": 1, "offset": 20, "count": 300}}},'
        ' {"lods": {"0": {"file": 1, "offset": 340, "count": 310}}}]}}'
    )
    (folder / "0_0").mkdir()
    saved(folder / "0_0" / "meta.json", splats.span(0, 500))
    saved(folder / "0_1.sog", splats.span(500, COUNT).with_sh_degree(0))
    (folder / "lod-meta.json").write_text(manifest)
    return folder / "lod-meta.json"


def ksplat_file(path):
    parts = [ksplatfiles.section(n, 1, 1, capacity=7, seed=n) for n in (700, 3, 500)]
    path.write_bytes(ksplatfiles.ksplat(*parts, mode=1))
    return path


WRITERS = {
    ".splat": lambda folder, splats: saved(folder / "a.splat", splats),
    ".compressed.ply": lambda folder, splats: saved(folder / "a.compressed.ply", splats),
    ".npz": lambda folder, splats: saved(folder / "a.npz", splats),
    ".spz v3": lambda folder, splats: saved(folder / "a.spz", splats),
    ".spz v4": lambda folder, splats: saved(
        folder / "a.spz", splats, format_options={"spz_version": 4}
    ),
    ".glb": lambda folder, splats: saved(folder / "a.glb", splats),
    ".sog": lambda folder, splats: saved(folder / "a.sog", splats),
    "meta.json": lambda folder, splats: saved(folder / "meta.json", splats),
    "lod-meta.json": streamed_sog,
    ".ksplat": lambda folder, splats: ksplat_file(folder / "a.ksplat"),
    "text": lambda folder, splats: text_ply(folder / "a.ply", splats.with_sh_degree(0)),
}


@pytest.fixture(scope="module")
def splats():
    return random_splats(COUNT)


@pytest.fixture
def few_rows(monkeypatch):
    """Let the stage `units` sample only a few rows, as it does for large models."""
    monkeypatch.setattr(source, "_MOST_RUNS", 3)
    monkeypatch.setattr(source, "RUN_ROWS", 64)


@pytest.fixture
def packed(splats, tmp_path):
    """A file of a format that is unpacked first."""
    return saved(tmp_path / "a.spz", splats)


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("name", WRITERS)
def test_every_format_gives_the_bytes_of_the_same_model_as_ply(tmp_path, splats, name, few_rows):
    (tmp_path / "in").mkdir()
    path = WRITERS[name](tmp_path / "in", splats)
    before = names_in(tmp_path / "in")
    plain = saved(tmp_path / "plain.ply", nanogs.load(path))
    found, expected = tmp_path / "found.ply", tmp_path / "expected.ply"
    report = nanogs.simplify_blocks(path, found, ratio=0.3, **REASSIGNED)
    nanogs.simplify_blocks(plain, expected, ratio=0.3, **REASSIGNED)
    assert report.blocks.blocks > 2
    assert found.read_bytes() == expected.read_bytes()
    assert names_in(tmp_path) == ["expected.ply", "found.ply", "in", "plain.ply"]
    assert names_in(tmp_path / "in") == before


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kitchen.spz", "chair.splat"])
def test_a_real_scene_gives_the_bytes_of_its_converted_file(tmp_path, name):
    origin, plain = scene_path(name), tmp_path / "plain.ply"
    run_command("convert", origin, plain, "-q")
    outs = [tmp_path / "found.ply", tmp_path / "expected.ply"]
    for path, out in zip((origin, plain), outs, strict=True):
        nanogs.simplify_blocks(path, out, ratio=0.05, **FAST | {"block": 40_000})
    assert outs[0].read_bytes() == outs[1].read_bytes()


def test_files_with_different_access_are_joined(tmp_path, splats, few_rows):
    """One is read in parts, two are packed, of which one is unpacked, and one is read whole."""
    inputs = [
        saved(tmp_path / "a.splat", splats.with_sh_degree(0)),
        saved(tmp_path / "b.spz", random_splats(900, seed=1)),
        saved(tmp_path / "c.sog", random_splats(400, seed=2)),
        tmp_path / "d.pt",
    ]
    last = random_splats(300, degree=0, seed=3)
    trained = {name: getattr(last, name) for name in ("means", "quats")}
    trained |= {"scales": last.log_scales, "opacities": last.opacity_logits, "sh0": last.sh}
    inputs[-1].write_bytes(TorchFile({"splats": trained}).bytes())
    settings = planned(*inputs)[0]
    access = [file.access for file in settings.inputs]
    assert access == [Access.ROWS, Access.PACKED, Access.PACKED, Access.WHOLE]
    assert settings.unpacked == (1,)
    plain = [saved(path.with_suffix(".ply"), nanogs.load(path)) for path in inputs]
    outs = [tmp_path / "found.ply", tmp_path / "expected.ply"]
    for paths, out in zip((inputs, plain), outs, strict=True):
        report = nanogs.simplify_blocks(paths, out, ratio=0.3, **REASSIGNED)
    assert report.input_count == COUNT + 900 + 400 + 300
    assert outs[0].read_bytes() == outs[1].read_bytes()


def test_a_symbolic_link_is_read_by_its_own_suffix(tmp_path, splats):
    """As in caches, where files are named by their checksums."""
    for suffix in (".ply", ".spz"):
        blob, link = tmp_path / f"blob{suffix[1:]}", tmp_path / f"a{suffix}"
        blob.write_bytes(saved(tmp_path / f"b{suffix}", splats).read_bytes())
        link.symlink_to(blob)
        outs = [tmp_path / "small.ply", tmp_path / "expected.ply"]
        for path, out in zip((link, tmp_path / f"b{suffix}"), outs, strict=True):
            nanogs.simplify_blocks(path, out, ratio=0.3, overwrite=True, **FAST)
        assert outs[0].read_bytes() == outs[1].read_bytes()


def test_notes_about_parts_are_combined_into_one(tmp_path):
    row = np.zeros(COUNT, [("f", "<f4", 6), ("b", "u1", 8)])
    row["f"] = np.random.default_rng(0).uniform(0.1, 1, (COUNT, 6))
    row["b"] = 200
    row["f"][[3, 700, 1100], 4] = -1
    (tmp_path / "a.splat").write_bytes(row.tobytes())
    report = nanogs.simplify_blocks(tmp_path / "a.splat", tmp_path / "b.ply", ratio=0.3, **FAST)
    assert report.dropped_nonfinite == 3
    assert report.notes == ("3 splats have a negative scale, which became NaN.",)


# ---- resuming and damage --------------------------------------------------------------------


def crash_at(monkeypatch, stage, times=1):
    """Interrupt the run before a task of a stage; return the list of stages that were begun."""
    do, called = stages.do, []

    def crash(context, task):
        called.append(task.stage)
        if task.stage == stage and called.count(stage) <= times:
            raise CrashError
        return do(context, task)

    monkeypatch.setattr(run, "do", crash)
    return called


@pytest.mark.parametrize("stage", ["unpack", "units", "segment", "store"])
def test_an_interrupted_job_gives_the_same_bytes(packed, tmp_path, monkeypatch, stage):
    out, expected = tmp_path / "small.ply", tmp_path / "expected.ply"
    nanogs.simplify_blocks(packed, expected, ratio=0.3, **REASSIGNED)
    called = crash_at(monkeypatch, stage)
    with pytest.raises(CrashError):
        nanogs.simplify_blocks(packed, out, ratio=0.3, resume=True, **REASSIGNED)
    tables = sorted((tmp_path / "small.ply.job" / "scratch").glob("unpack*.npy"))
    assert bool(tables) == (stage != "unpack")
    for path in tables[: stage == "segment"]:  # damaged tables are made again
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
    nanogs.simplify_blocks(packed, out, ratio=0.3, resume=True, **REASSIGNED)
    assert called.count("unpack") == (2 if stage in ("unpack", "segment") else 1)
    assert out.read_bytes() == expected.read_bytes()


@pytest.mark.parametrize("name", [".spz v3", "lod-meta.json"])
@pytest.mark.parametrize("stage", ["unpack", "segment"])
def test_a_file_that_changes_during_the_job_is_refused(tmp_path, splats, monkeypatch, name, stage):
    path, do = WRITERS[name](tmp_path, splats), stages.do
    changing = path if name != "lod-meta.json" else tmp_path / "0_0" / "quats.webp"

    def change(context, task):
        if task.stage == stage:
            os.utime(changing, (1, 2_000_000_000))
        return do(context, task)

    monkeypatch.setattr(run, "do", change)
    with pytest.raises(FormatError, match="has changed since the job began"):
        nanogs.simplify_blocks(path, tmp_path / "small.ply", ratio=0.3, **FAST)


def test_a_file_that_cannot_be_read_any_more_is_refused_with_the_reason(
    tmp_path, splats, monkeypatch
):
    path, do = tmp_path / "scene.ply", stages.do
    nanogs.save(splats, path)

    def damage(context, task):
        if task.stage == "segment":
            path.write_bytes(path.read_bytes()[:40])
        return do(context, task)

    monkeypatch.setattr(run, "do", damage)
    with pytest.raises(FormatError, match=r"changed since .*, or cannot be read here: .*header"):
        nanogs.simplify_blocks(path, tmp_path / "small.ply", ratio=0.3, **FAST)


def test_a_file_that_changes_while_it_is_unpacked_is_refused(packed, tmp_path, monkeypatch):
    real = spz.body_pieces

    def pieces_then_touch(*given):
        yield from real(*given)
        os.utime(packed, (1, 1))

    monkeypatch.setattr(spz, "body_pieces", pieces_then_touch)
    with pytest.raises(FormatError, match="has changed since the job began"):
        nanogs.simplify_blocks(packed, tmp_path / "small.ply", ratio=0.3, **FAST)
    assert not list((tmp_path / "small.ply.job" / "scratch").glob("unpack*.json"))  # its record


def test_a_file_that_changes_while_its_rows_are_read_is_refused(tmp_path, splats):
    path = tmp_path / "scene.ply"
    nanogs.save(splats, path)
    settings, _ = planned(path)

    def read_and_touch():
        with source.opened(settings) as scene:
            scene.read(0, 10)
            os.utime(path, (1, 1))

    with pytest.raises(FormatError, match="has changed since the job began"):
        read_and_touch()


def test_a_part_of_a_model_with_another_size_is_refused(tmp_path, splats):
    path = WRITERS["lod-meta.json"](tmp_path, splats)
    file, part = input_file(io.open(path)), tmp_path / "0_0" / "quats.webp"
    before = part.stat()
    check_unchanged(file)
    part.write_bytes(part.read_bytes() + b"\0")
    os.utime(part, ns=(before.st_atime_ns, before.st_mtime_ns))
    with pytest.raises(FormatError, match="has changed since the job began"):
        check_unchanged(file)


def damaged(name, folder, splats):
    """Write a file whose header is intact and whose data are damaged."""
    path = WRITERS[name](folder, splats)
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
def test_a_damaged_file_is_refused_in_one_sentence(tmp_path, splats, name):
    path = damaged(name, tmp_path, splats)
    with pytest.raises(FormatError) as caught:
        nanogs.simplify_blocks(path, tmp_path / "small.ply", ratio=0.3, **FAST)
    assert len(str(caught.value).splitlines()) == 1
    assert not (tmp_path / "small.ply").exists()


def test_the_command_reports_a_damaged_file(tmp_path):
    splats = random_splats(60_000, degree=0)
    path = damaged(".spz v3", tmp_path, splats)
    result = run_command("simplify", path, tmp_path / "b.ply", "-r", "0.1", "--preset", "fast",
                         "--max-memory", "260MB")  # fmt: skip
    assert result.returncode == 2
    assert "the columns end before 60,000 splats" in " ".join(result.stderr.split())
    assert "Traceback" not in result.stderr


# ---- planned memory and disk space ----------------------------------------------------------


def planned(*paths, block=500, memory=None):
    options = {"output": paths[0], "preset": "fast", "block": block, "max_memory": memory}
    return plan_job(Request(goal=Goal(ratio=0.3), inputs=paths, **options))


@pytest.mark.parametrize(
    ("name", "row"), [(".spz v3", 20 + 9), (".splat", 0), (".npz", 4 * 23), (".sog", 19)]
)
def test_the_plan_includes_the_disk_space_of_unpacked_files(tmp_path, splats, name, row):
    path = WRITERS[name](tmp_path, splats)
    degree = 0 if name == ".splat" else 1
    plain = saved(tmp_path / "plain.ply", splats.with_sh_degree(degree))
    more = planned(path)[1].scratch - planned(plain)[1].scratch
    palette = more - row * COUNT
    assert palette == 0 if name != ".sog" else 0 < palette < 100_000
    assert planned(path, block=COUNT)[1].scratch == planned(plain, block=COUNT)[1].scratch


def test_textures_too_large_for_the_memory_are_refused(tmp_path, splats, monkeypatch):
    path = WRITERS[".sog"](tmp_path, splats)
    monkeypatch.setattr(sog, "_TEXEL", 1 << 20)
    assert planned(path)[1].memory > (1 << 20) * COUNT
    with pytest.raises(OptionError, match=r"at least 643 MB to unpack a\.sog; allow more, or"):
        planned(path)[1].unpacking(Cost(0, 400_000_000, "a.sog"), 500_000_000)
