"""Free memory on simulated systems, and what happens if it is not enough."""

import json
import subprocess
import sys
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest

import nanogs
from builders import random_splats
from launch import measured
from launch import run_here as command
from nanogs import memory
from nanogs.cli.failures import sentence_of
from nanogs.datasets.synthetic import make_scene
from nanogs.errors import NotEnoughMemoryError, OptionError
from nanogs.io.files import splat_bytes
from nanogs.io.gltf import packed_write
from nanogs.memory import LIBRARIES, Memory, allowed_memory, free_memory, process_memory
from nanogs.memory_estimates import models_bytes
from nanogs.pipeline.estimates.block_plan import MemoryLimit
from nanogs.pipeline.in_blocks import plan_job
from nanogs.pipeline.levels import requested_levels
from nanogs.pipeline.options.presets import effective, parameters
from nanogs.pipeline.options.target import Goal
from nanogs.pipeline.request import Request
from nanogs.scoring.needed import needed_bytes
from torchfiles import TorchFile, gsplat

GB = 10**9
COUNT = 60_000
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="its limits are Linux's")


@pytest.fixture
def system(tmp_path, monkeypatch):
    """A machine with 8 GB available and no limits, and a process that has loaded all libraries."""
    psutil = pytest.importorskip("psutil")
    facts = SimpleNamespace(rss=LIBRARIES, vms=900_000_000, data=300_000_000)
    monkeypatch.setattr(psutil, "Process", lambda: SimpleNamespace(memory_info=lambda: facts))
    available = SimpleNamespace(available=8 * GB)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: available)
    monkeypatch.setattr(memory, "set_ulimits", lambda: iter(()))
    monkeypatch.setenv("NUMBA_NUM_THREADS", "2")
    proc, groups = tmp_path / "proc", tmp_path / "cgroup"
    (proc / "self").mkdir(parents=True)
    groups.mkdir()

    def group(line, files=None, inner=""):
        (proc / "self" / "cgroup").write_text(line)
        (groups / inner).mkdir(parents=True, exist_ok=True)
        for name, text in (files or {}).items():
            (groups / inner / name).write_text(f"{text}\n")

    return SimpleNamespace(
        facts=facts, available=available, group=group, free=lambda: free_memory(proc, groups)
    )


def test_without_limits_all_available_memory_of_the_machine_is_free(system):
    assert system.free() == Memory(8 * GB, "free on this machine")


def test_memory_of_libraries_not_loaded_yet_is_subtracted(system):
    system.facts.rss = LIBRARIES - 150_000_000
    assert system.free().bytes == 8 * GB - 150_000_000


def cgroup_v2(limit, used, stat="", high="max"):
    return {
        "memory.max": limit, "memory.current": used, "memory.stat": stat, "memory.high": high,
    }  # fmt: skip


