"""Models in blocks on other machines: lost schedulers and workers, object stores."""

import http.server
import json
import os
import pickle
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import urllib.request
from concurrent.futures import CancelledError, Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import launch
import nanogs
from builders import random_splats
from crashes import CrashError
from nanogs.clock import StageClock
from nanogs.errors import ExistsError, FormatError, NanogsError, OptionError, OutputError
from nanogs.memory import LIBRARIES
from nanogs.pipeline.estimates.block_plan import held_bytes
from nanogs.pipeline.in_blocks import plan_job
from nanogs.pipeline.job import cluster, workers
from nanogs.pipeline.job.folder import refuse_finished
from nanogs.pipeline.options.presets import PRESETS
from nanogs.pipeline.options.target import Goal
from nanogs.pipeline.request import Request
from nanogs.pipeline.run import InProcess, Run, run_tasks
from nanogs.pipeline.work import Work
from nanogs.progress import Tracker
from nanogs.source import Layout
from nanogs.store.scratch import FolderScratch, open_scratch

COUNT, BLOCK = 48_000, 18_000
MEMORY = int((LIBRARIES + held_bytes(BLOCK, COUNT, Layout(0, False, (), "default", (), ()),
                                     PRESETS["fast"], 0.1)) / 0.95) + 1  # fmt: skip
QUICK = {"preset": "fast", "rounds": 2}
GIVEN = {"ratio": 0.1, "block": BLOCK, "threads": 1, **QUICK}


@pytest.fixture(scope="module")
def splats():
    return random_splats(COUNT, degree=0)


@pytest.fixture(scope="module")
def expected(scene, tmp_path_factory):
    """The bytes of the result for the scene."""
    path = tmp_path_factory.mktemp("expected") / "small.ply"
    nanogs.simplify_blocks(scene, path, **GIVEN)
    return path.read_bytes()


