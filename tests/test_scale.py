"""Models in blocks: exact counts, one error threshold, and bytes that do not depend on the run."""

import errno
import hashlib
import json
import os
import shutil
import signal
from dataclasses import asdict, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import nanogs
from builders import model_bytes, random_splats
from crashes import CrashError
from nanogs import filters
from nanogs.errors import (
    NONE_USABLE,
    FormatError,
    ModelError,
    NanogsError,
    OptionError,
    OutputError,
)
from nanogs.memory import LIBRARIES
from nanogs.method.nodes import Nodes, immense_weight
from nanogs.method.parameters import ForestParameters
from nanogs.method.reassign import NEIGHBOURS
from nanogs.pipeline import run, stages
from nanogs.pipeline.estimates.block_plan import held_bytes, plan_blocks
from nanogs.pipeline.job import cluster, rows
from nanogs.pipeline.job.folder import (
    LOCK,
    MANIFEST,
    RESULT,
    locked,
    read_manifest,
    write_manifest,
)
from nanogs.pipeline.one_block import OneBlock, whole_settings
from nanogs.pipeline.options.presets import PRESETS
from nanogs.pipeline.options.settings import (
    MOST_HALO,
    Access,
    FilterCounts,
    InputFile,
    Segment,
    Settings,
    differences,
    in_words,
)
from nanogs.pipeline.options.views import RequestedViews, plain_camera
from nanogs.pipeline.tasks.blocks import leaves_of
from nanogs.pipeline.tasks.budget import budget
from nanogs.pipeline.tasks.cuts import CENTRES, LABELS, REACH, write_cut
from nanogs.pipeline.tasks.forests import BINS, histogram_of, keys, passes_of, scores_of
from nanogs.pipeline.tasks.halo import REACHES, find_halo, near_groups
from nanogs.pipeline.tasks.partition import partition
from nanogs.pipeline.tasks.reassigning import keep_every_group
from nanogs.pipeline.tasks.sorted_segments import DIGEST
from nanogs.pipeline.tasks.units import Units, find_units
from nanogs.pipeline.tasks.unpack import Cost
from nanogs.report import PassReport
from nanogs.source import Layout, Source
from nanogs.store.columns import CODES
from nanogs.store.scratch import FolderScratch, open_scratch
from nanogs.store.tables import (
    Record,
    Table,
    read_column,
    read_record,
    verified,
    write_table,
)
from nanogs.threads import most_threads
from nanogs.views.automatic import automatic_cameras
from torchfiles import TorchFile

FAST = {"preset": "fast", "block": 400, "threads": 1}
REASSIGNED = {**FAST, "rounds": 2}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """1,200 splats in a file, with a column that nanogs does not know."""
    label = np.arange(1200, dtype=np.int32)
    path = tmp_path_factory.mktemp("scene") / "scene.ply"
    nanogs.save(random_splats(1200, extras={"label": label}), path)
    return path


@pytest.fixture(scope="module")
def expected(scene, tmp_path_factory):
    """The bytes of the result for the scene."""
    path = tmp_path_factory.mktemp("expected") / "small.ply"
    nanogs.simplify_blocks(scene, path, ratio=0.3, **REASSIGNED)
    return path.read_bytes()


def names_in(folder):
    """Names of the entries of a folder."""
    return [path.name for path in folder.iterdir()]


def settings(block, segments, **changes):
    """Return the settings of a job whose segments have the given numbers of rows."""
    rows = sum(segments)
    bounds = np.cumsum([0, *segments])
    arguments = {
        "inputs": (InputFile("scene.ply", 1, 1, rows, Access.ROWS),),
        "layout": Layout(0, False, (), "default", (), ()),
        "segments": tuple(Segment(int(a), int(b)) for a, b in pairwise(bounds)),
        "ratios": (0.3,),
        "counts": (),
        "nan": "drop",
        "block": block,
        "parameters": ForestParameters(),
    }
    return Settings(**(arguments | changes))


# ---- parts ----------------------------------------------------------------------------------


def planned(path, block=1000, **changes):
    """Return the settings of a job on one file."""
    with nanogs.open(path) as source:
        inputs, count = (rows.input_file(source),), source.count
    return settings(block, [count], inputs=inputs, **changes)


