"""Free memory, by made-up descriptions of a system, and what happens where it is not enough."""

import json
import subprocess
import sys
from types import SimpleNamespace

import pytest

import nanogs
from launch import run_here as command
from nanogs import memory
from nanogs.cli.failures import sentence_of
from nanogs.datasets.synthetic import make_scene
from nanogs.errors import NotEnoughMemoryError
from nanogs.io.files import splat_bytes
from nanogs.memory import LIBRARIES, Memory, allowed_memory, free_memory, process_memory
from nanogs.pipeline.levels import judged_levels
from nanogs.pipeline.options.presets import effective, parameters
from nanogs.scoring.needed import needed_bytes

GB = 10**9
COUNT = 60_000
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="its limits are Linux's")


@pytest.fixture
def system(tmp_path, monkeypatch):
    """A machine with 8 GB available, no limits, and a process that has all its libraries."""
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


def test_without_limits_what_the_machine_has_available_counts(system):
    assert system.free() == Memory(8 * GB, "free on this machine")


def test_libraries_that_are_still_to_be_loaded_are_allowed_for(system):
    system.facts.rss = LIBRARIES - 150_000_000
    assert system.free().bytes == 8 * GB - 150_000_000


def second(limit, used, stat="", high="max"):
    return {
        "memory.max": limit, "memory.current": used, "memory.stat": stat, "memory.high": high,
    }  # fmt: skip