def start_command(scene, out, *more, env=None):
    """Start the command in a process of its own."""
    command = [sys.executable, "-m", "nanogs", "simplify", scene, out, "--ratio", "0.1"]
    command += ["--max-memory", f"{MEMORY}B", "--threads", "1", "--job", f"{out}.job"]
    command += ["--preset", "fast", "--rounds", "2", *more]
    return subprocess.Popen(
        list(map(str, command)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env
    )


def stderr_at_end(child, code=0, seconds=200):
    """Wait for the command to end with an exit code, and return its stderr."""
    try:
        text = child.communicate(timeout=seconds)[1]
    except subprocess.TimeoutExpired:
        child.kill()
        pytest.fail("the command did not end")
    assert child.returncode == code, text
    assert "Traceback" not in text
    return text


def wait_until(condition, child, seconds=100, every=0.005):
    """Wait for a condition to become true while a command runs."""
    end = time.monotonic() + seconds
    while not condition():
        assert child.poll() is None, "the command has ended"
        assert time.monotonic() < end
        time.sleep(every)


def finished_tasks(out):
    """Number of finished tasks of a job whose files are in its own folder."""
    return len(list(out.with_name(f"{out.name}.job").glob("scratch/*.json")))


def crash_at(stage, done):
    """Return a progress callback that interrupts the run at a stage."""

    def progress(step):
        if (step.stage, step.done) == (stage, done):
            raise CrashError

    return progress


# ---- schedulers and workers -----------------------------------------------------------------


@contextmanager
def dask(*arguments):
    """Run a process of Dask; gives the process and the address that it prints."""
    pytest.importorskip("distributed")
    command = [sys.executable, "-m", "dask", *map(str, arguments), "--no-dashboard"]
    with tempfile.NamedTemporaryFile("a") as printed:
        child = subprocess.Popen(command, stdout=printed, stderr=printed)

        def find_address():
            return re.search(r"tcp://[\d.]+:\d+", Path(printed.name).read_text())

        try:
            wait_until(find_address, child)
            yield child, find_address()[0]
        finally:
            child.kill()
            child.wait()


def scheduler():
    """Run a scheduler on the loopback interface."""
    return dask("scheduler", "--host", "127.0.0.1", "--port", "0")


def worker(address):
    """Run a worker of the scheduler at an address."""
    return dask("worker", address, "--nthreads", "1", "--memory-limit", "0", "--no-nanny")


@pytest.mark.slow
def test_a_job_can_be_resumed_anywhere_after_its_scheduler_was_killed(scene, tmp_path, expected):
    out = tmp_path / "small.ply"
    with scheduler() as (process, address), worker(address):
        child = start_command(scene, out, "--scheduler", address)
        wait_until(lambda: finished_tasks(out) >= 3, child)
        process.kill()
        start = time.monotonic()
        text = stderr_at_end(child, code=2)
        assert time.monotonic() - start < 60  # usually one second; a busy machine may take longer
    *stages, text = text.splitlines()
    assert all("/" in line for line in stages)  # lines of progress
    assert text.startswith("error: The Dask scheduler was lost")
    assert "--resume continues it" in text
    assert finished_tasks(out) >= 3
    assert not out.exists()
    with pytest.raises(CrashError):  # some tasks in this process
        nanogs.simplify_blocks(scene, out, resume=True, progress=crash_at("grow", 2), **GIVEN)
    with scheduler() as (_, address):  # and the rest on a worker that connects late
        child = start_command(scene, out, "--scheduler", address, "--resume", "--patience", "1")
        text = stderr_at_end(child, code=2)
        assert "note: The cluster has no worker; waiting for one." in text
        assert "error: The Dask cluster has had no worker for 1 seconds" in text
        child = start_command(scene, out, "--scheduler", address, "--resume", "-q")
        with worker(address):
            assert stderr_at_end(child) == ""
    assert out.read_bytes() == expected
    assert [path.name for path in tmp_path.iterdir()] == ["small.ply"]


def test_a_scheduler_that_answers_too_late_leaves_no_open_client(monkeypatch):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(cluster, "_PATIENCE", 0.1)
    refused, closed = threading.Event(), threading.Event()

    class Late:
        def __init__(self, *_address, **_options):
            assert refused.wait(30)

        def close(self):
            closed.set()

    monkeypatch.setattr(distributed, "Client", Late)
    with pytest.raises(OptionError, match="No Dask"), cluster.connected("tcp://late:8786"):
        pass
    refused.set()
    assert closed.wait(30)


def test_an_address_without_a_scheduler_is_refused_in_time(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(cluster, "_PATIENCE", 0.3)
    silent = socket.create_server(("127.0.0.1", 0))
    other = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Quiet)
    threading.Thread(target=other.serve_forever, daemon=True).start()
    ports = [silent.getsockname()[1], other.server_port, 9]
    try:
        for address in [*(f"tcp://127.0.0.1:{port}" for port in ports), "nonsense", ""]:
            start = time.monotonic()
            with (
                pytest.raises(OptionError, match="No Dask scheduler answers"),
                cluster.connected(address),
            ):
                pass
            assert time.monotonic() - start < 20
    finally:
        other.shutdown()
        other.server_close()
        silent.close()


class Quiet(http.server.BaseHTTPRequestHandler):
    """A web server, which is no Dask scheduler."""

    def log_message(self, *_):
        pass


def test_failures_of_tasks_become_clear_errors():
    pytest.importorskip("distributed")
    from distributed import KilledWorker

    from nanogs.pipeline.job.workers import check
    from nanogs.pipeline.scene import Task

    cases = [
        (None, OutputError, "scheduler was lost"),
        (CancelledError(), OutputError, "scheduler was lost"),
        (BrokenProcessPool(), OutputError, "^1 worker ended"),
        (KilledWorker("a", None, 3), OutputError, "^4 workers ended"),
        (ModuleNotFoundError("No module named 'nanogs'"), OptionError, "cannot load nanogs"),
        (RuntimeError("Error during deserialization"), OptionError, "cannot load nanogs .Error"),
        (MemoryError(), OutputError, "grow-0-00002 failed on a worker .MemoryError"),
        (OSError("no space\nleft"), OutputError, r"^grow-0-00002 failed on a worker \(no space\);"),
        (FormatError("It is damaged."), FormatError, "^It is damaged.$"),
        (ZeroDivisionError("a defect"), ZeroDivisionError, "a defect"),
    ]
    for error, kind, message in cases:
        future = Future()
        if error:
            future.set_exception(error)
        else:
            future.cancel()
        with pytest.raises(kind, match=message):
            check(future, Task("grow", 2))


@pytest.fixture
def watched(monkeypatch):
    """Return a function that lets a cluster be watched at a time, and a list of waits."""
    now, waits = [0.0], []
    monkeypatch.setattr(workers, "time", SimpleNamespace(monotonic=lambda: now[0]))
    client = SimpleNamespace(status="running", scheduler=SimpleNamespace(ncores=None))
    watch = workers._Watch(client, 5.0, lambda: waits.append(now[0]))

    def look(seconds, result_at, found, status="running"):
        def sync(*_given, **_more):
            if found is None:
                raise OSError("no answer")
            return dict.fromkeys(range(found))

        now[0], client.sync, client.status = seconds, sync, status
        watch(result_at)

    return look, waits


def test_a_cluster_without_workers_is_given_up_after_the_patience(watched):
    """It is counted from when there last was a worker, or a result."""
    look, waits = watched
    for seconds, result_at, found in ((104, 100, 0), (105, 100, 1), (110, 100, 0), (113, 108, 0)):
        look(seconds, result_at, found)
    with pytest.raises(OutputError, match=r"^The Dask cluster has had no worker for 5 seconds"):
        look(113.5, 108, 0)
    assert waits == [104, 110, 113, 113.5]


def test_a_scheduler_that_is_silent_or_closed_is_lost(watched):
    """It is counted from its last answer, or a result."""
    look, waits = watched
    for seconds, result_at, found in ((110, 100, 1), (140, 100, None), (141, 111, None)):
        look(seconds, result_at, found)
    with pytest.raises(OutputError, match=r"^The Dask scheduler was lost"):
        look(141.5, 111, None)
    with pytest.raises(OutputError, match=r"^The Dask scheduler was lost"):
        look(142, 142, 1, "closed")
    assert waits == []


def test_a_worker_reports_files_that_it_cannot_read(tmp_path):
    from nanogs._version import __version__
    from nanogs.pipeline.job.workers import do_task
    from nanogs.pipeline.scene import Task

    source, host = tmp_path / "in.ply", re.escape(socket.gethostname())
    nanogs.save(random_splats(900), source)
    options = {"inputs": (source,), "output": source, "preset": "fast", "block": 400}
    settings, _ = plan_job(Request(goal=Goal(ratio=0.5), **options))
    with pytest.raises(NanogsError, match=f"On the worker {host}: job-0-00000 of the job"):
        do_task(str(tmp_path / "scratch"), settings, Task("segment"), 1, __version__)
    assert not (tmp_path / "scratch").exists()
    with pytest.raises(OptionError, match="install the same version"):
        do_task(str(tmp_path / "scratch"), settings, Task("segment"), 1, "0.0.1")
    scratch = FolderScratch(tmp_path / "scratch")
    scratch.prepare()
    run = Run(InProcess(), StageClock(), resumed=False)
    run_tasks(Work(scratch, settings, 1), run, Tracker(None, []))
    source.unlink()
    with pytest.raises(FormatError, match=r"in\.ply was not found; the caller and all workers"):
        do_task(str(tmp_path / "scratch"), settings, Task("segment"), 1, __version__)


def test_a_worker_with_too_few_processors_says_so(tmp_path):
    from nanogs._version import __version__
    from nanogs.pipeline.job.workers import do_task
    from nanogs.pipeline.scene import Task

    source, host = tmp_path / "in.ply", re.escape(socket.gethostname())
    nanogs.save(random_splats(9), source)
    options = {"inputs": (source,), "output": source, "preset": "fast", "block": 400}
    settings, _ = plan_job(Request(goal=Goal(ratio=0.5), **options))
    message = f"^On the worker {host}: threads must be from 1 to [0-9]+ on this machine, not 5000.$"
    with pytest.raises(OptionError, match=message) as caught:
        do_task(str(tmp_path / "scratch"), settings, Task("segment"), 5000, __version__)
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


# ---- object stores --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def store():
    """The address of an S3 object store with a bucket."""
    pytest.importorskip("s3fs")
    pytest.importorskip("moto.server")
    # Ports below those that systems assign, and different ones for each test worker: otherwise
    # another process could take the port that was just found free, answer, and end later.
    first = 21_000 + 100 * int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
    port = next(port for port in range(first, first + 100) if not answers(port))
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    address = f"http://127.0.0.1:{port}"
    try:
        wait_until(lambda: answers(port), child)
        send_request(f"{address}/bucket", "PUT")
        send_request(f"{address}/bucket/prefix/mine.json", "PUT", b"{}")
        yield address
    finally:
        child.kill()
        child.wait()


def answers(port):
    """Return whether a process listens on a port."""
    with socket.socket() as one:
        return one.connect_ex(("127.0.0.1", port)) == 0


def send_request(url, method="GET", data=None):
    """Send a request to the store and return the body of the response."""
    with urllib.request.urlopen(urllib.request.Request(url, data, method=method)) as answer:
        return answer.read()


def keys(store):
    """Return the keys in the bucket, including those of unfinished uploads."""
    text = send_request(f"{store}/bucket?list-type=2") + send_request(f"{store}/bucket?uploads")
    return re.findall("<Key>(.*?)</Key>", text.decode())


@pytest.fixture
def s3_store(store, monkeypatch):
    """The address of the store, with the environment variables that clients need."""
    monkeypatch.setenv("AWS_ENDPOINT_URL", store)
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
    return store


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # warnings of boto3
def test_a_killed_run_in_a_store_can_be_resumed_and_leaves_no_objects(
    scene, tmp_path, expected, s3_store
):
    out, options = tmp_path / "small.ply", ["--scratch", "s3://bucket/prefix", "-q"]
    child = start_command(scene, out, *options)
    wait_until(lambda: sum(key.endswith(".npy") for key in keys(s3_store)) >= 3, child, every=0.05)
    child.kill()
    child.communicate()
    damaged = next(key for key in keys(s3_store) if key.endswith(".npy"))
    owner = import_module("boto3").client("s3")
    owner.put_object(Bucket="bucket", Key=damaged, Body=b"damaged")
    unfinished = (
        f"{damaged.rpartition('/')[0]}/store-0-00000.0.npy"  # unfinished, as a kill leaves it
    )
    owner.create_multipart_upload(Bucket="bucket", Key=unfinished)
    owner.close()
    assert unfinished in keys(s3_store)
    assert stderr_at_end(start_command(scene, out, *options, "--resume")) == ""
    assert out.read_bytes() == expected
    assert keys(s3_store) == ["prefix/mine.json"]
    assert [path.name for path in tmp_path.iterdir()] == ["small.ply"]


@pytest.mark.slow
def test_workers_can_use_a_store(scene, tmp_path, expected, s3_store):
    out = tmp_path / "small.ply"
    options = ["--scratch", "s3://bucket", "--workers", "1", "-q"]
    assert stderr_at_end(start_command(scene, out, *options)) == ""
    assert out.read_bytes() == expected
    assert keys(s3_store) == ["prefix/mine.json"]


@pytest.mark.filterwarnings("ignore")
def test_a_store_that_cannot_be_written_is_refused_at_once(scene, tmp_path, s3_store):
    with pytest.raises(OutputError, match=r"s3://typo/.* cannot be written \(.*bucket"):
        nanogs.simplify_blocks(scene, tmp_path / "a.ply", scratch="s3://typo/job", **GIVEN)
    assert list(tmp_path.iterdir()) == []
    assert b"typo" not in send_request(s3_store)


@pytest.mark.filterwarnings("ignore")
def test_simplify_blocks_can_use_a_store(tmp_path, s3_store):
    source, options = tmp_path / "in.ply", {"ratio": 0.5, "preset": "fast", "block": 700}
    owner = import_module("boto3").client("s3")
    theirs = {"Bucket": "bucket", "Key": "prefix/theirs.npy"}  # an upload by somebody else
    upload = theirs | {"UploadId": owner.create_multipart_upload(**theirs)["UploadId"]}
    nanogs.save(random_splats(1200), source)
    nanogs.simplify_blocks(source, tmp_path / "a.ply", threads=1, **options)
    nanogs.simplify_blocks(
        source, tmp_path / "b.ply", threads=1, scratch="s3://bucket/prefix", **options
    )
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert keys(s3_store) == ["prefix/mine.json", "prefix/theirs.npy"]
    owner.abort_multipart_upload(**upload)
    owner.close()


def test_a_missing_fsspec_package_is_named():
    pytest.importorskip("fsspec")
    if find_spec("gcsfs"):
        pytest.skip("gcsfs is there")
    with pytest.raises(OptionError, match=r"^gs://bucket/job needs another package.*nstall gcsfs"):
        open_scratch("gs://bucket/job")


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("nosuch://user:secret@place/job", "nosuch://place/job cannot be reached"),
        ("ftp://user:secret@127.0.0.1:1/job", "ftp://127.0.0.1:1/job cannot be reached"),
    ],
)
def test_errors_name_the_url_without_its_password(url, shown):
    pytest.importorskip("fsspec")
    with pytest.raises(OptionError) as raised:
        open_scratch(url)
    assert str(raised.value).startswith(shown)
    assert "secret" not in str(raised.value)


