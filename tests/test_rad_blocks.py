"""Trees of models larger than memory: `.rad` made in blocks, and by interrupted jobs."""

import json
from itertools import pairwise

import numpy as np
import pytest

import nanogs
import radfiles
from builders import random_splats
from crashes import CrashError, crash_at
from launch import run
from nanogs import io, sink
from nanogs.errors import OptionError
from nanogs.levels_of_detail import write_levels
from nanogs.lod.tree_blocks import Linked, joined_trees
from nanogs.metrics import psnr
from nanogs.pipeline import run as scale_run
from nanogs.pipeline import stages
from nanogs.pipeline.estimates.block_plan import plan_blocks
from nanogs.pipeline.job.folder import MANIFEST
from nanogs.pipeline.options.presets import PRESETS
from nanogs.pipeline.tasks.budget import budget
from nanogs.raster.rendering import render
from nanogs.report import StopReason
from nanogs.source import InMemory
from nanogs.source import Layout as Columns
from spark_page import render_in_spark
from test_rad_lod import first_children, root_of, rows_sorted, sheet, tree_of
from test_rad_spark import three_clusters
from views_and_scores import opening_camera

RATIOS = (1, 0.5, 0.25, 0.1)
TREE = "spark tree"


@pytest.fixture(scope="module")
def model():
    return three_clusters(3000)