@pytest.mark.parametrize("cameras", [0, 3, 70])
def test_splats_weigh_as_much_in_blocks_as_in_memory(tmp_path, cameras):
    """Also with a user's cameras, of which 64 at most are used; and far from the origin."""
    model = random_splats(900)
    model.means[:] += np.float32([300, -200, 100])
    model.log_scales[::7] = -80  # points, which are given a least thickness
    views = automatic_cameras(model, cameras, width=48, height=48) if cameras else []
    asked = RequestedViews(cameras=tuple(json.dumps(plain_camera(each)) for each in views))
    nanogs.save(model, tmp_path / "scene.ply")
    job = planned(tmp_path / "scene.ply", parameters=PRESETS["fast"], asked=asked)
    units = find_units(job)
    whole = replace(whole_settings(model, PRESETS["fast"]), asked=asked)
    held = OneBlock(model, np.arange(900, dtype=np.int32), whole, 1)
    held.find_units("units")
    held.grow("grow", 0)
    leaves = leaves_of(model, held.placement.rows, units)
    np.testing.assert_allclose(leaves.weights, held._leaves.weights, rtol=1e-12)
    np.testing.assert_allclose(leaves.covariances, held._leaves.covariances, rtol=1e-12)
    if cameras:
        used = [views[(2 * place + 1) * cameras // (2 * min(cameras, 64))]
                for place in range(min(cameras, 64))]  # fmt: skip
        places = [camera.position - units.centre() for camera in used]
        np.testing.assert_allclose(units.viewers().places, places, rtol=1e-12)
    else:
        assert units.places == ()
    assert units.immense == pytest.approx(immense_weight(leaves.weights * units.prominence))


def test_a_scene_far_from_the_origin_is_divided_as_a_near_one(tmp_path):
    near = random_splats(600)
    near.means[:] = np.round(near.means * 256) / 256  # so that moving rounds nothing
    far = replace(near, means=near.means + np.float32([1024, -512, 64]))
    codes = []
    for name, model in (("near", near), ("far", far)):
        nanogs.save(model, tmp_path / f"{name}.ply")
        codes.append(find_units(planned(tmp_path / f"{name}.ply")).codes(model))
    assert np.array_equal(*codes)
    assert len(np.unique(codes[0])) > 590


@pytest.mark.parametrize(
    ("count", "bounds"), [(99, [0, 49, 99]), (100, [0, 50, 100]), (101, [0, 33, 67, 101])]
)
def test_segments_are_about_equal_and_no_larger_than_allowed(count, bounds):
    assert rows.segments_of(count, 50) == tuple(Segment(*pair) for pair in pairwise(bounds))


@pytest.mark.parametrize(("block", "left"), [(100, 16_384), (10**6, 262_144)])
def test_samples_are_as_large_as_a_block_within_limits(tmp_path, block, left):
    count = 5 * left // 4  # so every other run is read
    model = random_splats(count, degree=0)
    nanogs.save(model, tmp_path / "scene.ply")
    found = rows.sample(planned(tmp_path / "scene.ply", block))
    taken = np.flatnonzero(np.arange(count) // rows.RUN_ROWS % 2 == 0)
    assert np.array_equal(found.means, model.means[taken])


@pytest.mark.parametrize(
    ("span", "wanted", "reads"),
    [(32, 30_000, 4), (32, 6000, 4), (32, 900, 28), (7, 4000, 4), (9000, 1, 1)],
)
def test_samples_are_evenly_spread_runs_of_usable_rows(tmp_path, monkeypatch, span, wanted, reads):
    model = random_splats(25_000)
    model.means[::5] = np.nan
    nanogs.save(model, tmp_path / "scene.ply")
    job, done = planned(tmp_path / "scene.ply"), []
    monkeypatch.setattr(
        rows.Joined, "read", lambda self, *ends: done.append(ends) or Source.read(self, *ends)
    )
    found = rows.sample(job, rows=wanted, span=span)
    starts = range(0, 25_000, span * -(-25_000 // wanted))
    runs = [np.arange(start, min(start + span, 25_000)) for start in starts]
    expected = model.take(np.concatenate(runs))
    np.testing.assert_array_equal(found.means, expected.means[expected.finite()])
    assert len(done) == reads


def test_tables_return_their_rows_and_detect_a_changed_byte(tmp_path, monkeypatch):
    monkeypatch.setattr("nanogs.store.scratch._CHUNK", 1 << 16)  # hashed in several pieces
    scratch = FolderScratch(tmp_path)
    wide = np.arange(300_000, dtype=np.float32).reshape(-1, 3)
    record = write_table(scratch, "t", {"n": np.arange(7), "wide": wide}, {"fact": 1})
    assert verified(scratch, "t") == record
    rows = np.array([0, 1, 40_000, 40_002, 99_999])
    with Table(scratch, record) as table:
        out = np.empty((5, 3), np.float32)
        table.take_into("wide", rows, out)
        assert (out == wide[rows]).all()
        assert (table.read("n", 2, 4) == [2, 3]).all()
    data = bytearray((tmp_path / "t.1.npy").read_bytes())
    data[-1000] ^= 1
    (tmp_path / "t.1.npy").write_bytes(data)
    assert verified(scratch, "t") is None
    (tmp_path / "t.1.npy").write_bytes(data[:-1])
    with pytest.raises(FormatError, match=r"t\.1\.npy of the job was cut short; `resume=True`"):
        read_column(scratch, record, "wide")
    (tmp_path / "t.1.npy").unlink()
    assert verified(scratch, "t") is None
    assert (np.load(tmp_path / "t.0.npy") == np.arange(7)).all()
    (tmp_path / "t.json").write_text('{"name": "t"')
    assert read_record(scratch, "t") is None


@pytest.mark.parametrize("kind", ["", "file://", "memory://"])
@pytest.mark.parametrize("existing_parents", [0, 1, 3])
def test_parent_folders_are_removed_only_if_the_job_created_them(tmp_path, kind, existing_parents):
    outer = tmp_path / "a" / "b" / "c"
    if kind:
        files = pytest.importorskip("fsspec").filesystem(kind.partition(":")[0])
        files.makedirs(str(tmp_path), exist_ok=True)
    else:
        files = None
    folders = [tmp_path / "a", tmp_path / "a" / "b", outer]
    exists = files.exists if files else os.path.exists
    for folder in folders[:existing_parents]:
        files.makedir(str(folder)) if files else folder.mkdir()
    scratch = open_scratch(f"{kind}{outer}/nanogs-1")
    scratch.prepare()
    open_scratch(f"{kind}{outer}/nanogs-1").prepare()  # as a resumed run does
    write_table(scratch, "t", {"n": np.arange(7)}, {})
    assert all(exists(str(folder)) for folder in folders)
    scratch.remove()
    assert [exists(str(folder)) for folder in folders] == [
        number < existing_parents for number in range(3)
    ]
    assert exists(str(tmp_path))


def test_writers_of_the_same_file_do_not_disturb_each_other(tmp_path):
    """As when a worker does a task again that another one, taken for lost, is still doing."""
    scratch = FolderScratch(tmp_path)

    def parts():
        yield np.zeros(3, np.uint8)
        scratch.write("a.npy", [np.ones(2, np.uint8)])
        assert (tmp_path / "a.npy").read_bytes() == b"\1\1"

    scratch.write("a.npy", parts())
    assert (tmp_path / "a.npy").read_bytes() == b"\0\0\0"
    assert names_in(tmp_path) == ["a.npy"]


@pytest.mark.parametrize("kind", ["", "memory://"])
def test_what_killed_and_failed_writers_leave_is_removed(tmp_path, kind):
    if kind:
        pytest.importorskip("fsspec")
    scratch = open_scratch(f"{kind}{tmp_path}/scratch")
    exists = scratch.files.exists if kind else os.path.exists
    scratch.prepare()

    def fail():
        yield np.zeros(1, np.uint8)
        raise OutputError("no part of it is kept")

    with pytest.raises(OutputError, match="no part"):
        scratch.write("failed.npy", fail())
    scratch.write("made.npy", [np.ones(2, np.uint8)])
    scratch.write("killed.tmp", [np.ones(2, np.uint8)])
    if not kind:
        assert names_in(tmp_path / "scratch") == ["killed.tmp", "made.npy"]
    scratch.tidy()
    assert not exists(f"{tmp_path}/scratch/killed.tmp")
    assert exists(f"{tmp_path}/scratch/made.npy")
    scratch.write("killed.tmp", [np.ones(2, np.uint8)])
    scratch.remove()
    assert not exists(f"{tmp_path}/scratch")
    scratch.remove()  # nothing is left to remove


def test_a_table_without_columns_has_no_rows(tmp_path):
    scratch = FolderScratch(tmp_path)
    with Table(scratch, write_table(scratch, "t", {}, {"fact": 1})) as table:
        assert len(table) == 0
    with Table(scratch, write_table(scratch, "u", {"n": np.arange(7)}, {})) as table:
        assert len(table) == 7


@pytest.mark.parametrize("kind", ["", "file://"])
def test_a_parent_folder_is_removed_only_if_the_job_created_it(tmp_path, kind):
    if kind:
        pytest.importorskip("fsspec")
    parent = tmp_path / "around"
    for exists_before in (False, True):
        if exists_before:
            parent.mkdir()
        open_scratch(f"{kind}{parent}/nanogs-1").prepare()
        again = open_scratch(f"{kind}{parent}/nanogs-1")  # as a resumed run does
        again.prepare()
        write_table(again, "t", {"n": np.arange(7)}, {})
        again.remove()
        assert [*tmp_path.iterdir()] == [parent] * exists_before
        assert not exists_before or not [*parent.iterdir()]


def test_a_record_with_an_object_dtype_is_treated_as_damaged(tmp_path, monkeypatch):
    scratch = FolderScratch(tmp_path)
    monkeypatch.setattr(scratch, "write", with_object_dtype(scratch.write))
    write_table(scratch, "t", {"n": np.arange(7)}, {})
    assert "|O" in (tmp_path / "t.json").read_text()
    assert read_record(scratch, "t") is None


def with_object_dtype(write):
    """Wrap `write` of a scratch so that records give a column the dtype object."""

    def changed(name, parts):
        if name.endswith(".json"):
            signed = json.loads(next(iter(parts)).tobytes())
            text = signed["record"].replace("<i8", "|O")
            signed = {"record": text, "sha256": hashlib.sha256(text.encode()).hexdigest()}
            parts = [np.frombuffer(json.dumps(signed).encode(), np.uint8)]
        return write(name, parts)

    return changed


@given(st.lists(st.floats(width=32, allow_nan=False), min_size=1))
def test_keys_sort_in_the_order_of_scores(scores):
    scores = np.array(scores, np.float32)
    assert (scores[np.argsort(keys(scores), kind="stable")] == np.sort(scores)).all()


@given(
    st.lists(
        st.lists(st.sampled_from([-2.5, -1.0, 0.0, 1e-30, 1.0, 1.0000001, 7.0]), max_size=12),
        min_size=1,
        max_size=5,
    ),
    st.integers(0, 70),
    st.none() | st.lists(st.sampled_from([0.0, -3.0, 1.5]), min_size=5, max_size=5),
)
def test_the_budget_takes_the_lowest_scores_of_all_blocks(tmp_path_factory, blocks, target, shifts):
    scratch = FolderScratch(tmp_path_factory.mktemp("budget"))
    records, pooled = [], []
    for number, each in enumerate(blocks):
        scores = np.array(sorted(each), np.float32)
        counts = np.bincount(keys(scores) >> 16, minlength=BINS)
        facts = {"splats": len(scores) + 1, "fewest": 1}
        columns = {scores_of(0): scores, histogram_of(0): counts}
        records.append(write_table(scratch, f"f{number}", columns, facts))
        shift = np.float32(shifts[number] if shifts else 0)
        pooled += [(score + shift, number) for score in scores]
    splats = sum(len(each) + 1 for each in blocks)
    merged = [number for _, number in sorted(pooled)[: max(splats - target, 0)]]
    left = [len(each) + 1 - merged.count(number) for number, each in enumerate(blocks)]
    given_shifts = np.array(shifts[: len(blocks)]) if shifts else None
    assert budget(scratch, records, target, shifts=given_shifts) == left


def test_passes_of_blocks_are_added_up():
    """A block that needs fewer passes counts with its last nodes."""

    def record(*passes):
        facts = [
            asdict(PassReport(before, 5 * before, 1, merged, before - merged, cost, {}))
            for before, merged, cost in passes
        ]
        return Record("grow", {}, {"passes": facts})

    forests = [record((10, 4, 0.9), (6, 5, 2.0)), record((3, 2, 0.75)), record()]
    assert passes_of(forests) == (
        PassReport(13, 65, 2, 6, 7, 0.9, {}),
        PassReport(7, 30, 1, 5, 2, 2.0, {}),
    )


@pytest.mark.parametrize(("block", "blocks"), [(4, 67), (15, 15), (25, 9), (40, 6)])
def test_small_blocks_are_as_few_as_their_size_allows(tmp_path, block, blocks):
    """A job with a small block has many segments: all their codes are known then."""
    nanogs.save(random_splats(200), tmp_path / "a.ply")
    report = nanogs.simplify_blocks(
        tmp_path / "a.ply", tmp_path / "b.ply", ratio=0.5, preset="fast", block=block
    )
    assert report.blocks.blocks == blocks
    assert report.achieved_count == 100


@given(
    st.lists(st.integers(0, 300), min_size=1, max_size=6),
    st.integers(20, 200),
    st.sampled_from([50, 1 << 62]),
    st.integers(0, 1000),
)
def test_every_row_is_in_one_block_of_bounded_size(tmp_path_factory, counts, block, spread, seed):
    scratch, rng = FolderScratch(tmp_path_factory.mktemp("parts")), np.random.default_rng(seed)
    job, records, all_codes = settings(block, counts), [], []
    for number, count in enumerate(counts):
        codes = np.sort(rng.integers(0, spread, count).astype(np.uint64))
        columns = {CODES: codes, DIGEST: codes[:: job.rows_per_code]}
        records.append(write_table(scratch, f"s{number}", columns, {"splats": count}))
        all_codes.append(codes)
    if not sum(counts):
        with pytest.raises(ModelError):
            partition(scratch, job, records)
        return
    together = np.unique(np.concatenate(all_codes), return_counts=True)[1].max()
    try:
        found = partition(scratch, job, records)
    except OptionError:
        # Digests count the splats with a code to within as many.
        assert together > block - 2 * job.rows_per_code * len(counts)
        return
    assert found.splats == sum(counts)
    last = -1
    for number in range(found.blocks):
        pieces = found.pieces(number)
        inside = np.concatenate([c[p] for c, p in zip(all_codes, pieces, strict=True)])
        assert 0 < len(inside) <= block + 2 * job.rows_per_code * len(counts)
        assert int(inside.min()) > last
        last = int(inside.max())


@pytest.mark.parametrize("block", [120, 150, 200, 210])
def test_splats_in_one_place_that_fit_into_a_block_are_divided(tmp_path, block):
    splats = random_splats(600)
    splats.means[200:300] = splats.means.mean(axis=0)
    nanogs.save(splats, tmp_path / "a.ply")
    report = nanogs.simplify_blocks(
        tmp_path / "a.ply", tmp_path / "b.ply", ratio=0.5, preset="fast", block=block
    )
    assert report.achieved_count == 300
    assert report.blocks.largest <= block
    with pytest.raises(OptionError, match=r"^100 splats lie in one place"):
        nanogs.simplify_blocks(
            tmp_path / "a.ply", tmp_path / "c.ply", ratio=0.5, preset="fast", block=90
        )


def compact_groups(number, count=400, groups=100):
    """Return nodes in a cube of width 1, the group of each, and centres and reaches of groups."""
    rng = np.random.default_rng(number)
    labels = rng.permutation(np.arange(count) % groups).astype(np.int32)
    places = rng.uniform(size=(groups, 3)) + [number, 0, 0]
    means = places[labels] + rng.normal(0, 0.02, (count, 3))
    weights, rows = rng.uniform(0.1, 3, count), rng.permutation(count).astype(np.int32)
    unused = np.zeros((count, 6)), np.empty((0, 0), np.float32)
    centres = [
        np.average(means[labels == each], axis=0, weights=weights[labels == each])
        for each in range(groups)
    ]
    apart = np.linalg.norm(np.subtract(centres, np.array(centres)[:, None]), axis=2)
    reach = np.sort(apart, axis=1)[:, NEIGHBOURS]  # the first one is the group itself
    return Nodes(weights, weights, means, *unused, rows), labels, np.array(centres), reach


def test_the_halo_has_the_nearest_groups_of_other_blocks(tmp_path):
    scratch, blocks = FolderScratch(tmp_path), [compact_groups(number) for number in range(3)]
    cuts, by_row = [], []
    for number, (leaves, labels, centres, reach) in enumerate(blocks):
        cuts.append(write_cut(scratch, f"cut{number}", leaves, labels, len(centres)))
        by_row.append(labels[np.argsort(leaves.rows)])
        with Table(scratch, cuts[-1]) as table:
            assert table.read(CENTRES) == pytest.approx(centres)
            assert table.read(REACH) == pytest.approx(reach)
            assert np.array_equal(table.read(LABELS), by_row[-1])
    _, _, centres, reach = blocks[1]
    near = []
    for block in (0, 2):
        for group, centre in enumerate(blocks[block][2]):
            distances = np.linalg.norm(centres - centre, axis=1)
            nearest = np.argmin(distances)
            if distances[nearest] < REACHES * reach[nearest]:
                near.append((distances[nearest] / reach[nearest], block, group))
    every = {(each.block, group) for each in near_groups(scratch, cuts, 1) for group in each.groups}
    assert every == {(block, group) for _, block, group in near}
    assert 20 < len(every) < 180
    wanted = {(block, group) for _, block, group in sorted(near)[:15]}
    splats = sum((by_row[block] == group).sum() for block, group in wanted)
    halo = find_halo(scratch, cuts, 1, int(splats / MOST_HALO))
    assert [each.block for each in halo] == [0, 2]
    assert {(each.block, group) for each in halo for group in each.groups} == wanted
    for each in halo:
        rows = np.flatnonzero(np.isin(by_row[each.block], each.groups))
        assert np.array_equal(each.rows, rows)
        assert np.array_equal(each.groups[each.labels], by_row[each.block][rows])


@given(st.integers(1, 8), st.integers(0, 30), st.integers(0, 10_000))
def test_every_group_keeps_at_least_one_member(groups, more, seed):
    rng = np.random.default_rng(seed)
    before = np.concatenate([np.arange(groups), rng.integers(0, groups, more)]).astype(np.int32)
    after = rng.integers(0, groups + 3, len(before)).astype(np.int32)
    moved = after.copy()
    keep_every_group(moved, before, rng.random(len(before)), groups)
    assert len(np.unique(moved[moved < groups])) == groups
    if len(np.unique(after[after < groups])) == groups:
        assert (moved == after).all()


@pytest.mark.parametrize(
    ("before", "after", "weights", "expected"),
    [
        # An empty group takes back its heaviest former member.
        ([0, 0, 1, 2, 2], [1, 1, 1, 2, 2], [1, 5, 9, 3, 4], [1, 0, 1, 2, 2]),
        # But not the last one of another group: then the heaviest that can be spared.
        ([0, 1, 2, 2, 2], [1, 3, 2, 2, 2], [9, 1, 2, 3, 4], [1, 3, 2, 2, 0]),
        # What the first empty group takes, the second cannot take as well.
        ([0, 1, 2], [2, 2, 3], [5, 4, 3], [0, 2, 1]),
    ],
)
def test_empty_groups_are_refilled_with_the_heaviest_that_can_be_spared(
    before, after, weights, expected
):
    moved = np.array(after, np.int32)
    keep_every_group(moved, np.array(before, np.int32), np.array(weights, float), 3)
    assert moved.tolist() == expected


def test_settings_survive_json():
    filtered = FilterCounts((("box", (0.1, 1 / 3)), ("opacity", (0.5,))), (60, 40), (30, 10))
    job = settings(50, [30, 40], counts=(7,), ratios=(), filters=filtered, frame=("rub", "rdf"))
    before = json.loads(json.dumps(job.to_dict()))
    assert differences(before, job) == []
    assert differences(before | {"counts": [8], "asked": None}, job) == ["counts", "asked"]
    assert (job.splats, job.read_count) == (40, 70)


def test_differences_are_named_by_the_options_of_the_user():
    fields = [*settings(50, [30]).to_dict(), "scratch"]
    for field in fields:
        assert in_words([field])
    assert in_words(["segments", "block"]) == "the memory for blocks, or their size"
    assert in_words(["segments", "nan", "block", "filters"]) == "`nan`, the filters"
    assert in_words(["sharing"]) == "the format or `palette`"


@pytest.mark.parametrize(
    ("change", "message"),
    [({"version": 0}, "version"), ({"block": "many"}, "cannot be read"), ({}, "cannot be read")],
)
def test_an_unreadable_manifest_is_refused(tmp_path, change, message):
    write_manifest(tmp_path, settings(50, [30]), "here")
    assert read_manifest(tmp_path)[0]["block"] == 50
    data = json.loads((tmp_path / MANIFEST).read_text())
    data["settings"] = data["settings"] | change if change else {}
    (tmp_path / MANIFEST).write_text(json.dumps(data))
    with pytest.raises(FormatError, match=message):
        read_manifest(tmp_path)


def test_a_manifest_of_another_release_is_refused(tmp_path):
    write_manifest(tmp_path, settings(50, [30]), "here")
    manifest = tmp_path / MANIFEST
    manifest.write_text(manifest.read_text().replace(nanogs.__version__, "0.0.9"))
    with pytest.raises(FormatError, match="another version of nanogs"):
        read_manifest(tmp_path)


def test_blocks_are_as_large_as_memory_allows():
    layout, chosen = Layout(3, False, (), "default", (), ()), ForestParameters()
    plan = plan_blocks(10**8, layout, chosen, (0.1,), 2 * 10**9)
    assert held_bytes(plan.block, 10**8, layout, chosen, 0.1) <= 1.9e9 - LIBRARIES
    assert held_bytes(plan.block + 1, 10**8, layout, chosen, 0.1) > 1.9e9 - LIBRARIES
    assert plan.blocks * plan.block >= 10**8
    with pytest.raises(OptionError, match="at least"):
        plan_blocks(10**8, layout, chosen, (0.1,), 10**8)


def test_the_largest_result_decides_the_memory_of_blocks():
    layout, chosen = Layout(3, False, (), "default", (), ()), PRESETS["default"]
    large, both, small = (
        plan_blocks(10**8, layout, chosen, shares, 2 * 10**9).block
        for shares in ((0.5,), (0.1, 0.5), (0.1,))
    )
    assert large == both < small


def test_each_step_view_and_level_adds_to_the_expected_seconds():
    layout, chosen = Layout(0, False, (), "default", (), ()), PRESETS["default"]

    def seconds(shares=(0.5,), **changes):
        return plan_blocks(10**6, layout, replace(chosen, **changes), shares, None, 10**5).seconds

    usual, levels = seconds(), (0.5, 0.25)
    assert seconds(steps=chosen.steps + 1) > usual
    assert seconds(further=chosen.further + 1) > usual
    assert seconds(views=chosen.views + 1) > usual
    unlooked = {"guided": False, "steps": 0}
    further = seconds(levels, **unlooked) - seconds(**unlooked)
    assert seconds(levels) - usual > 2 * further > 0


def test_a_model_of_few_splats_needs_no_memory_for_a_usual_block():
    layout, chosen = Layout(3, False, (), "default", (), ()), PRESETS["fast"]
    allowed = int((LIBRARIES + 400_000) / 0.95)
    assert plan_blocks(100, layout, chosen, (0.1,), allowed).blocks == 1
    with pytest.raises(OptionError, match="at least"):
        plan_blocks(5000, layout, chosen, (0.1,), allowed)


def test_a_block_larger_than_the_model_takes_no_more_memory_than_one_of_its_size():
    layout, chosen = Layout(3, False, (), "default", (), ()), PRESETS["fast"]
    whole, larger = (
        plan_blocks(5000, layout, chosen, (0.1,), None, block) for block in (5000, 10**6)
    )
    assert larger.memory == whole.memory
    assert (larger.blocks, larger.segment) == (1, 10**6)


def test_blocks_of_a_given_size_are_planned_with_some_room():
    """As blocks differ in size, they are planned a sixteenth smaller than allowed."""
    layout, chosen = Layout(0, False, (), "default", (), ()), PRESETS["fast"]
    plan = plan_blocks(3_750_000, layout, chosen, (0.1,), None, 4_000_000)
    assert (plan.blocks, plan.segment, plan.seconds) == (1, 1 << 21, pytest.approx(3.75 * 6.5))
    assert plan_blocks(3_750_001, layout, chosen, (0.1,), None, 4_000_000).blocks == 2
    levels = plan_blocks(3_750_000, layout, chosen, (0.1, 0.05, 0.01), None, 4_000_000)
    assert levels.seconds == pytest.approx(3.75 * (6.5 + 2 * 2.5))


def test_unpacking_adds_its_files_and_may_decide_the_memory():
    layout, chosen = Layout(0, False, (), "default", (), ()), PRESETS["fast"]
    plan = plan_blocks(5000, layout, chosen, (0.1,), None, 5000)
    large = plan.unpacking(Cost(123, 10**9, "a.spz"), None)
    assert large.memory == LIBRARIES + 10**9
    assert large.scratch == plan.scratch + 123
    for memory in (0, 1):
        assert plan.unpacking(Cost(0, memory, "a.spz"), None) == plan


# ---- whole jobs -----------------------------------------------------------------------------


@pytest.mark.parametrize("preset", [FAST, REASSIGNED])
@pytest.mark.parametrize("count", [1200, 500, 40, 1])
def test_the_count_is_exact(scene, tmp_path, preset, count):
    out = tmp_path / "small.ply"
    report = nanogs.simplify_blocks(scene, out, count=count, **preset)
    small = nanogs.load(out)
    assert len(small) == report.achieved_count == report.asked_count == count
    assert report.stop == "target"
    assert report.blocks.blocks > 2
    assert small.finite().all()
    assert names_in(tmp_path) == ["small.ply"]


def test_splats_keep_their_bytes_if_none_is_merged(scene, tmp_path):
    nanogs.simplify_blocks(scene, tmp_path / "all.ply", ratio=1, **REASSIGNED)
    whole, same = nanogs.load(scene), nanogs.load(tmp_path / "all.ply")
    assert same.extras["label"].dtype == whole.extras["label"].dtype
    assert model_bytes(same.take(np.argsort(same.extras["label"]))) == model_bytes(whole)


def test_one_block_gives_nearly_the_result_of_a_model_in_memory(scene, tmp_path):
    nanogs.simplify_blocks(scene, tmp_path / "one.ply", ratio=0.3, **(FAST | {"block": 10**6}))
    one = nanogs.load(tmp_path / "one.ply")
    whole, _ = nanogs.simplify(nanogs.load(scene), ratio=0.3, preset="fast")
    common = set(map(bytes, one.means)) & set(map(bytes, whole.means))
    assert len(common) > 0.95 * len(whole)


def test_threads_do_not_change_the_bytes(scene, tmp_path, expected):
    options = REASSIGNED | {"threads": min(2, most_threads())}
    report = nanogs.simplify_blocks(scene, tmp_path / "one.ply", ratio=0.3, **options)
    assert (tmp_path / "one.ply").read_bytes() == expected
    assert report.threads == options["threads"]
    divided = report.blocks
    assert (divided.blocks, divided.segments, divided.allowed) == (4, 3, 400)
    assert 300 <= divided.largest < 400


def test_splats_are_reassigned_across_block_borders(scene, tmp_path):
    report = nanogs.simplify_blocks(scene, tmp_path / "a.ply", ratio=0.3, **REASSIGNED)
    assert 0 < report.blocks.handed < report.blocks.seen < 0.11 * 1200
    assert report.reassign_rounds == report.parameters["rounds"]


def test_nonfinite_rows_are_dropped_or_refused(tmp_path):
    splats = random_splats(500)
    splats.means[[3, 77], 1] = np.nan
    nanogs.save(splats, tmp_path / "a.ply")
    report = nanogs.simplify_blocks(tmp_path / "a.ply", tmp_path / "b.ply", ratio=0.5, **FAST)
    assert (report.dropped_nonfinite, report.achieved_count) == (2, 249)
    with pytest.raises(ModelError, match="row 3 "):
        nanogs.simplify_blocks(
            tmp_path / "a.ply", tmp_path / "c.ply", ratio=0.5, nan="error", **FAST
        )


@pytest.mark.parametrize("more", [{}, {"block": 100}])
def test_a_model_of_which_no_row_is_usable_is_refused_and_leaves_no_job(tmp_path, more):
    splats = random_splats(300)
    splats.means[:, 1] = np.nan
    nanogs.save(splats, tmp_path / "a.ply")
    with pytest.raises(ModelError, match=f"^{NONE_USABLE}$"):
        nanogs.simplify_blocks(
            tmp_path / "a.ply", tmp_path / "b.ply", ratio=0.5, preset="fast", **more
        )
    assert names_in(tmp_path) == ["a.ply"]


def test_a_refused_row_of_a_filtered_model_is_counted_among_those_left(tmp_path):
    """Rows of all files together: the filter drops two of three of the first file."""
    first, second = random_splats(600), random_splats(500, seed=1)
    first.opacity_logits[:] = np.where(np.arange(600) % 3, -9, 9)
    second.opacity_logits[:], second.means[77, 1] = 9, np.nan
    for name, model in (("a", first), ("b", second)):
        nanogs.save(model, tmp_path / f"{name}.ply")
    paths, kept = [tmp_path / "a.ply", tmp_path / "b.ply"], [filters.opaque_enough(0.5)]
    with pytest.raises(ModelError, match=r"^Row 277 of those that filters leave holds a NaN"):
        nanogs.simplify_blocks(
            paths, tmp_path / "c.ply", ratio=0.5, nan="error", filters=kept, **FAST
        )


@pytest.mark.parametrize("row", [0, 477])
def test_a_refused_row_is_named_by_its_own_file(tmp_path, row):
    splats = random_splats(500)
    nanogs.save(splats, tmp_path / "a.ply")
    splats.means[row, 1] = np.nan
    nanogs.save(splats, tmp_path / "b.ply")
    paths = [tmp_path / "a.ply", tmp_path / "b.ply"]
    with pytest.raises(ModelError, match=rf"b\.ply: row {row} holds a NaN"):
        nanogs.simplify_blocks(paths, tmp_path / "c.ply", ratio=0.5, nan="error", **FAST)


def test_several_files_of_different_formats_make_one_scene(tmp_path):
    first, second = random_splats(500, degree=2), random_splats(390, degree=1, seed=2)
    nanogs.save(first, tmp_path / "a.ply")
    nanogs.save(second, tmp_path / "b.npz")
    out = tmp_path / "all.ply"
    report = nanogs.simplify_blocks([tmp_path / "a.ply", tmp_path / "b.npz"], out, ratio=1, **FAST)
    small = nanogs.load(out)
    assert (len(small), small.sh_degree, report.input_count) == (890, 2, 890)
    rows = set(map(bytes, small.means))
    assert rows == set(map(bytes, first.means)) | set(map(bytes, second.means))
    assert any("SH degrees differ" in note for note in report.notes)


def test_files_with_different_render_modes_are_not_joined(tmp_path):
    nanogs.save(random_splats(9), tmp_path / "a.ply")
    mip = replace(random_splats(9), render_mode=nanogs.RenderMode.MIP)
    nanogs.save(mip, tmp_path / "b.ply")
    with pytest.raises(ModelError, match="different render modes"):
        nanogs.simplify_blocks(
            [tmp_path / "a.ply", tmp_path / "b.ply"], tmp_path / "c.ply", ratio=0.5, **FAST
        )


def test_a_file_that_cannot_be_read_in_parts_must_fit_in_a_block(tmp_path):
    splats = random_splats(900)
    trained = {name: getattr(splats, name) for name in ("means", "quats")}
    trained |= {"scales": splats.log_scales, "opacities": splats.opacity_logits}
    trained |= {"sh0": splats.sh[:, :1], "shN": splats.sh[:, 1:]}
    (tmp_path / "a.pt").write_bytes(TorchFile({"splats": trained}).bytes())
    small = tmp_path / "b.ply"
    report = nanogs.simplify_blocks(tmp_path / "a.pt", small, ratio=0.5, **(FAST | {"block": 900}))
    assert report.achieved_count == 450
    with pytest.raises(OptionError, match="not read in parts"):
        nanogs.simplify_blocks(tmp_path / "a.pt", tmp_path / "c.ply", ratio=0.5, **FAST)


def test_results_can_be_written_as_splat_files(scene, tmp_path):
    nanogs.simplify_blocks(scene, tmp_path / "small.splat", ratio=0.3, **FAST)
    assert len(nanogs.load(tmp_path / "small.splat")) == 360


def test_presets_that_need_the_whole_model_are_refused(scene, tmp_path):
    with pytest.raises(OptionError, match="paper"):
        nanogs.simplify_blocks(scene, tmp_path / "a.ply", ratio=0.5, preset="paper", block=100)
    assert names_in(tmp_path) == []


def test_the_scratch_can_be_a_url(scene, tmp_path, expected):
    fsspec = pytest.importorskip("fsspec")
    out = tmp_path / "small.ply"
    nanogs.simplify_blocks(scene, out, ratio=0.3, scratch="memory://job", **REASSIGNED)
    assert out.read_bytes() == expected
    assert not fsspec.filesystem("memory").exists("/job")
    with pytest.raises(OptionError, match="nosuch"):
        open_scratch("nosuch://place")


# ---- resuming -------------------------------------------------------------------------------


def test_a_job_interrupted_at_many_tasks_gives_the_same_bytes(
    scene, tmp_path, expected, monkeypatch
):
    out, folder, do, events = tmp_path / "small.ply", tmp_path / "small.ply.job", stages.do, []

    def crash(*given):
        if len(events) in (0, 1, 3, 6, 9, 12, 17, 20):
            events.append("crash")
            raise CrashError
        events.append("task")
        return do(*given)

    monkeypatch.setattr(run, "do", crash)
    for _ in range(20):
        try:
            report = nanogs.simplify_blocks(scene, out, ratio=0.3, resume=True, **REASSIGNED)
            break
        except CrashError:
            assert (folder / MANIFEST).exists()
            assert not out.exists()
    assert events.count("crash") == 8
    assert report.blocks.resumed > 10
    assert out.read_bytes() == expected
    assert not folder.exists()


def test_damaged_tables_are_made_again(scene, tmp_path, expected, monkeypatch):
    out, folder, do = tmp_path / "small.ply", tmp_path / "small.ply.job", stages.do

    def crash(context, task):
        if task.stage == "store":
            raise CrashError
        return do(context, task)

    monkeypatch.setattr(run, "do", crash)
    with pytest.raises(CrashError):
        nanogs.simplify_blocks(scene, out, ratio=0.3, **REASSIGNED)
    monkeypatch.undo()
    tables = sorted((folder / "scratch").glob("*.npy"))
    for number, path in enumerate(tables):
        data = path.read_bytes()
        path.write_bytes(data[: len(data) // 2] if number % 2 else data[:-1] + b"\xff")
    report = nanogs.simplify_blocks(scene, out, ratio=0.3, resume=True, **REASSIGNED)
    assert out.read_bytes() == expected
    assert report.blocks.resumed < len(tables)


def test_a_run_killed_after_its_output_appeared_is_resumed(scene, tmp_path, expected, monkeypatch):
    from nanogs.pipeline.job import stored as job

    out, folder = tmp_path / "small.ply", tmp_path / "small.ply.job"

    def crash(self, scratch):
        raise CrashError

    monkeypatch.setattr(job.BlockJob, "_remove", crash)
    with pytest.raises(CrashError):
        nanogs.simplify_blocks(scene, out, ratio=0.3, **REASSIGNED)
    monkeypatch.undo()
    assert folder.exists()
    assert out.read_bytes() == expected
    out.write_bytes(b"x" * len(expected))  # another file of the same size
    with pytest.raises(OutputError, match="exists already"):
        nanogs.simplify_blocks(scene, out, ratio=0.3, resume=True, **REASSIGNED)
    out.write_bytes(expected)
    nanogs.simplify_blocks(scene, out, ratio=0.3, resume=True, **REASSIGNED)
    assert out.read_bytes() == expected
    assert not folder.exists()


def test_a_finished_result_is_made_again_for_other_format_options(scene, tmp_path, monkeypatch):
    def crash(*_):
        raise CrashError

    out, options = tmp_path / "a.spz", {"ratio": 0.3, **FAST}
    with monkeypatch.context() as patch:
        patch.setattr("nanogs.sink.InOneFile.move", crash)
        with pytest.raises(CrashError):
            nanogs.simplify_blocks(scene, out, **options)
    options["format_options"] = {"bits": 6}
    nanogs.simplify_blocks(scene, out, resume=True, **options)
    nanogs.simplify_blocks(scene, tmp_path / "b.spz", **options)
    assert out.read_bytes() == (tmp_path / "b.spz").read_bytes()


def leave_interrupted_job(scene, out, monkeypatch, **given):
    """Start a job and interrupt it, which leaves its folder."""

    def crash(context, task):
        raise CrashError

    monkeypatch.setattr(run, "do", crash)
    with pytest.raises(CrashError):
        nanogs.simplify_blocks(scene, out, ratio=0.3, **(REASSIGNED | given))
    monkeypatch.undo()


def test_a_different_or_damaged_job_is_not_resumed(scene, tmp_path, monkeypatch):
    scene_copy, out = tmp_path / "scene.ply", tmp_path / "small.ply"
    scene_copy.write_bytes(scene.read_bytes())
    leave_interrupted_job(scene_copy, out, monkeypatch)
    with pytest.raises(OutputError, match="`resume=True` continues it"):
        nanogs.simplify_blocks(scene_copy, out, ratio=0.3, **REASSIGNED)
    with pytest.raises(OutputError, match=r"differs: the request \(ratio[^)]*\)\);"):
        nanogs.simplify_blocks(
            scene_copy, out, ratio=0.2, resume=True, **(REASSIGNED | {"block": 900})
        )
    far = {"scratch": str(tmp_path / "far")}
    with pytest.raises(OutputError, match=r"differs: `scratch`\)"):
        nanogs.simplify_blocks(scene_copy, out, ratio=0.3, resume=True, **far, **REASSIGNED)
    os.utime(scene_copy, (1, 1))
    with pytest.raises(OutputError, match=r"differs: the input files\)"):
        nanogs.simplify_blocks(scene_copy, out, ratio=0.3, resume=True, **REASSIGNED)
    (tmp_path / "small.ply.job" / MANIFEST).write_text("{")
    with pytest.raises(FormatError, match="cannot be read"):
        nanogs.simplify_blocks(scene_copy, out, ratio=0.3, resume=True, **REASSIGNED)


def test_a_second_run_on_a_locked_folder_is_refused(scene, tmp_path):
    with locked(tmp_path / "job"):
        with pytest.raises(OutputError, match="Another run"):
            nanogs.simplify_blocks(
                scene, tmp_path / "a.ply", ratio=0.3, job=tmp_path / "job", **FAST
            )
        assert (tmp_path / "job" / LOCK).exists()
    assert names_in(tmp_path) == []


def test_an_empty_scratch_left_by_a_killed_run_is_removed_with_its_folder(tmp_path):
    (tmp_path / "job" / "scratch").mkdir(parents=True)
    with locked(tmp_path / "job"):
        pass
    assert names_in(tmp_path) == []


def test_a_lock_whose_file_another_run_has_just_deleted_is_not_taken(tmp_path, monkeypatch):
    """A third run locks the file that has taken its place."""
    fcntl = pytest.importorskip("fcntl")

    def replace_file(*_):
        (tmp_path / "job" / LOCK).unlink()
        (tmp_path / "job" / LOCK).touch()

    monkeypatch.setattr(fcntl, "flock", replace_file)
    with pytest.raises(OutputError, match="Another run is at work"), locked(tmp_path / "job"):
        pass


def test_a_job_folder_with_other_files_is_refused_and_kept(scene, tmp_path):
    (tmp_path / "job").mkdir()
    (tmp_path / "job" / "thesis.txt").write_text("ten years")
    with pytest.raises(OutputError, match="holds other files"):
        nanogs.simplify_blocks(scene, tmp_path / "a.ply", ratio=0.3, job=tmp_path / "job", **FAST)
    assert names_in(tmp_path / "job") == ["thesis.txt"]


@pytest.mark.parametrize("name", ["job", "scratch"])
@pytest.mark.parametrize("inside", ["", "files"])
@pytest.mark.parametrize("kind", ["file", "levels"])
def test_the_files_of_a_job_cannot_be_in_its_output(scene, tmp_path, name, inside, kind):
    simplify = partial(nanogs.simplify_blocks, ratio=0.3)
    make = simplify if kind == "file" else partial(nanogs.write_levels, ratios=[0.3])
    out = tmp_path / ("out.ply" if kind == "file" else "out")
    with pytest.raises(OptionError, match=rf"is the output or in it.* with `{name}`\.$"):
        make(scene, out, **{name: str(out / inside)}, **FAST)
    assert names_in(tmp_path) == []


def test_an_empty_scratch_is_refused(scene, tmp_path):
    with pytest.raises(OptionError, match="`scratch` is empty"):
        nanogs.simplify_blocks(scene, tmp_path / "a.ply", ratio=0.3, scratch="", **FAST)


def test_a_file_in_place_of_the_scratch_folder_is_refused(scene, tmp_path):
    (tmp_path / "file").touch()
    for place in (tmp_path / "file", tmp_path / "file" / "inside"):
        with pytest.raises(OutputError) as refused:
            nanogs.simplify_blocks(scene, tmp_path / "a.ply", ratio=0.3, scratch=place, **FAST)
        assert str(refused.value) == f"{place} is not a folder; name another one with `scratch`."
    assert names_in(tmp_path) == ["file"]


@pytest.mark.parametrize(
    "name",
    ["result-1.ply", "result-x/a.txt", f"{RESULT}s.txt", "scratch/a.npy", "scratch", "lock"],
)
def test_files_that_are_named_like_those_of_a_job_are_kept(scene, tmp_path, name):
    mine = tmp_path / "job" / name
    mine.parent.mkdir(parents=True)
    mine.write_text("ten years")
    with pytest.raises(OutputError, match="holds other files"):
        nanogs.simplify_blocks(scene, tmp_path / "a.ply", ratio=0.3, job=tmp_path / "job", **FAST)
    assert [path for path in (tmp_path / "job").rglob("*") if path.is_file()] == [mine]


def test_a_result_in_the_folder_of_its_job_is_kept(scene, tmp_path):
    """Also where a run that was killed at its end has left files."""
    (tmp_path / "scratch").mkdir()
    (tmp_path / f"{RESULT}.spz").touch()
    nanogs.simplify_blocks(scene, tmp_path / "result-1.ply", ratio=0.3, job=tmp_path, **FAST)
    assert names_in(tmp_path) == ["result-1.ply"]


def test_an_existing_output_is_kept_unless_overwrite_is_set(scene, tmp_path):
    out = tmp_path / "small.ply"
    out.write_text("mine")
    with pytest.raises(OutputError, match="overwrite=True"):
        nanogs.simplify_blocks(scene, out, ratio=0.3, **FAST)
    assert (out.read_text(), names_in(tmp_path)) == ("mine", ["small.ply"])
    nanogs.simplify_blocks(scene, out, ratio=0.3, overwrite=True, **FAST)
    assert len(nanogs.load(out)) == 360


def test_a_job_whose_manifest_cannot_be_written_leaves_no_files(scene, tmp_path, monkeypatch):
    def raise_disk_full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("nanogs.pipeline.job.stored.write_manifest", raise_disk_full)
    with pytest.raises(OSError, match="No space"):
        nanogs.simplify_blocks(
            scene, tmp_path / "a.ply", ratio=0.3, scratch=str(tmp_path / "far"), **FAST
        )
    assert names_in(tmp_path) == []


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="as on Windows")
def test_sigint_is_unblocked_if_no_process_can_be_started(monkeypatch):
    def fail(*_):
        raise OSError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr("nanogs.pipeline.job.cluster.ProcessPoolExecutor.submit", fail)
    with pytest.raises(OSError, match="unavailable"), cluster.processes(1):
        pass
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, set())


def test_a_full_disk_is_reported_and_the_job_can_be_resumed(scene, tmp_path, expected, monkeypatch):
    out = tmp_path / "small.ply"
    real, calls = Path.replace, []

    def replace_or_fail(self, target):
        calls.append(target)
        if len(calls) == 9:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(self, target)

    monkeypatch.setattr(Path, "replace", replace_or_fail)
    with pytest.raises(NanogsError, match="full"):
        nanogs.simplify_blocks(scene, out, ratio=0.3, **REASSIGNED)
    monkeypatch.undo()
    nanogs.simplify_blocks(scene, out, ratio=0.3, resume=True, **REASSIGNED)
    assert out.read_bytes() == expected


def test_too_little_disk_space_is_refused_at_once(scene, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: usage._replace(free=1000))
    with pytest.raises(OutputError, match="`scratch`"):
        nanogs.simplify_blocks(scene, tmp_path / "a.ply", ratio=0.3, **FAST)
    assert names_in(tmp_path) == []


def test_units_survive_json_exactly():
    from nanogs.pipeline.tasks.units import units_of

    anchors = ((0.1, 0.2, 0.3, 1 / 7), (1e-300, 2.0, 3.0, 0.0))
    positions = ((1 / 3, -1e-300, 7.0), (0.1, 0.2, 0.3))
    for viewers, spacing in ((positions, 1 / 7), ((), 0.0)):  # with a user's cameras, and without
        units = Units(
            (0.1, 1 / 3, 1e-300),
            anchors,
            0.2,
            viewers,
            spacing,
            1e-9,
            1 / 7,
            np.inf,
            (-1.1, 0.0, 3.0),
            9.9,
        )
        assert units_of(json.loads(json.dumps(units.to_dict()))) == units