def test_an_error_of_a_store_is_shown_without_the_password(monkeypatch):
    pytest.importorskip("fsspec")
    scratch = open_scratch("memory://user:secret@store/job")

    def fail(_path):
        raise OSError("no user:secret here")

    monkeypatch.setattr(scratch.files, "exists", fail)
    with pytest.raises(OutputError, match="memory://store/job cannot be written to") as raised:
        scratch.prepare()
    assert "secret" not in "".join(traceback.format_exception(raised.value))
    assert scratch.place == "memory://user:secret@store/job"  # which workers open


def test_a_store_in_which_nothing_can_be_deleted_is_refused_at_once(monkeypatch):
    pytest.importorskip("fsspec")
    scratch = open_scratch("memory://kept/job")

    def refuse(path):
        raise PermissionError(path)

    monkeypatch.setattr(scratch.files, "rm_file", refuse)
    with pytest.raises(OutputError, match=r"^Nothing can be deleted in memory://kept/job"):
        scratch.prepare()
    monkeypatch.undo()
    scratch.remove()


@pytest.mark.parametrize("name", ["job", "threads"])
def test_errors_name_the_url_if_a_file_disappears_meanwhile(name, monkeypatch):
    pytest.importorskip("fsspec")
    scratch = open_scratch(f"memory://missing/{name}")
    scratch.prepare()
    scratch.write("left.tmp", [np.zeros(1, np.uint8)])

    def raise_not_found(path):
        raise FileNotFoundError(path)

    with pytest.raises(FileNotFoundError):  # which callers catch
        scratch.open("nothing.bin")
    monkeypatch.setattr(scratch.files, "rm_file", raise_not_found)
    with pytest.raises(OutputError, match=f"^memory://missing/{name} cannot be tidied"):
        scratch.tidy()
    monkeypatch.undo()
    scratch.remove()