@LINUX
@pytest.mark.parametrize(
    ("files", "free"),
    [
        (second(2 * GB, GB // 2), 3 * GB // 2),
        (second("max", GB), 8 * GB),
        (second(2 * GB, GB, "anon 5\ninactive_file 300\nactive_file 200"), GB + 500),
        (second("max", GB, high=3 * GB), 2 * GB),
        (second(9 * GB, 0), 8 * GB),
        ({"memory.max": 2 * GB}, 8 * GB),
        ({}, 8 * GB),
    ],
)
def test_a_control_group_leaves_its_limit_less_what_is_used_but_for_files(system, files, free):
    system.group("0::/job\n", files, "job")
    assert system.free().bytes == free


@LINUX
def test_the_groups_above_count_too(system):
    system.group("0::/slice/job\n", second(4 * GB, GB), "slice")
    system.group("0::/slice/job\n", second(6 * GB, GB), "slice/job")
    assert system.free() == Memory(3 * GB, "free in this control group")


@LINUX
def test_a_container_that_sees_its_group_as_the_root(system):
    system.group("0::/docker/0123\n", second(2 * GB, GB))
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
def test_control_groups_of_version_1(system, limit, stat, free):
    files = {
        "memory.limit_in_bytes": limit, "memory.usage_in_bytes": GB, "memory.stat": stat,
    }  # fmt: skip
    system.group("5:cpu,cpuacct:/x\n4:memory:/job\n1:name=systemd:/\n", files, "memory/job")
    assert system.free().bytes == free


@pytest.mark.parametrize("option", ["-v", "-d"])
def test_ulimit_leaves_what_is_not_mapped(system, monkeypatch, option):
    monkeypatch.setattr(memory, "set_ulimits", lambda: iter([(2 * GB, option)]))
    mapped = {"-v": 900_000_000, "-d": 300_000_000}[option]
    assert system.free() == Memory(int(0.8 * (2 * GB - mapped)), f"left by `ulimit {option}`")


def test_libraries_map_more_for_each_thread(system, monkeypatch):
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
def test_the_libraries_map_what_is_planned_for(threads):
    """In a process of its own, since a test's has mapped much else."""
    few = {"ratio": 0.1, "steps": 1, "views": 2, "view_size": 64}
    code = (
        "import psutil, nanogs\n"
        "from nanogs.datasets.synthetic import make_scene\n"
        f"nanogs.simplify(make_scene(500), **{few})\n"
        "print(psutil.Process().memory_info().vms)"
    )
    import os

    names = ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    env = os.environ | dict.fromkeys(names, str(threads))
    run = [sys.executable, "-c", code]
    nanogs.simplify(make_scene(500), **few)  # compiles what is not cached
    found = subprocess.run(run, env=env, check=True, capture_output=True, text=True)
    planned = memory._MAPPED + (threads - 1) * memory._MAPPED_THREAD
    assert 0.5 * planned < int(found.stdout) < planned


def test_nothing_left_is_said_at_once(system, monkeypatch):
    monkeypatch.setattr(
        memory, "free_memory", lambda **_: Memory(-5_000_000, "left by `ulimit -v`")
    )
    with pytest.raises(NotEnoughMemoryError, match=r"5\.0 MB more .* left by `ulimit -v`"):
        allowed_memory(None)


def test_a_tenth_is_kept_free_unless_the_memory_is_given(monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda **_: Memory(10 * GB, "free on this machine"))
    assert allowed_memory(None).bytes == 9 * GB
    assert allowed_memory(GB).bytes == GB - LIBRARIES
    assert allowed_memory(5).bytes == 0


@pytest.mark.parametrize(
    ("free", "processes", "each"),
    [
        (3_456_000_000, 1, 3_660_000_000),
        (7_400_000, 1, 217_000_000),
        (4_000_000_000, 4, 1_050_000_000),
    ],
)
def test_each_process_gets_its_share_in_three_digits(free, processes, each):
    assert process_memory(Memory(free, ""), processes) == each


# ---- what is done about it --------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("free") / "scene.ply"
    nanogs.save(make_scene(COUNT), path)
    return path


@pytest.fixture
def little(monkeypatch):
    """Memory for half of what the scene takes."""
    free = Memory(22_000_000, "free on this machine")
    monkeypatch.setattr(memory, "free_memory", lambda **_: free)


def test_a_model_that_does_not_fit_goes_to_blocks_and_says_so(scene, tmp_path, little, capsys):
    out = tmp_path / "small.ply"
    assert command("simplify", scene, out, "-r", "0.1", "--preset", "fast") == 0
    said = " ".join(capsys.readouterr().err.split())
    assert (
        "19.8 MB are free on this machine: it is simplified in blocks, as with --max-memory" in said
    )
    assert len(nanogs.load(out)) == COUNT // 10
    assert [path.name for path in tmp_path.iterdir()] == ["small.ply"]


def test_a_model_of_many_files_is_not_said_by_all_their_names(scene, tmp_path, little, capsys):
    parts = [tmp_path / f"tile_{number}.ply" for number in range(2)]
    for part in parts:
        part.write_bytes(scene.read_bytes())
    given = (*parts, tmp_path / "small.ply", "--join", "-r", "0.1", "--preset", "fast")
    assert command("simplify", *given, "--dry-run") == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "note: The model of 2 files takes about" in said


def test_levels_that_do_not_fit_go_to_blocks(scene, tmp_path, little, capsys):
    folder = tmp_path / "levels"
    assert command("lod", scene, folder, "--levels", "0.2,0.1", "--preset", "fast") == 0
    assert "in blocks, as with --max-memory" in " ".join(capsys.readouterr().err.split())
    assert (folder / "levels.json").exists()


@pytest.mark.parametrize(
    ("wish", "said"),
    [
        (["-r", "0.1", "--drop-floaters"], "--drop-floaters needs the whole model"),
        (["-r", "0.1", "--preset", "paper"], "the preset paper needs the whole model"),
    ],
)
def test_what_blocks_cannot_do_is_refused_at_once(scene, tmp_path, little, capsys, wish, said):
    assert command("simplify", scene, tmp_path / "a.ply", *wish) == 2
    text = " ".join(capsys.readouterr().err.split())
    assert said in text
    assert "leave that out, or provide more memory" in text
    assert list(tmp_path.iterdir()) == []


def test_in_python_a_comparison_that_would_not_fit_is_refused_before_work(tmp_path, monkeypatch):
    splats, path = make_scene(2000), tmp_path / "a.ply"
    nanogs.save(splats, path)
    monkeypatch.setattr(memory, "free_memory", lambda **_: Memory(100_000, "free on this machine"))
    monkeypatch.setattr("nanogs.scoring.api.named", None)  # nothing is read
    for models in ((splats, splats), (path, splats), (path, path)):
        with pytest.raises(NotEnoughMemoryError, match="fewer or smaller views"):
            nanogs.compare(*models)
    view = {"views": 1, "pixels": 16}
    one, two = (needed_bytes(models, 256, 1, all_of_it=False) for models in ((splats,), (path,)))
    assert two - one == 2000 * splat_bytes(3)  # the file is to be read
    monkeypatch.undo()
    with pytest.raises(NotEnoughMemoryError):
        nanogs.compare(splats, splats, **view, max_memory=LIBRARIES + 1000)
    assert len(nanogs.compare(splats, splats, **view, max_memory=GB).models) == 1


def test_levels_that_are_measured_hold_the_views_of_the_original(monkeypatch):
    splats, asked = make_scene(2000), []
    monkeypatch.setattr(
        "nanogs.pipeline.in_memory.refuse_too_large", lambda _what, needed, *_: asked.append(needed)
    )
    for judged in (False, True):
        judged_levels(splats, [0.5], judged=judged)
    views = 8 * 512 * 512 * 3 * 4
    assert asked[1] - asked[0] >= views


def test_in_python_a_model_that_would_not_fit_is_refused_before_work(monkeypatch):
    splats, stages = make_scene(2000), []
    monkeypatch.setattr(memory, "free_memory", lambda **_: Memory(100_000, "free on this machine"))
    with pytest.raises(NotEnoughMemoryError, match="simplify_blocks"):
        nanogs.simplify(splats, ratio=0.1, progress=lambda *each: stages.append(each))
    with pytest.raises(NotEnoughMemoryError):
        nanogs.levels(splats, [0.5, 0.1])
    assert stages == []
    small, _ = nanogs.simplify(splats, ratio=0.1, preset="fast", max_memory=GB)
    assert len(small) == 200


def test_blocks_that_are_resumed_keep_their_size_whatever_is_free(scene, tmp_path, monkeypatch):
    from nanogs.pipeline.in_blocks import block_memory
    from nanogs.pipeline.job.folder import read_manifest

    job, out = tmp_path / "job", tmp_path / "small.ply"

    class StoppedError(Exception):
        pass

    def stop(step):
        if step.stage == "cut":
            raise StoppedError

    given = {"ratio": 0.1, "job": job, "threads": 1, "preset": "fast", "rounds": 2}
    with pytest.raises(StoppedError):
        nanogs.simplify_blocks(
            scene, out, max_memory=LIBRARIES + 25_000_000, progress=stop, **given
        )
    block = read_manifest(job)[0]["block"]
    assert block_memory(None, None, job, elsewhere=False) == (None, block)
    report = nanogs.simplify_blocks(scene, out, resume=True, **given)
    assert report.blocks.allowed == block
    assert report.blocks.resumed > 0


@pytest.mark.parametrize(
    ("option", "name", "asked"),
    [
        (["--workers", "2"], "simplify", ["-r", "0.1"]),
        (["--workers", "2"], "lod", ["--levels", "0.1"]),
    ],
)
def test_options_for_blocks_that_have_no_effect_are_named(
    scene, tmp_path, capsys, option, name, asked
):
    target = tmp_path / ("a.ply" if name == "simplify" else "a")
    given = [name, scene, target, *asked, "--preset", "fast", *option]
    assert command(*given, "--json") == 0
    (note, *_rest) = json.loads(capsys.readouterr().out)["notes"]
    assert f"{option[0]} had no effect" in note
    assert command(*given, "--json", "-w", "--max-memory", "4GB") == 0
    (note, *_rest) = json.loads(capsys.readouterr().out)["notes"]
    assert note.endswith("because the model fits into --max-memory and needs no blocks.")


@pytest.mark.parametrize("option", [["--resume"], ["--scratch", "x"]])
def test_a_job_of_one_block_is_no_news(scene, tmp_path, capsys, option, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = ["simplify", scene, "a.ply", "-r", "0.1", "--preset", "fast", *option]
    assert command(*given) == 0
    assert "in blocks" not in capsys.readouterr().err


# ---- whatever still runs out ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError(), "Memory ran out;"),
        (
            MemoryError("Unable to allocate 91.6 MiB for an array with shape (500, 16)"),
            r"Memory ran out \(91.6 MiB more were needed\);",
        ),
        (RuntimeError("can't start new thread"), "Memory ran out;"),
        (OSError(36, "File name too long", "aaa"), "aaa: File name too long;"),
    ],
)
def test_failures_of_the_system_are_said_in_one_sentence(error, said):
    import re

    assert re.match(said, sentence_of(error))


@pytest.mark.parametrize("error", [RuntimeError("ours"), ValueError("x"), OSError("no number")])
def test_defects_of_ours_are_not_taken_for_the_systems(error):
    assert sentence_of(error) is None


def test_memory_that_runs_out_in_blocks_names_the_job_that_is_kept(
    scene, tmp_path, little, monkeypatch, capsys
):
    out = tmp_path / "small.ply"
    given = ["simplify", scene, out, "-r", "0.1", "--preset", "fast"]

    def run_out(*_args, **_options):
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr("nanogs.pipeline.work.store_groups", run_out)
        assert command(*given) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "error: Memory ran out; free some" in said
    kept = tmp_path / "small.ply.job"
    assert f"The finished part is kept in {kept}: --resume continues" in said
    assert "another --max-memory." in said
    assert command(*given, "--resume") == 0
    assert [path.name for path in tmp_path.iterdir()] == ["small.ply"]


def test_memory_that_runs_out_before_a_job_is_begun_names_none(
    scene, tmp_path, little, monkeypatch, capsys
):
    def run_out(*_args):
        raise MemoryError

    monkeypatch.setattr("nanogs.pipeline.job.stored.open_scratch", run_out)
    assert command("simplify", scene, tmp_path / "a.ply", "-r", "0.1", "--preset", "fast") == 2
    assert ".job" not in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_memory_that_runs_out_halfway_leaves_nothing(scene, tmp_path, monkeypatch, capsys):
    import nanogs.io.ply.write

    def run_out(*_args, **_options):
        raise MemoryError

    monkeypatch.setattr(nanogs.io.ply.write, "write", run_out)
    monkeypatch.setattr("nanogs.conversion.save", run_out)
    assert command("convert", scene, tmp_path / "a.ply") == 2
    assert "error: Memory ran out; free some" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@LINUX
@pytest.mark.parametrize("limit", [60, 400])
def test_too_low_a_ulimit_is_said_in_one_sentence(scene, tmp_path, limit):
    import resource

    def limited():
        resource.setrlimit(resource.RLIMIT_AS, (limit * 10**6, limit * 10**6))

    run = [sys.executable, "-m", "nanogs", "simplify", scene, tmp_path / "a.ply", "-r", "0.1"]
    found = subprocess.run(run, preexec_fn=limited, capture_output=True, text=True)
    assert found.returncode == 2
    assert found.stderr.startswith("error: ")
    assert found.stderr.count("\n") == 1
    assert "`ulimit -v`" in found.stderr
    assert list(tmp_path.iterdir()) == []


# ---- names without room for a suffix ----------------------------------------------------------


@pytest.mark.parametrize("option", [["--job", "a" * 254 + ".ply"], []])
def test_a_name_too_long_for_a_job_is_said(scene, tmp_path, capsys, option):
    out = tmp_path / ("a.ply" if option else "b" * 248 + ".ply")
    given = ["simplify", scene, out, "-r", "0.1", "--max-memory", "250MB", *option]
    assert command(*given) == 2
    said = capsys.readouterr().err
    assert "(File name too long)" in said
    assert said.rstrip().endswith("name another one with --job.")
    assert list(tmp_path.iterdir()) == []


# ---- looking at models, and converting them -----------------------------------------------------


def asked(name, scene, folder):
    """A command that writes into a folder, and its sentence."""
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
def test_what_takes_more_than_is_free_is_refused_at_once(
    scene, tmp_path, monkeypatch, capsys, name
):
    monkeypatch.setattr(memory, "free_memory", lambda **_: Memory(500_000, "free on this machine"))
    given, said = asked(name, scene, tmp_path)
    assert command(*given) == 2
    text = capsys.readouterr().err
    assert text.startswith(f"error: {said}")
    assert "450.0 kB are free on this machine; free some" in text
    assert text.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", NAMES[:-1])
def test_the_memory_may_be_given(scene, tmp_path, capsys, name):
    given, _said = asked(name, scene, tmp_path)
    assert command(*given, "--max-memory", "60MB") == 2
    assert "of the memory allowed" in capsys.readouterr().err


def test_a_picture_takes_memory_by_its_pixels(scene, tmp_path, capsys):
    given = ["render", scene, tmp_path / "a.png", "--max-memory", "400MB", "--pixels"]
    assert command(*given, "64") == 0
    assert command(*given[:2], tmp_path / "b.png", *given[3:], "4096") == 2


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
    """A folder of models that take memory and one that takes none to speak of."""
    folder = tmp_path_factory.mktemp("models")
    for name, count, degree in (("large", 300_000, 3), ("plain", 300_000, 1), ("small", 1000, 3)):
        nanogs.save(make_scene(count, sh_degree=degree), folder / f"{name}.ply")
    return folder


@LINUX
@pytest.mark.parametrize(
    ("given", "need"),
    [
        (
            ["render", "large.ply", "a.png", "-w"],
            "model_bytes(large) + needs.drawn_bytes(300_000) + needs.shown_bytes(1280 * 720, 0)",
        ),
        (
            ["compare", "large.ply", "small.ply"],
            "compare_bytes([large, small], 512**2, 8, paged=0)",
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
def test_the_need_is_about_what_is_taken(models, given, need):
    from pathlib import Path

    from nanogs import memory_estimates
    from nanogs.io import inspect

    names = {name: inspect(models / f"{name}.ply") for name in ("large", "small")}
    names["file"] = nanogs.open(models / given[1])
    planned = eval(f"needs.{need}", {"needs": memory_estimates, "Path": Path, **names})
    run = [sys.executable, "-c", PEAK, "small.ply", *given]
    found = subprocess.run(run, cwd=models, capture_output=True, text=True, check=True)
    # The first run may leave the heap some of what the second takes.
    streamed = any(f"a{end}" in need for end in (".ply", ".spz", ".glb"))  # a few blocks at most
    assert (0 if streamed else 0.4) < int(found.stdout.split()[-1]) / planned < 1.1


# ---- what is said of blocks, and of what does not need them --------------------------------------


@pytest.mark.parametrize(
    ("given", "looked", "fitted"),
    [
        ({"preset": "default", "steps": 2}, True, True),
        ({"preset": "default", "steps": 0, "rounds": 0}, True, False),
        ({"preset": "default", "measure": False, "steps": 0}, False, False),
        ({"preset": "fast"}, False, False),
    ],
)
def test_the_report_of_blocks_says_what_was_done(tmp_path, given, looked, fitted):
    scene = tmp_path / "in.ply"
    nanogs.save(make_scene(6000), scene)
    if looked:
        given = given | {"views": 4, "view_size": 64}
    report = nanogs.simplify_blocks(
        scene, tmp_path / "a.ply", ratio=0.1, block=3000, threads=1, **given
    )
    assert (report.shown is not None) == looked
    assert bool(report.candidates) == looked
    assert (report.refit is not None) == fitted


def test_presets_that_render_nothing_fit_nothing(capsys):
    assert command("presets", "--json") == 0
    assert json.loads(capsys.readouterr().out)["fast"]["steps"] == 0


@pytest.mark.parametrize(
    ("more", "named", "unnamed"),
    [
        ({}, set(), {"hidden", "steps", "views", "view_size"}),
        ({"steps": 5}, {"steps", "views", "view_size"}, {"hidden"}),
        ({"measure": True}, {"hidden", "steps", "views", "view_size"}, set()),
    ],
)
def test_parameters_without_an_effect_are_not_named(more, named, unnamed):
    shown = effective(parameters("fast", more)).keys()
    assert named <= shown
    assert not unnamed & shown


@pytest.mark.parametrize("more", [[], ["--dry-run"]])
def test_joined_parts_are_all_named_and_counted(scene, tmp_path, capsys, more):
    other = tmp_path / "other.ply"
    nanogs.save(make_scene(1000), other)
    given = ["simplify", scene, other, tmp_path / "a.ply", "--join", "-r", "0.1", "--json"]
    assert command(*given, "--preset", "fast", *more) == 0
    run = json.loads(capsys.readouterr().out)
    assert run["input"] == f"{scene}, {other}"
    assert run["input_count"] == COUNT + 1000
    if not more:
        assert run["input_bytes"] == scene.stat().st_size + other.stat().st_size


def test_too_little_for_chunks_is_refused_before_anything_is_read(
    scene, tmp_path, monkeypatch, capsys
):
    def read(*_args, **_options):
        raise AssertionError

    monkeypatch.setattr("nanogs.pipeline.stages.do", read)
    monkeypatch.setattr("nanogs.pipeline.run.do", read)
    given = ["lod", scene, tmp_path / "web" / "lod-meta.json", "--max-memory", "260MB"]
    (tmp_path / "web").mkdir()
    assert command(*given) == 2
    assert "for chunks; a smaller --chunk takes less" in capsys.readouterr().err
