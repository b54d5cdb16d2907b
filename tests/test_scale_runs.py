"""Models in blocks: the command, killed runs, workers, and borders between blocks."""

import asyncio
import gc
import json
import logging
import os
import random
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import active_children, get_context

import numpy as np
import pytest
from scipy.spatial import cKDTree

import launch
import nanogs
from builders import random_splats
from nanogs.clock import StageClock
from nanogs.errors import ModelError, OptionError, OutputError, UnstorableError
from nanogs.memory import LIBRARIES
from nanogs.pipeline.estimates.block_plan import held_bytes
from nanogs.pipeline.in_blocks import plan_job
from nanogs.pipeline.job import workers
from nanogs.pipeline.job.cluster import connected
from nanogs.pipeline.job.result_writer import result_of
from nanogs.pipeline.options.presets import PRESETS
from nanogs.pipeline.options.target import Goal
from nanogs.pipeline.request import Request
from nanogs.pipeline.run import InProcess, Run, run_tasks
from nanogs.pipeline.stages import do
from nanogs.pipeline.tasks.units import find_units
from nanogs.pipeline.work import Work
from nanogs.progress import Tracker
from nanogs.source import Layout
from nanogs.store.scratch import FolderScratch

COUNT = 60_000
BLOCK = {"preset": "fast", "rounds": 1, "block": 21_000, "threads": 1}


@pytest.fixture(scope="module")
def splats():
    return random_splats(COUNT, degree=0)


@pytest.fixture(scope="module")
def memory():
    """Memory that blocks of a sixth of the scene need, in the syntax of `--max-memory`."""
    layout = Layout(0, False, (), "default", (), ())
    needed = held_bytes(COUNT // 6, COUNT, layout, PRESETS["fast"], 0.1)
    return f"{int((LIBRARIES + needed) / 0.95)}B"


def nanogs_command(*arguments):
    return [sys.executable, "-m", "nanogs", *map(str, arguments)]


def run(*arguments, code=0):
    """Run the command and return its stdout and stderr."""
    result = launch.run(*arguments, timeout=300)
    assert result.returncode == code, result.stderr
    return result.stdout, result.stderr


@pytest.mark.slow
def test_max_memory_changes_nothing_for_a_model_that_fits(scene, tmp_path):
    plain, bounded = tmp_path / "plain.ply", tmp_path / "bounded.ply"
    run("simplify", scene, plain, "--ratio", "0.1", "--preset", "fast", "-q")
    run("simplify", scene, bounded, "--ratio", "0.1", "--preset", "fast", "-q",
        "--max-memory", "1GB")  # fmt: skip
    assert bounded.read_bytes() == plain.read_bytes()


def test_a_model_that_does_not_fit_is_simplified_in_blocks(scene, tmp_path, memory):
    out, quick = tmp_path / "small.ply", ["--preset", "fast"]
    arguments = ["simplify", scene, out, "--ratio", "0.1", "--max-memory", memory, *quick]
    planned = json.loads(run(*arguments, "--dry-run", "--json")[0])["blocks"]
    assert planned["blocks"] > 1
    assert planned["memory"] <= int(memory[:-1])
    report = json.loads(run(*arguments, "--json", "--threads", "1")[0])
    assert report["achieved_count"] == COUNT // 10 == len(nanogs.load(out))
    assert report["blocks"]["blocks"] > 1
    assert [path.name for path in tmp_path.iterdir()] == ["small.ply"]


@pytest.mark.slow
def test_lod_makes_levels_of_a_model_that_does_not_fit(scene, tmp_path, memory):
    arguments = ["lod", scene, tmp_path / "levels", "--levels", "0.2,0.01", "--preset", "fast"]
    run(*arguments, "--max-memory", memory, "-q", "--threads", "1")
    manifest = json.loads((tmp_path / "levels" / "levels.json").read_text())
    assert [level["count"] for level in manifest["levels"]] == [COUNT // 5, COUNT // 100]
    for level in manifest["levels"]:
        assert len(nanogs.load(tmp_path / "levels" / level["file"])) == level["count"]
    assert [path.name for path in tmp_path.iterdir()] == ["levels"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--ratio", "0.1", "--drop-floaters"], "--drop-floaters needs the whole"),
        (["--ratio", "0.1", "--preset", "paper"], "paper needs the whole model"),
        (["--ratio", "0.1", "--max-memory", "100MB"], "is 100 MB and must be at least"),
        (["--ratio", "0.1", "--workers", "2", "--scheduler", "tcp://x:1"], "not both"),
    ],
)
def test_options_that_are_impossible_in_blocks_are_refused(
    scene, tmp_path, memory, options, message
):
    limit = [] if "--max-memory" in options else ["--max-memory", "215MB"]
    _, text = run("simplify", scene, tmp_path / "a.ply", *limit, *options, code=2)
    assert message in " ".join(text.split())
    assert [path.name for path in tmp_path.iterdir()] == []


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--resume", "--preset", "paper"], "--resume divides a model into blocks, but the preset"),
        (["--job", "job", "--drop-floaters"], "--job divides a model into blocks, but --drop-fl"),
        (["--scratch", "s", "--preset", "paper"], "--scratch divides a model into blocks, but"),
    ],
)
def test_a_small_model_is_not_called_too_large_if_an_option_divides_it(scene, tmp_path, more, said):
    _, text = run("simplify", scene, tmp_path / "a.ply", "-r", "0.1", *more, code=2)
    text = " ".join(text.split())
    assert said in text
    assert text.endswith("needs the whole model in memory; leave out one of the two.")