def test_other_files_in_the_scratch_folder_are_kept(tmp_path):
    source, users_file = tmp_path / "in.ply", tmp_path / "scratch" / "mine.json"
    nanogs.save(random_splats(1200), source)
    users_file.parent.mkdir()
    users_file.write_text("{}")
    options = {"ratio": 0.5, "preset": "fast", "block": 700, "threads": 1}
    nanogs.simplify_blocks(source, tmp_path / "a.ply", scratch=str(users_file.parent), **options)
    assert list(users_file.parent.iterdir()) == [users_file]


# ---- --resume and existing files ------------------------------------------------------------


def test_resume_without_an_unfinished_job(scene, tmp_path, expected):
    out, folder = tmp_path / "small.ply", tmp_path / "small.ply.job"
    nanogs.simplify_blocks(scene, out, resume=True, **GIVEN)  # no job: a new one begins
    finished = "exists and {} holds no job, as after a finished run; add -w"
    assert finished.format(folder) in stderr_at_end(start_command(scene, out, "--resume"), code=2)
    with pytest.raises(OutputError, match="nothing to resume"):
        nanogs.simplify_blocks(scene, out, resume=True, **GIVEN)
    with pytest.raises(OutputError, match="exists already; pass overwrite=True"):
        nanogs.simplify_blocks(scene, out, **GIVEN)
    assert out.read_bytes() == expected
    nanogs.simplify_blocks(scene, out, resume=True, overwrite=True, **GIVEN)  # a new run


