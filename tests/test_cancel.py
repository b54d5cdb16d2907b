"""A run that is cancelled or killed at any moment leaves no files and no processes behind."""

import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest

import nanogs
from builders import random_splats
from nanogs import cleanup
from nanogs.io import round_trip
from nanogs.io.atomic import atomic_write
from nanogs.io.folder import atomic_folder
from nanogs.io.sog import write as sog_write
from nanogs.io.temporary import name_beside
from nanogs.memory import LIBRARIES

posix = pytest.mark.skipif(os.name == "nt", reason="Windows has other signals, and no such locks")
lists_processes = pytest.mark.skipif(
    not Path("/proc/self/stat").exists(), reason="only Linux lists the processes of a session here"
)
COMMAND = [sys.executable, "-m", "nanogs"]
CAUGHT = {signal.SIGINT, signal.SIGTERM}


def started(*arguments, **options):
    command = [*COMMAND, *map(str, arguments)]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        **options,
    )  # fmt: skip


def listens(child):
    """Return whether a process catches signals already; before that, our code has not started."""
    status = Path(f"/proc/{child.pid}/status")
    if not status.exists():
        time.sleep(0.3)  # without /proc: long enough for any machine
        return True
    mask = next(line for line in status.read_text().splitlines() if line.startswith("SigCgt"))
    caught = int(mask.split()[1], 16)
    return all(caught >> (number - 1) & 1 for number in CAUGHT)


def cancelled(child, number, delay):
    """Send a signal after `delay` seconds, and return the exit code and stderr."""
    while child.poll() is None and not listens(child):
        time.sleep(0.002)
    time.sleep(delay)
    if child.poll() is None:
        # Ctrl-C reaches all processes in the terminal's foreground, other signals a single one.
        (os.killpg if number == signal.SIGINT else os.kill)(child.pid, number)
    stderr = child.communicate(timeout=60)[1]
    return child.returncode, stderr