@pytest.mark.parametrize(
    ("wish", "remedy"),
    [
        (["--psnr", "30"], "provide more, or ask for a ratio or a count."),
        (["--draw-cost", "50%"], "provide more, or ask for a ratio or a count."),
        (["-r", "0.1", "--measure"], "provide more, or leave out the measurement."),
    ],
)
def test_measuring_that_does_not_fit_is_refused_with_what_helps(scene, tmp_path, wish, remedy):
    given = ["--max-memory", "215MB", "--preset", "fast", *wish]
    _, text = run("simplify", scene, tmp_path / "a.ply", *given, code=2)
    assert " ".join(text.split()).endswith(remedy)


def test_a_scheduler_that_does_not_answer_is_an_error(scene, tmp_path, monkeypatch, capsys):
    """In this process, so that the timeout can be set to a short time."""
    pytest.importorskip("distributed")
    monkeypatch.setattr("nanogs.pipeline.job.cluster._PATIENCE", 0.4)
    options = ["--ratio", "0.1", "--max-memory", "215MB", "--scheduler", "tcp://127.0.0.1:9"]
    assert launch.run_here("simplify", scene, tmp_path / "a.ply", *options) == 2
    printed = capsys.readouterr().err
    assert "error: No Dask scheduler answers at 'tcp://127.0.0.1:9'" in " ".join(printed.split())
    assert [path.name for path in tmp_path.iterdir()] == []


def test_a_client_that_did_not_connect_is_not_left_to_the_garbage_collector(monkeypatch):
    """Its finaliser takes a lock that the next client may hold at that moment, for ever."""
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr("nanogs.pipeline.job.cluster._PATIENCE", 0.4)

    def clients():
        return {id(each) for each in gc.get_objects() if type(each) is distributed.Client}

    gc.disable()
    try:
        before = clients()
        with pytest.raises(OptionError, match="No Dask scheduler"), connected("tcp://127.0.0.1:9"):
            pass
        end = time.monotonic() + 30
        while clients() - before:
            assert time.monotonic() < end, "the client was not closed"
            time.sleep(0.05)
    finally:
        gc.enable()