def test_an_empty_output_folder_is_no_finished_run(tmp_path):
    (tmp_path / "levels").mkdir()
    refuse_finished(tmp_path / "job", tmp_path / "levels")
    (tmp_path / "levels" / "level_0.ply").touch()
    with pytest.raises(ExistsError, match="nothing to resume"):
        refuse_finished(tmp_path / "job", tmp_path / "levels")


def test_resume_refuses_an_existing_output_at_once(scene, tmp_path, expected):
    out = tmp_path / "small.ply"
    with pytest.raises(CrashError):
        nanogs.simplify_blocks(scene, out, progress=crash_at("grow", 1), **GIVEN)
    out.write_text("mine")
    before = finished_tasks(out)
    with pytest.raises(OutputError, match="exists already; pass overwrite=True"):
        nanogs.simplify_blocks(scene, out, resume=True, **GIVEN)
    assert (out.read_text(), finished_tasks(out)) == ("mine", before)
    with pytest.raises(OutputError, match="`resume=True` continues it"):  # overwrite alone fails
        nanogs.simplify_blocks(scene, out, overwrite=True, **GIVEN)
    other = GIVEN | {"ratio": 0.2}
    with pytest.raises(OutputError, match=r"differs: the request \(ratio"):
        nanogs.simplify_blocks(scene, out, overwrite=True, resume=True, **other)
    fits = [sys.executable, "-m", "nanogs", "simplify", scene, out, "--ratio", "0.1", "--resume"]
    enough = ["--max-memory", "2GB", "-w", "--up", "0,0,1", "--sh-degree", "0"]
    result = subprocess.run([*map(str, fits), *enough], capture_output=True, text=True)
    assert result.returncode == 2
    other = "the preset or its parameters, the views (--cameras, --up), --sh-degree"
    assert f"holds another job (what differs: {other}); resume it with the same" in result.stderr
    report = nanogs.simplify_blocks(scene, out, overwrite=True, resume=True, **GIVEN)
    assert report.blocks.resumed >= 3
    assert out.read_bytes() == expected
    assert [path.name for path in tmp_path.iterdir()] == ["small.ply"]