@pytest.fixture(scope="module")
def scene(model, tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "a.ply"
    io.save(model, path)
    return path


def write(scene, out, ratios=RATIOS, **options):
    settings = {"layout": TREE, "preset": "fast", "block": 700, "threads": 1}
    return write_levels(scene, out, ratios, **(settings | options))


@pytest.fixture(scope="module")
def tree_in_blocks(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("made") / "a.rad"
    return out, *write(scene, out)


def assert_tree(path):
    """Assert that siblings are contiguous and after their parent, and rows have one parent each."""
    counts, starts = tree_of(path)
    inner = np.flatnonzero(counts)
    assert (starts[inner] > inner).all()
    np.testing.assert_array_equal(starts[inner], 1 + np.cumsum(counts[inner]) - counts[inner])
    assert counts.sum() == len(counts) - 1


def test_all_levels_form_one_tree(model, tree_in_blocks):
    path, manifest, reports = tree_in_blocks
    assert reports[0].blocks.blocks > 3
    assert [level.count for level in manifest.levels] == [3000, 1500, 750, 300]
    assert_tree(path)
    source = io.open(path)
    assert source.levels[:4] == (3000, 1500, 750, 300)
    assert source.levels[-1] == 1
    np.testing.assert_array_equal(rows_sorted(source.load().means), rows_sorted(model.means))


def test_each_splat_is_within_the_bounds_of_its_children(tree_in_blocks, scene, tmp_path):
    """Above the blocks, at the roots of the blocks, and below them."""
    write(scene, tmp_path / "further.rad", (1, 0.5, 0.02))
    for path in (tree_in_blocks[0], tmp_path / "further.rad"):
        _, chunks = radfiles.parse_rad(path.read_bytes())
        header, payload = chunks[0]
        entry = next(each for each in header["properties"] if each["property"] == "center")
        data = radfiles.inflated(payload[entry["offset"] : entry["offset"] + entry["bytes"]])
        planes = np.frombuffer(data, np.uint8).reshape(4, 3, -1)
        means = np.ascontiguousarray(np.moveaxis(planes, 0, -1)).view("<f4")[..., 0].T
        counts, starts = tree_of(path)
        for row in np.flatnonzero(counts):
            below = means[starts[row] : starts[row] + counts[row]]
            assert (means[row] >= below.min(axis=0) - 1e-5).all()
            assert (means[row] <= below.max(axis=0) + 1e-5).all()


def test_trees_made_in_blocks_look_like_those_made_in_memory(
    model, scene, tree_in_blocks, tmp_path
):
    """At all levels, also those above the coarsest: blocks leave no visible seams."""
    write(scene, tmp_path / "a.rad", block=None)
    camera = opening_camera(model)
    whole = render(model, camera).shown()
    losses = [
        np.subtract(*(
            psnr(render(nanogs.load(path, level=level), camera).shown(), whole)
            for path in (tmp_path / "a.rad", tree_in_blocks[0])
        ))
        for level in range(len(RATIOS) + 2)
    ]  # fmt: skip
    assert max(losses) < 1.5
    assert np.mean(losses) < 0.5


def test_the_root_of_blocks_is_merged_from_all_leaves():
    splats = sheet(64)
    parts = [InMemory(splats.take(np.arange(start, start + 32))) for start in (0, 32)]
    trees = [Linked().link([part], splats, steps=2) for part in parts]
    root = joined_trees(trees, (), splats).read(0, 1)
    assert root.opacities() == pytest.approx(root_of(splats, 64).opacities(), rel=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_rows_follow_the_order_of_the_roots_of_all_blocks(seed):
    """Blocks and their rows are in no order; sizes differ, and so do the numbers of children."""
    splats, ends = random_splats(120, degree=0, seed=seed), (0, 13, 70, 120)
    parts = [splats.take(np.arange(*pair)) for pair in pairwise(ends)]
    levels = [(InMemory(part), InMemory(part.take(np.arange(4, 13)))) for part in parts]
    tree = joined_trees([Linked().link(each, splats, steps=1) for each in levels], (), splats)
    rows, counts = tree.load().means, tree.children(0, tree.count)
    assert counts.sum() == tree.count - 1
    starts = first_children(counts)
    for row in np.flatnonzero(counts):
        below = rows[starts[row] : starts[row] + counts[row]]
        assert (rows[row] >= below.min(axis=0) - 1e-5).all()
        assert (rows[row] <= below.max(axis=0) + 1e-5).all()
    np.testing.assert_array_equal(rows_sorted(rows[counts == 0]), rows_sorted(splats.means))


def test_no_rows_of_a_tree_have_no_children():
    tree = joined_trees([Linked().link([InMemory(sheet(64))], sheet(64), steps=1)], (), sheet(64))
    for row in (0, 7, tree.count):
        assert tree.children(row, row).tolist() == []
        assert len(tree.read(row, row)) == 0


def test_reading_a_tree_twice_reports_all_of_it():
    steps = []
    linked = [Linked().link([InMemory(sheet(64))], sheet(64), steps=1)]
    tree = joined_trees(linked, (), sheet(64), lambda *step: steps.append(step))
    for rows in ((0, 50), (50, 85)) * 2:
        tree.read(*rows)
    assert tree.count == 85
    assert steps == [(done, 170) for done in (0, 50, 85, 135)]
    tree.read(0, 5)
    tree.read(0, 5)
    assert steps[4:] == [(170, 170)] * 2, "never more than all"


@pytest.mark.slow
@pytest.mark.usefixtures("one_tab")
@pytest.mark.filterwarnings("default")  # the driver's own warnings are not ours
def test_spark_draws_trees_made_in_blocks(model, tree_in_blocks, tmp_path):
    """All splats, or no more than a limit allows, from several levels."""
    camera = opening_camera(model, 160, 120)
    whole = render(model, camera).shown()
    shown, state = render_in_spark(
        tree_in_blocks[0], camera, tmp_path, mesh={"paged": True}, lodRenderScale=0
    )
    assert state["splats"] == 3000
    assert psnr(shown, whole) > 30
    few, state = render_in_spark(
        tree_in_blocks[0], camera, tmp_path, mesh={"paged": True}, lodSplatCount=900
    )
    assert 700 < state["splats"] <= 900
    assert 22 < psnr(few, whole) < psnr(shown, whole)


@pytest.mark.parametrize(
    "ratios", [(1, 0.5, 0.02), (1, 0.5, 0.02, 0.0005), (1, 0.002), (0.01, 0.002), (1,), (0.4,)]
)
def test_levels_may_have_counts_that_blocks_cannot_be_cut_to(model, scene, tmp_path, ratios):
    """Levels of any counts form one tree, even if the forests of blocks cannot be cut to them."""
    manifest, _ = write(scene, tmp_path / "a.rad", ratios)
    expected = [int(np.ceil(3000 * ratio)) for ratio in ratios]
    assert [level.count for level in manifest.levels] == expected
    assert list(io.open(tmp_path / "a.rad").levels[: len(expected)]) == expected
    assert_tree(tmp_path / "a.rad")
    if ratios[0] == 1:
        np.testing.assert_array_equal(
            rows_sorted(io.load(tmp_path / "a.rad").means), rows_sorted(model.means)
        )


def test_a_block_that_has_more_splats_at_a_coarser_level_is_noted(scene, tmp_path, monkeypatch):
    def uneven(scratch, forests, target, *given, **more):
        first, second, *groups = budget(scratch, forests, target, *given, **more)
        moved = 20 if target == 870 else 0
        return [first + moved, second - moved, *groups]

    monkeypatch.setattr(stages, "budget", uneven)
    manifest, reports = write(scene, tmp_path / "a.rad", (1, 0.3, 0.29))
    assert [report.achieved_count for report in reports[:2]] == [3000, 900]
    assert reports[2].asked_count == 870 > reports[2].achieved_count
    assert reports[2].stop is StopReason.TARGET
    levels = io.open(tmp_path / "a.rad").levels
    assert reports[2].achieved_count == manifest.levels[2].count == levels[2]
    said = f"Level 2 of the tree has {levels[2]} splats, not 870"
    assert sum(note.startswith(said) for note in manifest.notes) == 1


@pytest.mark.parametrize("block", [None, 700])
def test_the_little_that_is_left_of_a_fit_is_noted(scene, tmp_path, block):
    fitted = {"preset": "default", "views": 4, "view_size": 64, "block": block}
    for steps in (2, 0):
        out = tmp_path / f"{steps}.rad"
        manifest, _ = write(scene, out, (1, 0.5), steps=steps, **fitted)
        found = [note for note in manifest.notes if "little of the fit of the preset 'def" in note]
        assert len(found) == (1 if steps else 0)


def test_bytes_are_the_same_for_any_number_of_threads_and_workers(scene, tree_in_blocks, tmp_path):
    from concurrent.futures import ThreadPoolExecutor

    write(scene, tmp_path / "b.rad", threads=2)
    with ThreadPoolExecutor(2) as pool:
        write(scene, tmp_path / "c.rad", executor=pool)
    for name in ("b.rad", "c.rad"):
        assert (tmp_path / name).read_bytes() == tree_in_blocks[0].read_bytes()


def test_frame_and_sh_degree_apply_and_extra_columns_are_noted(tmp_path):
    label = {"label": np.arange(900, dtype=np.int32)}
    splats = random_splats(900, degree=2, extras=label)
    io.save(splats, tmp_path / "a.ply")
    options = {"ratios": (1, 0.3), "block": 300, "frame": ("rdf", "rub"), "sh_degree": 1}
    manifest, _ = write(tmp_path / "a.ply", tmp_path / "a.rad", **options)
    assert any("label" in note for note in manifest.notes)
    found = io.load(tmp_path / "a.rad")
    assert found.sh_degree == 1
    turned = splats.means * np.float32([1, -1, -1])
    np.testing.assert_array_equal(rows_sorted(found.means), rows_sorted(turned))


def test_nodes_with_too_many_children_are_refused(monkeypatch, scene, tmp_path):
    monkeypatch.setattr("nanogs.lod.tree.MOST_CHILDREN", 9)
    with pytest.raises(OptionError, match=r"of level 0, .* give more levels between"):
        write(scene, tmp_path / "a.rad", (1, 0.05))
    with pytest.raises(OptionError, match=r"of level 1, .* give more levels between"):
        write(scene, tmp_path / "b.rad", (1, 0.5, 0.005))
    # Nor is a job left, which other levels could not continue.
    assert not list(tmp_path.iterdir())


def test_rows_below_joined_roots_count_as_children_of_a_further_level(monkeypatch):
    """16 roots have 64 rows below them, which become children once the roots are left out."""
    monkeypatch.setattr("nanogs.lod.tree.MOST_CHILDREN", 20)
    linked = [Linked().link([InMemory(sheet(64))], sheet(64), steps=1)]
    with pytest.raises(OptionError, match="of level 1 would stand for 64 of level 0,"):
        joined_trees(linked, [InMemory(sheet(1))], sheet(64))


# Interrupted jobs


@pytest.mark.parametrize("name", ["a.rad", "a.ssog"])
def test_resuming_a_job_that_crashed_anywhere_gives_the_same_bytes(
    scene, tmp_path, monkeypatch, name
):
    """During the tasks, while the file is written, and after it has got its final name."""
    layout = {"a.rad": TREE, "a.ssog": "streamed sog archive"}[name]
    options = {"layout": layout, "chunk": None if layout == TREE else 200, "ratios": (1, 0.1)}
    write(scene, tmp_path / f"whole{name}", **options)
    events, move = [], sink.move_file

    def move_then_crash(*given, **options):
        move(*given, **options)
        if "moved" not in events:
            events.append("moved")
            raise CrashError  # the file has its final name, but its job is not removed yet

    calls = 1, 5, 20, 31, 40, 47, 52
    monkeypatch.setattr(scale_run, "do", crash_at(stages.do, events, *calls))
    for each in ("nanogs.lod.tree_file.write", "nanogs.lod.archive.write_archive"):
        module, _, function = each.rpartition(".")
        before = getattr(__import__(module, fromlist=[function]), function)
        monkeypatch.setattr(each, crash_at(before, events, 1))
    monkeypatch.setattr(sink, "move_file", move_then_crash)
    for _ in range(20):
        try:
            write(scene, tmp_path / name, resume=True, **options)
            break
        except CrashError:
            assert (tmp_path / f"{name}.job" / MANIFEST).exists()
            assert (tmp_path / name).exists() == ("moved" in events)
    assert events.count("crash") >= 7
    assert "moved" in events
    assert (tmp_path / name).read_bytes() == (tmp_path / f"whole{name}").read_bytes()
    assert {path.name for path in tmp_path.iterdir()} == {name, f"whole{name}"}


# Memory, and the command


def test_twenty_million_splats_are_planned_within_two_gigabytes():
    layout = Columns(3, False, (), "default", (), ())
    shares = tuple(0.5**half for half in range(7))
    plan = plan_blocks(20_000_000, layout, PRESETS["fast"], shares, 2 * 10**9, None, Linked())
    assert plan.memory <= 2 * 10**9
    assert 10 < plan.blocks < 20
    plain = plan_blocks(20_000_000, layout, PRESETS["fast"], shares, 2 * 10**9)
    assert plan.seconds - plain.seconds == pytest.approx(sum(shares) * 20 * 9)
    with pytest.raises(OptionError, match="for the file that is written"):
        plan_blocks(20_000_000, layout, PRESETS["fast"], shares, 10**8, None, Linked())


@pytest.mark.parametrize(
    ("row", "shares", "each"),
    [
        (56, (0.5,), 240),  # while all splats of a block are linked
        (56, (0.5, 0.25), 56 + 1.5 * 28 + 1.5 * 100),  # while its layers are joined
        (236, (1, 0.5), 236 + 1.5 * 236 + 2 * 100),  # no block has more splats than all
        (236, (0.1, 0.05), 0.2 * 236 + 1.5 * 0.1 * 236 + 0.3 * 100),
    ],
)
def test_a_block_may_keep_twice_its_share_of_each_level_while_it_is_linked(row, shares, each):
    large, small = (Linked().encoding(row, 0, splats, shares) for splats in (10**8, 1000))
    assert large.each == small.each == pytest.approx(each)
    assert large.described == (1 << 16) * row * 6
    assert small.described == int(2 * sum(shares) * 1000) * row * 6


def test_the_command_makes_trees_in_blocks(tmp_path):
    io.save(random_splats(100_000, degree=0), tmp_path / "a.ply")
    arguments = [
        "lod",
        tmp_path / "a.ply",
        tmp_path / "a.rad",
        "--levels",
        "1,0.1",
        "--preset",
        "fast",
    ]
    arguments += ["--max-memory", "250MB"]
    planned = json.loads(run(*arguments, "--dry-run", "--json").stdout)
    assert planned["blocks"]["blocks"] > 1
    assert planned["blocks"]["memory"] <= 250_000_000
    result = run(*arguments, "--json", "--threads", "1")
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert [level["count"] for level in report["levels"]] == [100_000, 10_000]
    assert report["reports"][0]["blocks"]["blocks"] > 1
    assert {entry.name for entry in tmp_path.iterdir()} == {"a.ply", "a.rad"}