@pytest.mark.slow
def test_a_run_that_is_killed_at_any_moment_gives_the_same_bytes(scene, tmp_path, memory):
    out = tmp_path / "small.ply"
    arguments = ["simplify", scene, out, "--ratio", "0.1", "--max-memory", memory, "--resume", "-q"]
    arguments += ["--preset", "fast", "--rounds", "2"]
    start = time.perf_counter()
    # In the same way as those that are killed.
    subprocess.run(nanogs_command(*arguments), check=True)
    whole, expected = time.perf_counter() - start, out.read_bytes()
    out.unlink()
    rng, kills, jobs = random.Random(5), 0, 0
    for _ in range(20):
        child = subprocess.Popen([*nanogs_command(*arguments), "-w"])
        try:
            assert child.wait(rng.uniform(0.3, 0.9) * whole) == 0
            assert out.read_bytes() == expected
            whole *= 0.8  # the machine was busier when the time was measured
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
            kills += 1
            jobs += (tmp_path / "small.ply.job").exists()
        if kills >= 3 and jobs:
            break
    assert kills >= 3
    assert jobs > 0, "no killed run left anything to resume"
    run(*arguments, "-w")
    assert out.read_bytes() == expected
    assert [path.name for path in tmp_path.iterdir()] == ["small.ply"]


# ---- workers --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def client():
    """Two workers of Dask on this machine."""
    distributed = pytest.importorskip("distributed")
    with distributed.Client(
        n_workers=2, threads_per_worker=1, memory_limit=None, dashboard_address=None,
        set_as_default=False, silence_logs=logging.CRITICAL,
    ) as client:  # fmt: skip
        yield client


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_workers_give_the_same_bytes_even_if_one_is_lost(scene, tmp_path, client):
    local, remote = tmp_path / "here.ply", tmp_path / "there.ply"
    nanogs.simplify_blocks(scene, local, ratio=0.1, **BLOCK)
    workers = set(client.run(os.getpid).values())
    steps = []

    def progress(step):
        steps.append((step.stage, step.done, step.parts))
        if (step.stage, step.done) == ("grow", 1):
            os.kill(workers.pop(), signal.SIGKILL)

    nanogs.simplify_blocks(scene, remote, ratio=0.1, executor=client, progress=progress, **BLOCK)
    assert len(workers) == 1
    assert remote.read_bytes() == local.read_bytes()
    assert {("segment", 3, 3), ("store", 4, 4)} <= set(steps)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_workers_unpack_files(tmp_path, client):
    path, plain = tmp_path / "a.spz", tmp_path / "plain.ply"
    nanogs.save(random_splats(COUNT, degree=0), path)
    nanogs.save(nanogs.load(path), plain)
    local, remote, steps = tmp_path / "here.ply", tmp_path / "there.ply", []
    nanogs.simplify_blocks(plain, local, ratio=0.1, **BLOCK)
    nanogs.simplify_blocks(path, remote, ratio=0.1, executor=client, progress=steps.append, **BLOCK)
    assert ("unpack", 1, 1) in [(step.stage, step.done, step.parts) for step in steps]
    assert remote.read_bytes() == local.read_bytes()


@pytest.mark.slow
def test_a_job_of_a_process_pool_can_be_resumed_after_a_process_was_lost(scene, tmp_path):
    local, remote = tmp_path / "here.ply", tmp_path / "there.ply"
    nanogs.simplify_blocks(scene, local, ratio=0.1, **BLOCK)
    others = set(active_children())

    def progress(step):
        if (step.stage, step.done) == ("grow", 1):
            (set(active_children()) - others).pop().kill()

    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        options = {"ratio": 0.1, "executor": pool, **BLOCK}
        with pytest.raises(OutputError, match=r"^1 worker ended in the middle.* `resume=True`"):
            nanogs.simplify_blocks(scene, remote, progress=progress, **options)
        with pytest.raises(OutputError, match=r"^1 worker ended"):  # the pool stays broken
            nanogs.simplify_blocks(scene, remote, resume=True, **options)
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        report = nanogs.simplify_blocks(scene, remote, resume=True, **options | {"executor": pool})
    assert remote.read_bytes() == local.read_bytes()
    assert report.blocks.resumed >= 5
    assert sorted(path.name for path in tmp_path.iterdir()) == ["here.ply", "there.ply"]