def test_a_relative_scratch_is_found_from_another_folder(scene, tmp_path, expected, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    out = tmp_path / "small.ply"
    with pytest.raises(CrashError):
        nanogs.simplify_blocks(scene, out, scratch="shared", progress=crash_at("grow", 1), **GIVEN)
    scratch = json.loads((tmp_path / "small.ply.job" / "job.json").read_text())["scratch"]
    assert scratch.startswith(str(tmp_path / "here" / "shared" / "nanogs-"))
    monkeypatch.chdir(tmp_path)
    nanogs.simplify_blocks(scene, out, scratch="here/shared", resume=True, **GIVEN)
    assert out.read_bytes() == expected
    assert list((tmp_path / "here").iterdir()) == []


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_commands_read_and_write_models_in_a_store(tmp_path, s3_store):
    """An uploaded file is complete or absent; nothing is replaced without `-w`."""
    source, url = tmp_path / "in.ply", "s3://bucket/models/a b.spz"
    nanogs.save(random_splats(1200), source)
    nanogs.convert(source, tmp_path / "a.spz")
    converted = launch.run("convert", source, url, "--json")
    assert json.loads(converted.stdout)["output"] == url
    with nanogs.open(url) as model:
        assert model.name == url
        assert model.path.read_bytes() == (tmp_path / "a.spz").read_bytes()
    again = launch.run("simplify", source, url, "-r", "0.5", "--preset", "fast")
    assert (again.returncode, again.stderr) == (
        2, f"error: {url} exists already; add -w to replace it.\n"
    )  # fmt: skip
    for address, word in (("s3://typo/a.spz", "typo"), ("s3://bucket/none.spz", "no such file")):
        result = launch.run("info", address)
        assert result.returncode == 2
        *progress, error = result.stderr.splitlines()
        assert (error.startswith(f"error: {address}"), word in error) == (True, True)
        assert set(progress) <= {"1/1 fetch"}  # printed if it takes more than two seconds
    result = launch.run("simplify", source, "s3://typo/a.ply", "-r", "0.5", "--dry-run")
    assert (result.returncode, "s3://typo/a.ply" in result.stderr) == (2, True)
    large = tmp_path / "large.ply"  # uploaded in more than one part
    nanogs.save(random_splats(250_000, degree=3), large)
    nanogs.convert(large, "s3://bucket/models/large.ply")
    assert send_request(f"{s3_store}/bucket/models/large.ply") == large.read_bytes()
    sent = ["models/a b.spz", "models/large.ply"]
    assert sorted(keys(s3_store)) == [*sent, "prefix/mine.json"]
    for key in sent:
        send_request(f"{s3_store}/bucket/{key.replace(' ', '%20')}", "DELETE")