def contents(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


def living_processes(session):
    """Return the processes of a session that have not ended."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == session and fields[0] != "Z":
            found.append(stat.parent.name)
    return found


def assert_nothing_left(code, stderr, number, folder, before):
    assert "Traceback" not in stderr, stderr
    assert "Exception" not in stderr, stderr
    if code == 0:  # it had finished before the signal
        assert not [name for name in contents(folder) if ".nanogs" in name]
        return
    assert code == 128 + number, stderr
    assert stderr.splitlines()[-1] == "cancelled"
    assert contents(folder) in (before, [*before, "out"], sorted([*before, "out.ply"]))
    if (folder / "out.ply").exists():
        assert len(nanogs.load(folder / "out.ply")) == 2000


@posix
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["ctrl-c", "term"])
@pytest.mark.parametrize("command", ["simplify", "lod", "render"])
def test_a_cancelled_run_leaves_no_files(tmp_path, command, number):
    nanogs.save(random_splats(4000), tmp_path / "in.ply")
    arguments = {
        "simplify": ["out.ply", "--ratio", "0.5", "--preset", "fast"],
        "lod": ["out/lod-meta.json", "--preset", "fast", "--levels", "0.5,0.1"],
        "render": ["out", "--views", "60"],
    }[command]
    delays, codes = random.Random(f"{command} {number}"), []
    for _ in range(4):
        child = started(command, tmp_path / "in.ply", *arguments, cwd=tmp_path)
        code, stderr = cancelled(child, number, delays.uniform(0, 1))
        codes.append(code)
        assert_nothing_left(code, stderr, number, tmp_path, ["in.ply"])
        for path in tmp_path.glob("out*"):
            subprocess.run(["rm", "-r", path], check=True)
    assert any(codes), "every run had ended before its signal"


LATE = """
import os, signal
from nanogs.cli.cancel import listen
listen()
class Late:
    def __del__(self, kill=os.kill, process=os.getpid(), number=signal.SIGTERM):
        kill(process, number)
late = Late()  # it goes while Python ends
"""


@posix
def test_a_signal_while_python_exits_changes_nothing():
    assert subprocess.run([sys.executable, "-c", LATE]).returncode == 0


CLEANED_UP = """
import os, signal, threading, time
from nanogs.cleanup import on_signal
from nanogs.cli.cancel import listen
listen()
read, write = os.pipe()
def use_pipe():
    os.read(read, 1)
    raise OSError("handle is closed")
thread = threading.Thread(target=use_pipe)
thread.start()
def clean():
    os.close(write)
    thread.join()
on_signal(clean)
os.kill(os.getpid(), signal.SIGTERM)
time.sleep(60)
"""


@posix
def test_a_thread_that_fails_because_of_the_clean_up_says_nothing():
    run = subprocess.run([sys.executable, "-c", CLEANED_UP], capture_output=True, text=True)
    assert (run.returncode, run.stderr) == (128 + signal.SIGTERM, "cancelled\n")


@lists_processes
def test_workers_end_when_their_run_is_cancelled(tmp_path):
    nanogs.save(random_splats(60_000), tmp_path / "in.ply")
    delays, codes = random.Random(0), []
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGINT):
        child = started(
            "simplify", tmp_path / "in.ply", tmp_path / "out.ply", "--ratio", "0.1", "--preset",
            "fast", "--max-memory", f"{int(1.09 * LIBRARIES)}B", "--workers", "2",
        )  # fmt: skip
        code, stderr = cancelled(child, number, delays.uniform(0.5, 2.5))
        assert "Traceback" not in stderr
        assert code in (0, 128 + number), stderr
        codes.append(code)
        end = time.monotonic() + 10
        while living_processes(child.pid) and time.monotonic() < end:
            time.sleep(0.05)
        assert not living_processes(child.pid)
        subprocess.run(["rm", "-rf", tmp_path / "out.ply", tmp_path / "out.ply.job"], check=True)
    assert any(codes), "every run had ended before its signal"


@posix
def test_a_cancelled_job_is_named(tmp_path):
    nanogs.save(random_splats(60_000), tmp_path / "in.ply")
    out = tmp_path / "out.ply"
    child = started(
        "simplify", tmp_path / "in.ply", out, "--ratio", "0.1", "--preset", "fast",
        "--max-memory", f"{int(1.09 * LIBRARIES)}B",
    )  # fmt: skip
    manifest = tmp_path / "out.ply.job" / "job.json"
    end = time.monotonic() + 60
    while not manifest.exists() and time.monotonic() < end:
        time.sleep(0.002)
    code, stderr = cancelled(child, signal.SIGINT, 0)
    assert code == 128 + signal.SIGINT, stderr
    said = f"note: {manifest.parent} is kept; --resume continues the run."
    assert stderr.splitlines()[-2:] == [said, "cancelled"]


@pytest.mark.skipif(not shutil.which("bash") or os.name == "nt", reason="needs bash and terminals")
def test_ctrl_c_in_a_terminal_ends_the_loop_of_a_shell_too(tmp_path):
    """The shell goes on with the next file if the program exits by itself, whatever its code."""
    nanogs.save(random_splats(60_000), tmp_path / "in.ply")
    loop = (
        "for i in 1 2; do echo start $i; "
        f"{shlex.join(COMMAND)} simplify in.ply $i.ply --ratio 0.5; echo end $?; done"
    )
    screen, terminal = os.openpty()
    shell = subprocess.Popen(
        ["bash", "-c", loop], cwd=tmp_path, stdin=terminal, stdout=terminal, stderr=terminal,
        start_new_session=True,
    )  # fmt: skip
    os.close(terminal)
    seen = os.read(screen, 1000)
    while b"look" not in seen:
        seen += os.read(screen, 1000)
    os.killpg(shell.pid, signal.SIGINT)
    with suppress(OSError):  # Linux raises when the last process has closed the terminal
        while part := os.read(screen, 1000):
            seen += part
    os.close(screen)
    assert shell.wait(timeout=60) == -signal.SIGINT
    assert seen.rstrip().endswith(b"cancelled")
    assert b"start 2" not in seen
    assert contents(tmp_path) == ["in.ply"]


@lists_processes
def test_workers_end_when_their_run_is_killed(tmp_path):
    nanogs.save(random_splats(60_000), tmp_path / "in.ply")
    child = started(
        "simplify", tmp_path / "in.ply", tmp_path / "out.ply", "--ratio", "0.1", "--preset",
        "fast", "--max-memory", f"{int(1.09 * LIBRARIES)}B", "--workers", "2",
    )  # fmt: skip
    end = time.monotonic() + 60
    # Four processes: the run, two workers, and Python's resource tracker.
    while len(living_processes(child.pid)) < 4 and time.monotonic() < end:
        assert child.poll() is None
        time.sleep(0.01)
    assert len(living_processes(child.pid)) >= 4
    child.kill()
    child.communicate(timeout=60)  # workers hold its stderr too
    while living_processes(child.pid) and time.monotonic() < end:
        time.sleep(0.05)
    assert not living_processes(child.pid)


START = """
import os, signal, sys
from multiprocessing import util
from nanogs.cli.cancel import listen
from nanogs.pipeline.job.cluster import processes
from nanogs.bench.worker import Job, run_job
from nanogs.studio.process import Process
spawn = util.spawnv_passfds
def interrupted(*arguments):
    child = spawn(*arguments)
    if "--multiprocessing-fork" in arguments[1]:  # no keeper of semaphores
        os.kill(os.getpid(), int(sys.argv[2]))  # the child waits now for what it is to do
    return child
def pool():
    with processes(1):
        pass
if __name__ == "__main__":
    util.spawnv_passfds = interrupted
    listen()
    starts = {
        "pool": pool,
        "bench": lambda: run_job(Job("in.ply", "fast", 0.1, "out.ply")),
        "studio": lambda: Process("scene", "settings", print),
    }
    starts[sys.argv[1]]()
"""


@posix
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["ctrl-c", "term"])
@pytest.mark.parametrize("starter", ["pool", "bench", "studio"])
def test_a_run_cancelled_while_it_starts_a_process_ends_quietly(tmp_path, starter, number):
    script = tmp_path / "start.py"
    script.write_text(START)
    result = subprocess.run(
        [sys.executable, script, starter, str(int(number))],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert result.returncode == 128 + number
    assert result.stderr == "cancelled\n"


HOLD = """
import sys, time
from pathlib import Path
from nanogs.io.atomic import atomic_write
from nanogs.io.folder import atomic_folder
out = Path(sys.argv[1])
with (atomic_folder(out, lambda _: None) if sys.argv[2] == "folder" else atomic_write(out)) as made:
    if sys.argv[2] == "folder":
        (made / "file").write_bytes(b"half")
    print("ready", flush=True)
    time.sleep(100)
"""


def start_holding(out, kind):
    child = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(out), kind], stdout=subprocess.PIPE, text=True
    )
    assert child.stdout.readline() == "ready\n"
    return child


def write(out, kind):
    if kind == "folder":
        with atomic_folder(out, lambda _: None) as new_folder:
            (new_folder / "file").write_bytes(b"whole")
    else:
        with atomic_write(out) as file:
            file.write(b"whole")


@posix
@pytest.mark.parametrize("kind", ["file", "folder"])
def test_the_next_run_removes_the_leftovers_of_a_killed_one(tmp_path, kind):
    out = tmp_path / "out"
    child = start_holding(out, kind)
    (leftover,) = contents(tmp_path)[:1]
    assert leftover.startswith(".nanogs-")
    write(tmp_path / "other", kind)  # leftovers of other outputs stay
    assert leftover in contents(tmp_path)
    child.kill()
    child.communicate()
    write(tmp_path / "another", kind)
    assert leftover in contents(tmp_path)
    write(out, kind)
    assert leftover not in contents(tmp_path)
    assert not any(".nanogs" in name for name in contents(tmp_path))


@posix
@pytest.mark.parametrize("kind", ["file", "folder"])
def test_files_of_a_running_process_are_not_removed(tmp_path, kind):
    child = start_holding(tmp_path / "out", kind)
    before = contents(tmp_path)
    write(tmp_path / "out", kind)
    assert set(before) < set(contents(tmp_path))
    child.kill()
    child.communicate()


@posix
@pytest.mark.parametrize("new_folder_exists", [True, False])
def test_a_folder_whose_replacement_was_interrupted_is_restored(tmp_path, new_folder_exists):
    """The run was killed after the old folder was moved away, before or after the new one came."""
    out = tmp_path / "out"
    old = name_beside(out, ".old")
    old.mkdir()
    (old / "file").write_text("old")
    if new_folder_exists:
        out.mkdir()
        (out / "file").write_text("new")

    def files_of_ours(_folder):
        return frozenset({"file"})

    with (
        pytest.raises(nanogs.NanogsError, match="exists already"),
        atomic_folder(out, files_of_ours),
    ):
        pass
    assert contents(tmp_path) == ["out", "out/file"]
    assert (out / "file").read_text() == ("new" if new_folder_exists else "old")


@posix
def test_a_folder_whose_deletion_was_interrupted_does_not_block_its_output(tmp_path, monkeypatch):
    class KilledError(BaseException):
        pass

    def unlink(path, missing_ok=False):
        if ".old" in str(path):
            if len(deleted) == most:
                raise KilledError
            deleted.append(path.name)
        real(path, missing_ok=missing_ok)

    out, real, splats = tmp_path / "out", Path.unlink, random_splats(20)
    sog_write.write_folder(splats, out)
    names = contents(out)
    for most in range(len(names)):
        deleted = []
        with monkeypatch.context() as patch:
            patch.setattr(Path, "unlink", unlink)
            with pytest.raises(KilledError):
                sog_write.write_folder(splats, out, overwrite=True)
        assert len(deleted) == most
        assert len(contents(tmp_path)) > len(names) + 1
        sog_write.write_folder(splats, out, overwrite=True)
        assert contents(tmp_path) == ["out", *(f"out/{name}" for name in names)]
    old = name_beside(out, ".old")  # with a file that is not ours
    old.mkdir()
    (old / "file").touch()
    sog_write.write_folder(splats, out, overwrite=True)
    assert (old / "file").exists()


def test_clean_ups_run_in_reverse_order_and_not_after_their_context():
    order = []
    with cleanup.cleaned_up(lambda: order.append(1)):
        with cleanup.cleaned_up(lambda: order.append(2)):
            cleanup.clean_all()
        assert order == [2, 1, 2]
    assert order == [2, 1, 2, 1]
    cleanup.clean_all()
    assert order == [2, 1, 2, 1]


def test_temporary_files_of_a_round_trip_are_removed_on_exit(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    def load_after_exit(_path):
        cleanup.clean_all()
        assert contents(tmp_path) == []
        return splats

    splats = random_splats(5)
    monkeypatch.setattr("nanogs.io.load", load_after_exit)
    assert round_trip(splats, "a.splat") is splats


def test_exit_is_deferred_until_the_outermost_context_ends(monkeypatch):
    exits = []
    with cleanup.defer_exit():
        with cleanup.defer_exit():
            cleanup.exit_when_allowed(lambda: exits.append(1))
        assert exits == []
    assert exits == [1]
    monkeypatch.setattr(cleanup, "_postponed", None)
    cleanup.exit_when_allowed(lambda: exits.append(2))
    assert exits == [1, 2]


def test_an_exit_is_not_lost_if_another_thread_ends_its_context_meanwhile():
    begun, leaving, exits = threading.Event(), threading.Event(), []

    def hold():
        with cleanup.defer_exit():
            begun.set()
            leaving.wait()

    class Looked(int):
        """A count of contexts, one of which ends when somebody has looked."""

        def __bool__(self):
            leaving.set()
            other.join(0.5)
            return True

    other = threading.Thread(target=hold)
    other.start()
    begun.wait()
    cleanup._undisturbed = Looked(1)
    cleanup.exit_when_allowed(lambda: exits.append(1))
    other.join()
    assert exits == [1]