@LINUX
@pytest.mark.parametrize(
    ("files", "free"),
    [
        (cgroup_v2(2 * GB, GB // 2), 3 * GB // 2),
        (cgroup_v2("max", GB), 8 * GB),
        (cgroup_v2(2 * GB, GB, "anon 5\ninactive_file 300\nactive_file 200"), GB + 500),
        (cgroup_v2("max", GB, high=3 * GB), 2 * GB),
        (cgroup_v2(9 * GB, 0), 8 * GB),
        ({"memory.max": 2 * GB}, 8 * GB),
        ({}, 8 * GB),
    ],
)
def test_a_control_group_leaves_its_limit_less_usage_without_file_caches(system, files, free):
    system.group("0::/job\n", files, "job")
    assert system.free().bytes == free


@LINUX
def test_limits_of_parent_control_groups_apply_too(system):
    system.group("0::/slice/job\n", cgroup_v2(4 * GB, GB), "slice")
    system.group("0::/slice/job\n", cgroup_v2(6 * GB, GB), "slice/job")
    remedy = "free some or raise the limit"
    assert system.free() == Memory(3 * GB, "free in this control group", remedy)


@LINUX
def test_in_a_container_the_limit_at_the_root_applies(system):
    system.group("0::/docker/0123\n", cgroup_v2(2 * GB, GB))
    assert system.free().bytes == GB


@LINUX
@pytest.mark.parametrize(
    ("limit", "stat", "free"),
    [
        (2 * GB, "", GB),
        (2 * GB, "cache 9\ntotal_inactive_file 7\ntotal_active_file 3", GB + 10),
        (9223372036854771712, "", 8 * GB),
    ],
)
def test_limits_of_version_1_control_groups_apply(system, limit, stat, free):
    files = {
        "memory.limit_in_bytes": limit, "memory.usage_in_bytes": GB, "memory.stat": stat,
    }  # fmt: skip
    system.group("5:cpu,cpuacct:/x\n4:memory:/job\n1:name=systemd:/\n", files, "memory/job")
    assert system.free().bytes == free


@pytest.mark.parametrize("option", ["-v", "-d"])
def test_ulimit_leaves_the_limit_less_the_mapped_memory(system, monkeypatch, option):
    monkeypatch.setattr(memory, "set_ulimits", lambda: iter([(2 * GB, option)]))
    mapped = {"-v": 900_000_000, "-d": 300_000_000}[option]
    usable, limit = int(0.8 * (2 * GB - mapped)), f"left by `ulimit {option}`"
    assert system.free() == Memory(usable, limit, "raise the limit")


def test_each_thread_adds_to_the_memory_that_libraries_map(system, monkeypatch):
    monkeypatch.setattr(memory, "set_ulimits", lambda: iter([(8 * GB, "-v")]))
    system.facts.vms = 0
    found = []
    for threads in ("1", "2", "16"):
        monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
        found.append(8 * GB - system.free().bytes)
    assert found[1] - found[0] == pytest.approx((found[2] - found[1]) / 14)
    assert (found[1] - found[0]) / 0.8 > 72e6


@LINUX
@pytest.mark.parametrize("threads", [1, 4])
def test_the_libraries_map_no_more_than_planned(threads):
    """Run in a new process, because this one has mapped much else."""
    options = {"ratio": 0.1, "steps": 1, "views": 2, "view_size": 64}
    code = (
        "import psutil, nanogs\n"
        "from nanogs.datasets.synthetic import make_scene\n"
        f"nanogs.simplify(make_scene(500), **{options})\n"
        "print(psutil.Process().memory_info().vms)"
    )
    import os

    names = ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    env = os.environ | dict.fromkeys(names, str(threads))
    run = [sys.executable, "-c", code]
    nanogs.simplify(make_scene(500), **options)  # compiles what is not cached
    result = subprocess.run(run, env=env, check=True, capture_output=True, text=True)
    planned = memory._MAPPED + (threads - 1) * memory._MAPPED_THREAD
    assert 0.5 * planned < int(result.stdout) < planned


def test_no_memory_left_is_an_error(monkeypatch):
    monkeypatch.setattr(
        memory, "free_memory", lambda **_: Memory(-5_000_000, "left by `ulimit -v`", "raise it")
    )
    with pytest.raises(NotEnoughMemoryError, match=r"5\.0 MB more .* `ulimit -v`; raise it\."):
        allowed_memory(None)


def test_a_tenth_is_kept_free_unless_max_memory_is_given(monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda **_: Memory(10 * GB, "free on this machine"))
    assert allowed_memory(None) == Memory(9 * GB, "free on this machine", "free some")
    assert allowed_memory(GB).bytes == GB - LIBRARIES
    assert allowed_memory(5).bytes == 0


@pytest.mark.parametrize(
    ("free", "processes", "expected"),
    [
        (3_456_000_000, 1, 3_660_000_000),
        (7_400_000, 1, 217_000_000),
        (4_000_000_000, 4, 1_050_000_000),
    ],
)
def test_each_process_gets_its_share_rounded_to_three_digits(free, processes, expected):
    assert process_memory(Memory(free, ""), processes) == expected


# ---- models that do not fit -------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("free") / "scene.ply"
    nanogs.save(make_scene(COUNT), path)
    return path


@pytest.fixture
def little_memory(monkeypatch):
    """Report only half of the memory that the scene takes as free."""
    free = Memory(22_000_000, "free on this machine")
    monkeypatch.setattr(memory, "free_memory", lambda **_: free)


def test_a_model_that_does_not_fit_is_simplified_in_blocks_with_a_note(
    scene, tmp_path, little_memory, capsys
):
    out = tmp_path / "small.ply"
    assert command("simplify", scene, out, "-r", "0.1", "--preset", "fast") == 0
    text = " ".join(capsys.readouterr().err.split())
    assert (
        "19.8 MB are free on this machine: it is simplified in blocks, as with --max-memory" in text
    )
    assert len(nanogs.load(out)) == COUNT // 10
    assert [path.name for path in tmp_path.iterdir()] == ["small.ply"]


def test_notes_on_a_model_of_several_files_give_their_number(
    scene, tmp_path, little_memory, capsys
):
    parts = [tmp_path / f"tile_{number}.ply" for number in range(2)]
    for part in parts:
        part.write_bytes(scene.read_bytes())
    arguments = (*parts, tmp_path / "small.ply", "--join", "-r", "0.1", "--preset", "fast")
    assert command("simplify", *arguments, "--dry-run") == 0
    text = " ".join(capsys.readouterr().err.split())
    assert "note: The model of 2 files takes about" in text


def test_levels_that_do_not_fit_are_made_in_blocks(scene, tmp_path, little_memory, capsys):
    folder = tmp_path / "levels"
    assert command("lod", scene, folder, "--levels", "0.2,0.1", "--preset", "fast") == 0
    assert "in blocks, as with --max-memory" in " ".join(capsys.readouterr().err.split())
    assert (folder / "levels.json").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["-r", "0.1", "--drop-floaters"], "--drop-floaters needs the whole model"),
        (["-r", "0.1", "--preset", "paper"], "the preset paper needs the whole model"),
    ],
)
def test_options_that_need_the_whole_model_are_refused_if_it_does_not_fit(
    scene, tmp_path, little_memory, capsys, options, message
):
    assert command("simplify", scene, tmp_path / "a.ply", *options) == 2
    text = " ".join(capsys.readouterr().err.split())
    assert message in text
    assert "leave that out, or provide more memory" in text
    assert list(tmp_path.iterdir()) == []


