"""`--threads` limits the threads of every part of a command."""

from contextlib import nullcontext

import numba
import pytest

import nanogs
from builders import random_splats
from launch import run_here
from nanogs.control_groups import processor_quota
from nanogs.errors import OptionError
from nanogs.threads import most_threads, processors, use_threads, usual_threads


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a model that is read in several parts, and a smaller one."""
    folder = tmp_path_factory.mktemp("models")
    large = random_splats(8000, degree=0)
    nanogs.save(large, folder / "large.ply")
    nanogs.save(nanogs.simplify(large, count=400, preset="fast")[0], folder / "small.ply")
    return folder


def no_pool():
    raise AssertionError("another thread is asked for")


@pytest.mark.parametrize(
    "command",
    [
        "simplify large.ply {out}/out.sog --count 400 --preset fast --measure",
        "simplify large.ply {out}/out.ply --count 400 --steps 2 --views 4 --view-size 64",
        "simplify large.ply {out}/out.ply --count 400 --preset fast --drop-floaters",
        "lod large.ply {out}/lod-meta.json --levels 0.5,0.1 --preset fast --no-measure",
        "lod large.ply {out}/lod.rad --levels 0.5,0.1 --preset fast --no-measure",
        "refit large.ply small.ply {out}/out.ply --views 2 --pixels 64 --rounds 1",
        "compare large.ply small.ply --views 1 --pixels 64",
        "render large.ply {out} --views 1 --pixels 64",
        "view large.ply small.ply -o {out}/page.html",
    ],
)
def test_one_thread_reads_computes_and_writes(
    folder, tmp_path, monkeypatch, small_pictures, command
):
    monkeypatch.chdir(folder)
    monkeypatch.setattr("nanogs.parallel._pool", no_pool)
    assert run_here(*command.format(out=tmp_path).split(), "--threads", "1") == 0


@pytest.mark.parametrize(
    "call",
    [
        lambda large, out, how: nanogs.simplify_blocks(
            large, out / "out.ply", ratio=0.1, filters=[nanogs.filters.opaque_enough(0.1)], **how
        ),
        lambda large, out, how: nanogs.write_levels(
            large, out / "lod", [0.5, 0.1], layout="streamed sog", **how
        ),
    ],
    ids=["simplify_blocks", "write_levels"],
)
def test_one_thread_plans_and_makes_blocks(folder, tmp_path, monkeypatch, call):
    monkeypatch.setattr("nanogs.parallel._pool", no_pool)
    call(folder / "large.ply", tmp_path, {"block": 3000, "preset": "fast", "threads": 1})


@pytest.mark.parametrize(
    "call",
    [
        lambda large, _small: nanogs.simplify(large, ratio=0.1, preset="fast", threads=1),
        lambda large, _small: list(nanogs.levels(large, [0.1], preset="fast", threads=1)),
        lambda large, _small: nanogs.grow(large, preset="fast", threads=1),
        lambda large, small: nanogs.refit(
            large, small, parameters=nanogs.RefitParameters(views=2, size=64, rounds=1), threads=1
        ),
    ],
    ids=["simplify", "levels", "grow", "refit"],
)
def test_a_path_is_read_with_one_thread_too(folder, monkeypatch, call):
    monkeypatch.setattr("nanogs.parallel._pool", no_pool)
    call(folder / "large.ply", folder / "small.ply")


@pytest.mark.parametrize(("option", "threads"), [([], None), (["--job", "job"], 3)])
def test_only_workers_share_the_threads_that_the_process_may_use(
    folder, tmp_path, monkeypatch, option, threads
):
    seen = []

    def stop(request, _progress):
        seen.append(request.threads)
        raise OptionError("enough.")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("os.cpu_count", lambda: 64)
    monkeypatch.setenv("NUMBA_NUM_THREADS", "6")
    monkeypatch.setattr("nanogs.cli.plan.executor_of", lambda *_: nullcontext())
    monkeypatch.setattr("nanogs.cli.simplify_run.simplify_files", stop)
    arguments = ["simplify", folder / "large.ply", "out.ply", "--count", "400", "--preset", "fast"]
    assert run_here(*arguments, "--workers", "2", *option) == 2
    assert seen == [threads]


def write_group(root, line, files):
    """Write a process's group and, at given places below the root of groups, their files."""
    (root / "proc" / "self").mkdir(parents=True)
    (root / "proc" / "self" / "cgroup").write_text(line)
    for name, text in files.items():
        path = root / "groups" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{text}\n")
    return root / "proc", root / "groups"


@pytest.mark.parametrize(
    ("line", "files", "processors"),
    [
        ("0::/\n", {"cpu.max": "200000 100000"}, 2),
        ("0::/\n", {"cpu.max": "150000 100000"}, 2),
        ("0::/\n", {"cpu.max": "50000 100000"}, 1),
        ("0::/\n", {"cpu.max": "max 100000"}, None),
        ("0::/a/b\n", {"a/cpu.max": "300000 100000", "a/b/cpu.max": "max 100000"}, 3),
        ("0::/a/b\n", {"a/cpu.max": "300000 100000", "a/b/cpu.max": "100000 100000"}, 1),
        ("0::/elsewhere\n", {"cpu.max": "400000 100000"}, 4),
        (
            "4:memory:/m\n3:cpu,cpuacct:/job\n",
            {"cpu/job/cpu.cfs_quota_us": "600000", "cpu/job/cpu.cfs_period_us": "100000"},
            6,
        ),
        (
            "3:cpu,cpuacct:/job\n",
            {"cpu/job/cpu.cfs_quota_us": "-1", "cpu/job/cpu.cfs_period_us": "100000"},
            None,
        ),
        ("4:memory:/\n", {"cpu/cpu.cfs_quota_us": "1", "cpu/cpu.cfs_period_us": "1"}, None),
        ("0::/\n", {"cpu.max": "garbage"}, None),
        ("0::/\n", {"cpu.max": "100000 0"}, None),
        ("0::/\n", {}, None),
        ("", {}, None),
    ],
)
def test_the_quota_of_processor_time_is_read(tmp_path, line, files, processors):
    assert processor_quota(*write_group(tmp_path, line, files)) == processors


def test_without_a_number_a_quota_limits_the_threads(monkeypatch):
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    monkeypatch.setattr("nanogs.threads._quota", lambda: 1)
    assert (processors(), usual_threads()) == (1, 1)
    with use_threads(None) as threads:
        assert threads == numba.get_num_threads() == 1
    if most_threads() > 1:
        with use_threads(2) as threads:
            assert threads == numba.get_num_threads() == 2
    monkeypatch.setattr("nanogs.threads._quota", lambda: 10_000)
    assert processors() == most_threads()
    monkeypatch.setenv("NUMBA_NUM_THREADS", "7")
    assert usual_threads() == most_threads() == 7