def test_a_wrong_type_of_executor_is_refused(scene, tmp_path):
    with pytest.raises(OptionError, match=r"a Dask client or a concurrent.*, not int"):
        nanogs.simplify_blocks(scene, tmp_path / "a.ply", ratio=0.1, executor=2, **BLOCK)
    assert list(tmp_path.iterdir()) == []


def test_an_executor_that_takes_no_tasks_leaves_no_job(scene, tmp_path):
    shut = ThreadPoolExecutor(1)
    shut.shutdown()
    with pytest.raises(OptionError, match=r"^The executor takes no tasks .*; give one that runs"):
        nanogs.simplify_blocks(scene, tmp_path / "a.ply", ratio=0.1, executor=shut, **BLOCK)
    with ProcessPoolExecutor(1) as broken:
        broken.submit(os._exit, 1).exception()
        with pytest.raises(OutputError, match=r"^1 worker ended .* give a new executor"):
            nanogs.simplify_blocks(scene, tmp_path / "a.ply", ratio=0.1, executor=broken, **BLOCK)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("stage", ["grow", "budget"])
def test_an_executor_that_is_shut_down_meanwhile_is_an_error(scene, tmp_path, stage):
    pool = ThreadPoolExecutor(1)

    def progress(step):
        if step.stage == stage and step.done == 1:
            pool.shutdown(wait=False, cancel_futures=True)

    with pytest.raises(OutputError, match=r"^The executor was shut down.*`resume=True` continues"):
        nanogs.simplify_blocks(
            scene, tmp_path / "a.ply", ratio=0.1, executor=pool, progress=progress, **BLOCK
        )


@pytest.mark.filterwarnings("ignore")
def test_a_client_that_takes_no_tasks_leaves_no_job(scene, tmp_path):
    distributed = pytest.importorskip("distributed")
    alone = {"n_workers": 1, "processes": False, "dashboard_address": None}

    def refused(client, message):
        with pytest.raises(OptionError, match=message):
            nanogs.simplify_blocks(scene, tmp_path / "a.ply", ratio=0.1, executor=client, **BLOCK)

    async def from_a_loop():
        async with distributed.Client(asynchronous=True, **alone) as client:
            refused(client, "^The Dask client is asynchronous; give one that was made without")

    with distributed.Client(**alone) as client:
        pass
    refused(client, "^The Dask client is closed; give one that is connected")
    asyncio.run(from_a_loop())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.filterwarnings("ignore")
def test_an_error_on_a_worker_is_raised_in_the_caller(scene, tmp_path, client):
    scene_copy = tmp_path / "own.ply"
    scene_copy.write_bytes(scene.read_bytes())

    def progress(step):
        if step.stage == "segment" and step.done == 0:
            os.utime(scene_copy, (1, 1))

    with pytest.raises(nanogs.NanogsError, match="has changed since the job began"):
        nanogs.simplify_blocks(
            scene_copy, tmp_path / "a.ply", ratio=0.1, executor=client, progress=progress, **BLOCK
        )


def test_workers_still_busy_when_another_fails_leave_no_files(tmp_path, monkeypatch):
    fsspec = pytest.importorskip("fsspec")
    model, ended = random_splats(900, degree=0), []
    model.means[5] = np.nan
    nanogs.save(model, tmp_path / "a.ply")

    def slow(work, task):
        if task.number:
            time.sleep(0.2)
        do(work, task)
        ended.append(task)

    monkeypatch.setattr(workers, "do", slow)
    options = {"ratio": 0.1, "preset": "fast", "block": 300, "threads": 1, "nan": "error"}
    with ThreadPoolExecutor(2) as pool, pytest.raises(ModelError):
        nanogs.simplify_blocks(
            tmp_path / "a.ply",
            tmp_path / "b.ply",
            executor=pool,
            scratch="memory://left",
            **options,
        )
    assert ended
    assert fsspec.filesystem("memory").find("/left") == []