def test_compare_refuses_models_that_do_not_fit_before_reading_them(tmp_path, monkeypatch):
    splats, path = make_scene(2000), tmp_path / "a.ply"
    nanogs.save(splats, path)
    monkeypatch.setattr(memory, "free_memory", lambda **_: Memory(100_000, "free on this machine"))
    monkeypatch.setattr("nanogs.scoring.measure.named", None)  # nothing is read
    for models in ((splats, splats), (path, splats), (path, path)):
        with pytest.raises(NotEnoughMemoryError, match="fewer or smaller views"):
            nanogs.compare(*models)
    view = {"views": 1, "pixels": 16}
    in_memory, from_file = (
        needed_bytes((model,), 256, 1, all_of_it=False) for model in (splats, nanogs.open(path))
    )
    assert from_file - in_memory == 2000 * splat_bytes(3)  # the file must be read first
    monkeypatch.undo()
    with pytest.raises(NotEnoughMemoryError):
        nanogs.compare(splats, splats, **view, max_memory=LIBRARIES + 1000)
    assert len(nanogs.compare(splats, splats, **view, max_memory=GB).models) == 1


def test_memory_for_measured_levels_includes_views_of_the_original(monkeypatch):
    splats, requested = make_scene(2000), []
    monkeypatch.setattr(
        "nanogs.pipeline.in_memory.refuse_too_large",
        lambda _what, needed, *_: requested.append(needed),
    )
    request = Request(goal=Goal(ratio=0.5), ratios=(0.5,))
    for measure in (False, True):
        requested_levels(splats, request, None, judged=measure)
    views = 8 * 512 * 512 * 3 * 4
    assert requested[1] - requested[0] >= views


def test_simplify_and_levels_refuse_models_that_do_not_fit_before_any_work(monkeypatch):
    splats, stages = make_scene(2000), []
    monkeypatch.setattr(memory, "free_memory", lambda **_: Memory(100_000, "free on this machine"))
    with pytest.raises(NotEnoughMemoryError, match="simplify_blocks"):
        nanogs.simplify(splats, ratio=0.1, progress=lambda *step: stages.append(step))
    with pytest.raises(NotEnoughMemoryError):
        nanogs.levels(splats, [0.5, 0.1])
    assert stages == []
    small, _ = nanogs.simplify(splats, ratio=0.1, preset="fast", max_memory=GB)
    assert len(small) == 200


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "The free memory for each process is 223 MB and must be at least"),
        (["--workers", "2"], "The free memory for each process is 111 MB and must be at least"),
        (["--max-memory", "211MB"], "error: --max-memory is 211 MB and must be at least"),
    ],
)
@pytest.mark.parametrize("planned", [False, True])
def test_too_little_memory_for_blocks_names_the_limit(
    scene, tmp_path, monkeypatch, capsys, options, said, planned
):
    limit = Memory(15_000_000, "free on this machine")
    monkeypatch.setattr(memory, "free_memory", lambda **_: limit)
    more = ["--dry-run"] if planned else []
    assert command("simplify", scene, tmp_path / "a.ply", "-r", "0.1", *options, *more) == 2
    assert said in " ".join(capsys.readouterr().err.split())