@pytest.mark.filterwarnings("ignore")
def test_cancelled_tasks_of_dask_are_waited_for_if_they_had_begun(tmp_path, client):
    keys = set()
    tasks = [workers._submit_to(client, keys, write_slowly, tmp_path / str(n)) for n in range(8)]
    while not list(tmp_path.iterdir()):
        time.sleep(0.05)
    assert all(task.cancel() for task in tasks)
    workers._settle(client, keys)
    for path in tmp_path.iterdir():
        assert path.read_text() == "begun, ended"


def write_slowly(path):
    path.write_text("begun")
    time.sleep(0.5)
    path.write_text("begun, ended")


# ---- borders --------------------------------------------------------------------------------


def wall(count=9000, seed=3):
    """A flat wall of small splats, whose colours change slowly and a little at random."""
    rng = np.random.default_rng(seed)
    means = np.zeros((count, 3))
    means[:, :2] = rng.uniform(-1, 1, (count, 2))
    colour = np.sin(4 * means[:, :2]) @ rng.normal(0, 0.7, (2, 3)) + rng.normal(0, 0.1, (count, 3))
    spacing = 2 / np.sqrt(count)
    return nanogs.Splats(
        means=means.astype(np.float32),
        log_scales=np.log(rng.uniform(0.5, 1, (count, 3)) * spacing).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        opacity_logits=np.full(count, 2, np.float32),
        sh=colour.astype(np.float32)[:, None],
    )


def in_blocks(splats, folder, ratio, rounds):
    """Simplify a model in blocks; return the result, and the block of each original splat."""
    nanogs.save(splats, folder / "in.ply")
    options = {"preset": "fast", "overrides": {"rounds": rounds}, "output": folder / "out.ply"}
    request = Request(goal=Goal(ratio=ratio), inputs=(folder / "in.ply",), block=2600, **options)
    settings, _ = plan_job(request)
    scratch, clock = FolderScratch(folder / "scratch"), StageClock()
    scratch.prepare()
    run = Run(InProcess(), clock, resumed=False)
    results = run_tasks(Work(scratch, settings, 1), run, Tracker(None, []))
    partition = results.work.partition
    sizes = [partition.count(block) for block in range(partition.blocks)]
    order = np.argsort(find_units(settings).codes(splats), kind="stable")
    of_block = np.empty(len(splats), np.int64)
    of_block[order] = np.repeat(np.arange(partition.blocks), sizes)
    with result_of(results.work, 0) as result:
        return result.load(), of_block


@pytest.mark.slow
@pytest.mark.parametrize("rounds", [0, 2])
def test_no_seam_shows_between_blocks(tmp_path, rounds):
    """The error near borders is at most a tenth larger than elsewhere."""
    from nanogs.raster.camera import Camera
    from nanogs.raster.rendering import prepare, render

    original = wall()
    small, of_block = in_blocks(original, tmp_path, 0.1, rounds)
    assert of_block.max() >= 3
    pose = np.eye(4)
    pose[2, 3] = 2.0
    camera = Camera(160, 160, 160.0, 160.0, 80.0, 80.0, pose)  # its view is 2 x 2 units wide
    shown, other = (render(prepare(each), camera).shown() for each in (original, small))
    errors = ((shown - other) ** 2).mean(axis=2)[12:-12, 12:-12]
    rows, columns = np.mgrid[12:148, 12:148]
    points = np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], axis=1) / 80 - 1
    _, near = cKDTree(original.means[:, :2]).query(points, 30)  # the splats of about three groups
    border = (of_block[near] != of_block[near[:, :1]]).any(axis=1).reshape(errors.shape)
    assert 0.05 < border.mean() < 0.5
    assert errors[border].mean() < 1.1 * errors[~border].mean()