def test_too_little_memory_for_blocks_names_the_default_of_workers(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("nanogs.pipeline.in_blocks.DEFAULT_MEMORY", 211_000_000)
    said = "^`max_memory` is 211 MB by default with workers and must be at least"
    with ThreadPoolExecutor(1) as pool, pytest.raises(OptionError, match=said):
        nanogs.simplify_blocks(scene, tmp_path / "a.ply", ratio=0.1, executor=pool)


def test_too_little_memory_to_measure_is_found_before_the_work(scene, tmp_path):
    """Results in blocks are measured in the share of one process, also if nobody set a limit."""
    request = Request(
        goal=Goal(ratio=0.1), inputs=(scene,), output=tmp_path / "a.ply", preset="fast",
        measured=True, max_memory=LIBRARIES + 10**8, limit=MemoryLimit.FREE,
    )  # fmt: skip
    with pytest.raises(NotEnoughMemoryError, match="Measuring takes about"):
        plan_job(request)


def test_resumed_jobs_keep_their_block_size_for_any_free_memory(scene, tmp_path, monkeypatch):
    from nanogs.pipeline.in_blocks import with_limit
    from nanogs.pipeline.job.folder import read_manifest

    job, out = tmp_path / "job", tmp_path / "small.ply"

    class StoppedError(Exception):
        pass

    def stop(step):
        if step.stage == "cut":
            raise StoppedError

    options = {"ratio": 0.1, "job": job, "threads": 1, "preset": "fast", "rounds": 2}
    with pytest.raises(StoppedError):
        nanogs.simplify_blocks(
            scene, out, max_memory=LIBRARIES + 25_000_000, progress=stop, **options
        )
    block = read_manifest(job)[0]["block"]
    request = Request(goal=Goal(ratio=0.1), output=out, job=job, resume=True)
    for free in (20_000_000, 8 * GB):
        limit = Memory(free, "free on this machine")
        monkeypatch.setattr(memory, "free_memory", lambda limit=limit, **_: limit)
        limited = with_limit(request, elsewhere=False)
        assert (limited.max_memory, limited.block) == (None, block)
    report = nanogs.simplify_blocks(scene, out, resume=True, **options)
    assert report.blocks.allowed == block
    assert report.blocks.resumed > 0


@pytest.mark.parametrize(
    ("option", "name", "goal"),
    [
        (["--workers", "2"], "simplify", ["-r", "0.1"]),
        (["--workers", "2"], "lod", ["--levels", "0.1"]),
    ],
)
def test_options_for_blocks_without_effect_are_noted(scene, tmp_path, capsys, option, name, goal):
    target = tmp_path / ("a.ply" if name == "simplify" else "a")
    arguments = [name, scene, target, *goal, "--preset", "fast", *option]
    assert command(*arguments, "--json") == 0
    (note, *_rest) = json.loads(capsys.readouterr().out)["notes"]
    assert f"{option[0]} had no effect" in note
    assert command(*arguments, "--json", "-w", "--max-memory", "4GB") == 0
    (note, *_rest) = json.loads(capsys.readouterr().out)["notes"]
    assert note.endswith("because the model fits into --max-memory and needs no blocks.")


@pytest.mark.parametrize(
    ("name", "asked"), [("simplify", ["-r", "0.1"]), ("lod", ["--levels", "0.1"])]
)
@pytest.mark.parametrize("option", [[], ["--workers", "1", "--max-memory", "250MB"]])
def test_patience_without_a_scheduler_is_noted(scene, tmp_path, capsys, name, asked, option):
    target = tmp_path / ("a.ply" if name == "simplify" else "a")
    arguments = [name, scene, target, *asked, "--preset", "fast", *option, "--dry-run"]
    assert command(*arguments) == 0
    assert "--patience" not in capsys.readouterr().err
    assert command(*arguments, "--patience", "9") == 0
    assert capsys.readouterr().err.count("--patience had no effect, because it needs a") == 1


@pytest.mark.parametrize(
    ("name", "asked"), [("simplify", ["-r", "0.1"]), ("lod", ["--levels", "0.1"])]
)
def test_options_for_blocks_without_effect_are_noted_before_the_work(
    scene, tmp_path, capsys, monkeypatch, name, asked
):
    """Somebody who asked for workers learns at once that a long run has none."""
    target = tmp_path / ("a.ply" if name == "simplify" else "a")
    arguments = [name, scene, target, *asked, "--preset", "fast", "--workers", "2"]
    assert command(*arguments, "--dry-run") == 0
    assert capsys.readouterr().err.count("--workers had no effect") == 1
    module = f"nanogs.cli.{name}_run"
    execute, seen = sys.modules[module].execute, []

    def watched(*given):
        seen.append(capsys.readouterr().err)
        return execute(*given)

    monkeypatch.setattr(f"{module}.execute", watched)
    assert command(*arguments) == 0
    assert "--workers had no effect" in seen[0]
    assert "--workers" not in capsys.readouterr().err


@pytest.mark.parametrize("option", [["--resume"], ["--scratch", "x"]])
def test_a_job_of_one_block_prints_no_note_about_blocks(
    scene, tmp_path, capsys, option, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    arguments = ["simplify", scene, "a.ply", "-r", "0.1", "--preset", "fast", *option]
    assert command(*arguments) == 0
    assert "in blocks" not in capsys.readouterr().err


# ---- running out of memory or of other resources ----------------------------------------------


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (MemoryError(), "Memory ran out;"),
        (
            MemoryError("Unable to allocate 91.6 MiB for an array with shape (500, 16)"),
            r"Memory ran out \(91.6 MiB more were needed\);",
        ),
        (
            MemoryError("Unable to allocate 183. MiB for an array with shape (1000, 48)"),
            r"Memory ran out \(183 MiB more were needed\);",
        ),
        (RuntimeError("can't start new thread"), "Memory ran out;"),
        (OSError(36, "File name too long", "aaa"), "aaa: File name too long;"),
    ],
)
def test_system_failures_are_reported_in_one_sentence(error, message):
    import re

    assert re.match(message, sentence_of(error))


@pytest.mark.parametrize("error", [RuntimeError("ours"), ValueError("x"), OSError("no number")])
def test_errors_of_nanogs_itself_are_not_reported_as_system_failures(error):
    assert sentence_of(error) is None


def test_running_out_of_memory_in_blocks_names_the_kept_job(
    scene, tmp_path, little_memory, monkeypatch, capsys
):
    out = tmp_path / "small.ply"
    arguments = ["simplify", scene, out, "-r", "0.1", "--preset", "fast"]

    def run_out(*_args, **_options):
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr("nanogs.pipeline.work.store_groups", run_out)
        assert command(*arguments) == 2
    text = " ".join(capsys.readouterr().err.split())
    assert "error: Memory ran out; free some" in text
    job = tmp_path / "small.ply.job"
    assert f"The finished part is kept in {job}: --resume continues" in text
    assert "another --max-memory." in text
    assert command(*arguments, "--resume") == 0
    assert [path.name for path in tmp_path.iterdir()] == ["small.ply"]