# Jobs that cannot be done


@pytest.fixture(scope="module")
def holey(tmp_path_factory):
    """A model of 3,000 splats, ten of which have no centre."""
    path, splats = tmp_path_factory.mktemp("holey") / "holey.ply", random_splats(3000, degree=0)
    splats.means[:10] = np.nan
    nanogs.save(splats, path)
    return path


def test_a_size_that_all_usable_splats_fit_into_is_met_in_blocks(holey, tmp_path):
    options = {"size": "10MB", "preset": "fast", "block": 1000}
    report = nanogs.simplify_blocks(holey, tmp_path / "a.ply", **options)
    assert (report.achieved_count, report.dropped_nonfinite) == (2990, 10)
    assert "The whole model fits" in report.notes[0]


@pytest.mark.parametrize("executor", [False, True])
def test_a_count_above_the_usable_splats_leaves_no_job(holey, tmp_path, executor):
    workers = ProcessPoolExecutor(1, mp_context=get_context("spawn")) if executor else None
    message = "The count 2,991 is above the 2,990 usable splats"
    with pytest.raises(OptionError, match=message):
        nanogs.simplify_blocks(
            holey, tmp_path / "a.ply", count=2991, preset="fast", block=1000, executor=workers
        )
    if workers:
        workers.shutdown()
    assert list(tmp_path.iterdir()) == []


def test_a_result_that_its_format_cannot_hold_leaves_no_job(tmp_path):
    splats = random_splats(3000, degree=0)
    splats.means[:] *= np.float32(1e8)
    nanogs.save(splats, tmp_path / "far.ply")
    with pytest.raises(UnstorableError, match="move the model to the origin"):
        nanogs.simplify_blocks(
            tmp_path / "far.ply", tmp_path / "a.spz", ratio=0.5, preset="fast", block=1000
        )
    assert [path.name for path in tmp_path.iterdir()] == ["far.ply"]


def test_a_search_in_blocks_refuses_a_folder_before_it_begins(holey, tmp_path):
    with pytest.raises(OptionError, match="a single file"):
        nanogs.simplify_blocks(
            holey, tmp_path / "new" / "meta.json", draw_cost=0.5, preset="fast", block=1000
        )
    assert list(tmp_path.iterdir()) == []


def test_memory_is_limited_beside_a_given_block(holey, tmp_path):
    options = {"ratio": 0.5, "preset": "fast", "block": 1000}
    with pytest.raises(OptionError, match="too many to be held in memory at once"):
        nanogs.simplify_blocks(holey, tmp_path / "a.sog", max_memory=1, **options)
    assert list(tmp_path.iterdir()) == []
    nanogs.simplify_blocks(holey, tmp_path / "a.sog", max_memory="4GB", **options)


@pytest.mark.parametrize("resumed", [False, True])
def test_folders_made_around_a_job_are_removed_with_it(holey, tmp_path, resumed):
    options = {"preset": "fast", "block": 1000, "job": tmp_path / "new" / "deep" / "job"}
    if resumed:

        def stop(step):
            if step.stage == "grow" and step.done:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            nanogs.simplify_blocks(holey, tmp_path / "a.ply", ratio=0.5, progress=stop, **options)
        assert (options["job"] / "job.json").exists()
    nanogs.simplify_blocks(holey, tmp_path / "a.ply", ratio=0.5, resume=resumed, **options)
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


@pytest.mark.parametrize("name", ["job", "scratch"])
def test_a_folder_that_cannot_be_made_leaves_none_around_it(holey, tmp_path, name):
    place = tmp_path / "new" / "deep" / ("x" * 300)
    with pytest.raises(OutputError):
        nanogs.simplify_blocks(
            holey, tmp_path / "a.ply", ratio=0.5, preset="fast", block=1000, **{name: place}
        )
    assert list(tmp_path.iterdir()) == []