def test_running_out_of_memory_before_a_job_starts_names_no_job(
    scene, tmp_path, little_memory, monkeypatch, capsys
):
    def run_out(*_args):
        raise MemoryError

    monkeypatch.setattr("nanogs.pipeline.job.stored.open_scratch", run_out)
    assert command("simplify", scene, tmp_path / "a.ply", "-r", "0.1", "--preset", "fast") == 2
    assert ".job" not in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_running_out_of_memory_while_writing_leaves_no_files(scene, tmp_path, monkeypatch, capsys):
    import nanogs.io.ply.write

    def run_out(*_args, **_options):
        raise MemoryError

    monkeypatch.setattr(nanogs.io.ply.write, "write", run_out)
    monkeypatch.setattr("nanogs.conversion.write_model", run_out)
    assert command("convert", scene, tmp_path / "a.ply") == 2
    assert "error: Memory ran out; free some" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@LINUX
@pytest.mark.parametrize("limit", [60, 400])
def test_too_low_a_ulimit_is_reported_in_one_sentence(scene, tmp_path, limit):
    import resource

    def limited():
        resource.setrlimit(resource.RLIMIT_AS, (limit * 10**6, limit * 10**6))

    run = [sys.executable, "-m", "nanogs", "simplify", scene, tmp_path / "a.ply", "-r", "0.1"]
    result = subprocess.run(run, preexec_fn=limited, capture_output=True, text=True)
    assert result.returncode == 2
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("\n") == 1
    assert "`ulimit -v`" in result.stderr
    assert list(tmp_path.iterdir()) == []


# ---- file names that are too long for a suffix ------------------------------------------------


@pytest.mark.parametrize("option", [["--job", "a" * 254 + ".ply"], []])
def test_a_file_name_too_long_for_a_job_is_an_error(scene, tmp_path, capsys, option):
    out = tmp_path / ("a.ply" if option else "b" * 248 + ".ply")
    arguments = ["simplify", scene, out, "-r", "0.1", "--max-memory", "250MB", *option]
    assert command(*arguments) == 2
    text = capsys.readouterr().err
    assert "(File name too long)" in text
    assert text.rstrip().endswith("name another one with --job.")
    assert list(tmp_path.iterdir()) == []


# ---- commands that render, compare, describe and convert ----------------------------------------


def command_and_error(name, scene, folder):
    """Return the arguments of a command that writes into a folder, and how its error begins."""
    return {
        "render": (["render", scene, folder / "r"], "Rendering"),
        "compare": (["compare", scene, scene], "Comparing these models"),
        "view": (["view", scene, "-o", folder / "a.html", "--no-open"], "Making this page"),
        "refit": (["refit", scene, scene, folder / "a.ply"], "Fitting"),
        "convert": (["convert", scene, folder / "a.spz"], "Converting"),
        "info": (["info", scene], "Describing"),
    }[name]


NAMES = ["render", "compare", "view", "refit", "convert", "info"]


@pytest.mark.parametrize("name", NAMES)
def test_commands_that_need_more_than_the_free_memory_are_refused(
    scene, tmp_path, monkeypatch, capsys, name
):
    monkeypatch.setattr(memory, "free_memory", lambda **_: Memory(500_000, "free on this machine"))
    arguments, sentence = command_and_error(name, scene, tmp_path)
    assert command(*arguments) == 2
    text = capsys.readouterr().err
    assert text.startswith(f"error: {sentence}")
    assert "450.0 kB are free on this machine; free some" in text
    assert text.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", NAMES[:-1])
def test_max_memory_replaces_the_free_memory(scene, tmp_path, capsys, name):
    arguments, _sentence = command_and_error(name, scene, tmp_path)
    assert command(*arguments, "--max-memory", "60MB") == 2
    text = capsys.readouterr().err
    assert "of the memory allowed" in text
    assert "; raise --max-memory" in text
    assert "free some" not in text


def test_the_memory_for_a_picture_depends_on_its_pixels(scene, tmp_path, capsys):
    arguments = ["render", scene, tmp_path / "a.png", "--max-memory", "400MB", "--pixels"]
    assert command(*arguments, "64") == 0
    capsys.readouterr()
    assert command(*arguments[:2], tmp_path / "b.png", *arguments[3:], "4096") == 2
    assert "of the memory allowed" in capsys.readouterr().err


PEAK = """
import re, sys
from pathlib import Path
import nanogs.cli

def run(*args):
    sys.argv = ["nanogs", *args]
    try:
        nanogs.cli.main()
    except SystemExit as end:
        assert not end.code

def status(name):
    text = Path("/proc/self/status").read_text()
    return int(re.search(name + r":\\s+(\\d+)", text)[1]) * 1024

small, args = sys.argv[1], sys.argv[2:]
# What loads the same libraries, those of a palette too.
less = {"large.ply": small, "plain.ply": small, "20000": "500"}
run(*[less.get(a, a) for a in args])
Path("/proc/self/clear_refs").write_text("5")
before = status("VmRSS")
run(*args)
print("took", status("VmHWM") - before)
"""


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """A folder with two models that take much memory and one that takes very little."""
    folder = tmp_path_factory.mktemp("models")
    for name, count, degree in (("large", 300_000, 3), ("plain", 200_000, 1), ("small", 1000, 3)):
        nanogs.save(make_scene(count, sh_degree=degree), folder / f"{name}.ply")
    return folder


@LINUX
@pytest.mark.parametrize(
    ("arguments", "estimate"),
    [
        (
            ["render", "large.ply", "a.png", "-w"],
            "model_bytes(large) + needs.drawn_bytes(300_000) + needs.shown_bytes(1280 * 720, 0)",
        ),
        (
            ["compare", "large.ply", "small.ply"],
            "model_bytes(large) + needs.scoring_bytes([300_000, 1000], 512**2, 8)",
        ),
        pytest.param(
            ["convert", "plain.ply", "a.sog", "-w"],
            "convert_bytes(file, Path('a.sog'), whole=0)",
            marks=pytest.mark.slow,
        ),
        (["convert", "large.ply", "a.ply", "-w"], "convert_bytes(file, Path('a.ply'), whole=0)"),
        (["convert", "large.ply", "a.spz", "-w"], "convert_bytes(file, Path('a.spz'), whole=0)"),
        pytest.param(
            ["convert", "plain.ply", "a.spz", "--palette", "20000", "-w"],
            "convert_bytes(file, Path('a.spz'), whole=0, options={'palette': 20000})",
            marks=pytest.mark.slow,
        ),
        (["convert", "large.ply", "a.glb", "-w"], "convert_bytes(file, Path('a.glb'), whole=0)"),
    ],
)
def test_estimated_memory_is_close_to_the_memory_used(models, arguments, estimate):
    from pathlib import Path

    from nanogs import memory_estimates
    from nanogs.io import inspect

    names = {name: inspect(models / f"{name}.ply") for name in ("large", "small")}
    names["file"] = nanogs.open(models / arguments[1])
    planned = eval(f"needs.{estimate}", {"needs": memory_estimates, "Path": Path, **names})
    (taken,) = measured(PEAK, "small.ply", *arguments, cwd=models)
    # The first run may leave memory on the heap that the second run uses again.
    # A few blocks at most.
    streamed = any(f"a{end}" in estimate for end in (".ply", ".spz", ".glb"))
    assert (0 if streamed else 0.4) < taken / planned < 1.0


def tiles_of(models, folder):
    """Write models as tiles and return the path of their tileset."""
    box = {"box": [0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1]}
    tiles = []
    for number, model in enumerate(models):
        nanogs.save(model, folder / f"{number}.glb")
        content = {"content": {"uri": f"{number}.glb"}}
        tiles.append({"boundingVolume": box, "geometricError": 1} | content)
    root = {"boundingVolume": box, "geometricError": 1, "children": tiles}
    path = folder / "tileset.json"
    path.write_text(json.dumps({"asset": {"version": "1.1"}, "root": root}))
    return path


@pytest.mark.parametrize("name", ["a.usda", "a.pt", "a.glb", "tileset.json"])
def test_estimated_memory_for_a_file_that_is_read_whole(tmp_path, name):
    model, path = random_splats(20_000, degree=3), tmp_path / name
    if name == "a.pt":
        path.write_bytes(TorchFile(gsplat(model)).bytes())
    elif name == "a.glb":
        with path.open("wb") as file:
            packed_write.write(model, file)
    elif name == "tileset.json":
        tiles_of([model[:10_000], model[10_000:]], tmp_path)
    else:
        nanogs.save(model, path)
    planned = models_bytes([path], all_of_it=True)
    tracemalloc.start()
    nanogs.load(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert 0.8 * planned < peak < 1.1 * planned


# ---- reports of runs in blocks and of other runs -------------------------------------------------


@pytest.mark.parametrize(
    ("options", "rendered", "fitted"),
    [
        ({"preset": "default", "steps": 2}, True, True),
        ({"preset": "default", "steps": 0, "rounds": 0}, True, False),
        ({"preset": "default", "guided": False, "steps": 0}, False, False),
        ({"preset": "fast"}, False, False),
    ],
)
def test_the_report_of_blocks_has_results_of_the_stages_that_ran(
    tmp_path, options, rendered, fitted
):
    scene = tmp_path / "in.ply"
    nanogs.save(make_scene(6000), scene)
    if rendered:
        options = options | {"views": 4, "view_size": 64}
    report = nanogs.simplify_blocks(
        scene, tmp_path / "a.ply", ratio=0.1, block=3000, threads=1, **options
    )
    assert (report.shown is not None) == rendered
    assert bool(report.candidates) == rendered
    assert (report.fit is not None) == fitted


def test_the_preset_that_renders_nothing_has_no_fitting_steps(capsys):
    assert command("presets", "--json") == 0
    assert json.loads(capsys.readouterr().out)["fast"]["steps"] == 0


@pytest.mark.parametrize(
    ("options", "reported", "unreported"),
    [
        ({}, set(), {"hidden", "corrections", "steps", "views", "view_size"}),
        ({"steps": 5}, {"steps", "views", "view_size"}, {"hidden", "corrections"}),
        ({"guided": True}, {"hidden", "corrections", "steps", "views", "view_size"}, set()),
    ],
)
def test_parameters_without_effect_are_not_reported(options, reported, unreported):
    names = effective(parameters("fast", options)).keys()
    assert reported <= names
    assert not unreported & names


@pytest.mark.parametrize("options", [[], ["--dry-run"]])
def test_reports_name_and_count_all_joined_files(scene, tmp_path, capsys, options):
    other = tmp_path / "other.ply"
    nanogs.save(make_scene(1000), other)
    arguments = ["simplify", scene, other, tmp_path / "a.ply", "--join", "-r", "0.1", "--json"]
    assert command(*arguments, "--preset", "fast", *options) == 0
    run = json.loads(capsys.readouterr().out)
    assert run["input"] == f"{scene}, {other}"
    assert run["input_count"] == COUNT + 1000
    if not options:
        assert run["input_bytes"] == scene.stat().st_size + other.stat().st_size


def test_too_little_memory_for_chunks_is_refused_before_reading(
    scene, tmp_path, monkeypatch, capsys
):
    def read(*_args, **_options):
        raise AssertionError

    monkeypatch.setattr("nanogs.pipeline.stages.do", read)
    monkeypatch.setattr("nanogs.pipeline.run.do", read)
    arguments = ["lod", scene, tmp_path / "web" / "lod-meta.json", "--max-memory", "260MB"]
    (tmp_path / "web").mkdir()
    assert command(*arguments) == 2
    assert "for chunks; a smaller --chunk takes less" in capsys.readouterr().err
