"""Models in blocks on other machines: schedulers and workers that go, object stores."""

import http.server
import json
import os
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from concurrent.futures import CancelledError, Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

import launch
import nanogs
from builders import random_splats
from crashes import CrashError
from nanogs.clock import StageClock
from nanogs.errors import FormatError, NanogsError, OptionError, OutputError
from nanogs.memory import LIBRARIES
from nanogs.pipeline.estimates.block_plan import held_bytes
from nanogs.pipeline.in_blocks import plan_job
from nanogs.pipeline.job import cluster
from nanogs.pipeline.options.presets import PRESETS
from nanogs.pipeline.options.target import Goal
from nanogs.pipeline.request import Request
from nanogs.pipeline.run import InProcess, run_tasks
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
    """The bytes of its result."""
    path = tmp_path_factory.mktemp("expected") / "small.ply"
    nanogs.simplify_blocks(scene, path, **GIVEN)
    return path.read_bytes()


def started(scene, out, *more, env=None):
    """The command, running."""
    command = [sys.executable, "-m", "nanogs", "simplify", scene, out, "--ratio", "0.1"]
    command += ["--max-memory", f"{MEMORY}B", "--threads", "1", "--job", f"{out}.job"]
    command += ["--preset", "fast", "--rounds", "2", *more]
    return subprocess.Popen(
        list(map(str, command)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env
    )


def ended(child, code=0, seconds=200):
    """Wait for the command to end and return its stderr: one line, if in error."""
    try:
        text = child.communicate(timeout=seconds)[1]
    except subprocess.TimeoutExpired:
        child.kill()
        pytest.fail("the command did not end")
    assert child.returncode == code, text
    assert "Traceback" not in text
    return text


def until(condition, child, seconds=100, every=0.005):
    """Wait for something to be so while a command runs."""
    end = time.monotonic() + seconds
    while not condition():
        assert child.poll() is None, "the command has ended"
        assert time.monotonic() < end
        time.sleep(every)


def records(out):
    """How many tasks are done of a job that keeps its files in its own folder."""
    return len(list(out.with_name(f"{out.name}.job").glob("scratch/*.json")))


def crash_at(stage, done):
    """A listener to progress that ends the run at a stage."""

    def progress(step):
        if (step.stage, step.done) == (stage, done):
            raise CrashError

    return progress


# ---- schedulers and workers -----------------------------------------------------------------


@contextmanager
def dask(*arguments):
    """A process of Dask, and the address that it says."""
    pytest.importorskip("distributed")
    command = [sys.executable, "-m", "dask", *map(str, arguments), "--no-dashboard"]
    with tempfile.NamedTemporaryFile("a") as said:
        child = subprocess.Popen(command, stdout=said, stderr=said)

        def address():
            return re.search(r"tcp://[\d.]+:\d+", Path(said.name).read_text())

        try:
            until(address, child)
            yield child, address()[0]
        finally:
            child.kill()
            child.wait()


def scheduler():
    """A scheduler on loopback."""
    return dask("scheduler", "--host", "127.0.0.1", "--port", "0")


def worker(address):
    """A worker of it."""
    return dask("worker", address, "--nthreads", "1", "--memory-limit", "0", "--no-nanny")


@pytest.mark.slow
def test_a_scheduler_that_is_killed_ends_the_run_and_the_job_goes_on_anywhere(
    scene, tmp_path, expected
):
    out = tmp_path / "small.ply"
    with scheduler() as (process, address), worker(address):
        child = started(scene, out, "--scheduler", address)
        until(lambda: records(out) >= 3, child)
        process.kill()
        start = time.monotonic()
        text = ended(child, code=2)
        assert time.monotonic() - start < 60  # it takes one; machines are busy
    *stages, text = text.splitlines()
    assert all("/" in line for line in stages)  # lines of its progress
    assert text.startswith("error: The Dask scheduler was lost")
    assert "--resume continues it" in text
    assert records(out) >= 3
    assert not out.exists()
    with pytest.raises(CrashError):  # some of it here
        nanogs.simplify_blocks(scene, out, resume=True, progress=crash_at("grow", 2), **GIVEN)
    with scheduler() as (_, address):  # and the rest by a worker that comes late
        child = started(scene, out, "--scheduler", address, "--resume", "--patience", "1")
        text = ended(child, code=2)
        assert "note: The cluster has no worker; waiting for one." in text
        assert "error: The Dask cluster has had no worker for 1 seconds" in text
        child = started(scene, out, "--scheduler", address, "--resume", "-q")
        with worker(address):
            assert ended(child) == ""
    assert out.read_bytes() == expected
    assert [path.name for path in tmp_path.iterdir()] == ["small.ply"]


def test_what_is_no_scheduler_is_said_in_time(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(cluster, "_PATIENCE", 0.3)
    mute = socket.create_server(("127.0.0.1", 0))
    other = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Quiet)
    threading.Thread(target=other.serve_forever, daemon=True).start()
    ports = [mute.getsockname()[1], other.server_port, 9]
    try:
        for place in [*(f"tcp://127.0.0.1:{port}" for port in ports), "nonsense", ""]:
            start = time.monotonic()
            with (
                pytest.raises(OptionError, match="No Dask scheduler answers"),
                cluster.connected(place),
            ):
                pass
            assert time.monotonic() - start < 20
    finally:
        other.shutdown()
        other.server_close()
        mute.close()


class Quiet(http.server.BaseHTTPRequestHandler):
    """A server that is none of Dask's."""

    def log_message(self, *_):
        pass


def test_how_a_task_ended_is_said():
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
        (MemoryError(), OutputError, "grow-0-00002 failed on a worker .MemoryError"),
        (FormatError("It is damaged."), FormatError, "^It is damaged.$"),
        (ZeroDivisionError("a defect"), ZeroDivisionError, "a defect"),
    ]
    for error, kind, said in cases:
        future = Future()
        if error:
            future.set_exception(error)
        else:
            future.cancel()
        with pytest.raises(kind, match=said):
            check(future, Task("grow", 2))


def test_a_worker_says_what_it_does_not_see(tmp_path):
    from nanogs._version import __version__
    from nanogs.pipeline.job.workers import do_task
    from nanogs.pipeline.scene import Task

    source, host = tmp_path / "in.ply", re.escape(socket.gethostname())
    nanogs.save(random_splats(900), source)
    request = Request(goal=Goal(ratio=0.5), inputs=(source,), output=source, preset="fast")
    settings, _ = plan_job(request, None, 400)
    with pytest.raises(NanogsError, match=f"On the worker {host}: job-0-00000 of the job"):
        do_task(str(tmp_path / "scratch"), settings, Task("segment"), 1, __version__)
    assert not (tmp_path / "scratch").exists()
    with pytest.raises(OptionError, match="install the same version"):
        do_task(str(tmp_path / "scratch"), settings, Task("segment"), 1, "0.0.1")
    scratch = FolderScratch(tmp_path / "scratch")
    scratch.prepare()
    run_tasks(scratch, settings, InProcess(), 1, StageClock(), Tracker(None, []),
              resumed=False)  # fmt: skip
    source.unlink()
    with pytest.raises(FormatError, match=r"in\.ply was not found; the caller and all workers"):
        do_task(str(tmp_path / "scratch"), settings, Task("segment"), 1, __version__)


# ---- stores of objects ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def store():
    """The address of a store that speaks S3, with a bucket."""
    pytest.importorskip("s3fs")
    pytest.importorskip("moto.server")
    # Ports that no system gives away by itself, others for each worker: one that was free a moment
    # ago may be another's by now, which would answer and be gone later.
    first = 21_000 + 100 * int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
    port = next(port for port in range(first, first + 100) if not answers(port))
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    address = f"http://127.0.0.1:{port}"
    try:
        until(lambda: answers(port), child)
        ask(f"{address}/bucket", "PUT")
        ask(f"{address}/bucket/prefix/mine.json", "PUT", b"{}")
        yield address
    finally:
        child.kill()
        child.wait()


def answers(port):
    """Whether anyone listens."""
    with socket.socket() as one:
        return one.connect_ex(("127.0.0.1", port)) == 0


def ask(url, method="GET", data=None):
    """The store's answer to a request."""
    with urllib.request.urlopen(urllib.request.Request(url, data, method=method)) as answer:
        return answer.read()


def keys(store):
    """Keys in the bucket, with those of unfinished uploads."""
    text = ask(f"{store}/bucket?list-type=2") + ask(f"{store}/bucket?uploads")
    return re.findall("<Key>(.*?)</Key>", text.decode())


@pytest.fixture
def keyed(store, monkeypatch):
    """The environment by which the store is found."""
    monkeypatch.setenv("AWS_ENDPOINT_URL", store)
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
    return store


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of boto3's own
def test_a_killed_run_with_a_store_is_resumed_and_the_store_emptied(
    scene, tmp_path, expected, keyed
):
    out, given = tmp_path / "small.ply", ["--scratch", "s3://bucket/prefix", "-q"]
    child = started(scene, out, *given)
    until(lambda: sum(key.endswith(".npy") for key in keys(keyed)) >= 3, child, every=0.05)
    child.kill()
    child.communicate()
    damaged = next(key for key in keys(keyed) if key.endswith(".npy"))
    owner = import_module("boto3").client("s3")
    owner.put_object(Bucket="bucket", Key=damaged, Body=b"damaged")
    lost = f"{damaged.rpartition('/')[0]}/part-0-00000.0.npy"  # an upload, as a kill leaves it
    owner.create_multipart_upload(Bucket="bucket", Key=lost)
    owner.close()
    assert lost in keys(keyed)
    assert ended(started(scene, out, *given, "--resume")) == ""
    assert out.read_bytes() == expected
    assert keys(keyed) == ["prefix/mine.json"]
    assert [path.name for path in tmp_path.iterdir()] == ["small.ply"]


@pytest.mark.slow
def test_a_worker_uses_a_store_too(scene, tmp_path, expected, keyed):
    out = tmp_path / "small.ply"
    given = ["--scratch", "s3://bucket", "--workers", "1", "-q"]
    assert ended(started(scene, out, *given)) == ""
    assert out.read_bytes() == expected
    assert keys(keyed) == ["prefix/mine.json"]


@pytest.mark.filterwarnings("ignore")
def test_what_a_store_refuses_is_said_before_anything_is_done(scene, tmp_path, keyed):
    with pytest.raises(OutputError, match=r"s3://typo/.* cannot be written \(.*bucket"):
        nanogs.simplify_blocks(scene, tmp_path / "a.ply", scratch="s3://typo/job", **GIVEN)
    assert list(tmp_path.iterdir()) == []
    assert b"typo" not in ask(keyed)


@pytest.mark.filterwarnings("ignore")
def test_the_library_takes_a_store_too(tmp_path, keyed):
    source, given = tmp_path / "in.ply", {"ratio": 0.5, "preset": "fast", "block": 700}
    nanogs.save(random_splats(1200), source)
    nanogs.simplify_blocks(source, tmp_path / "a.ply", threads=1, **given)
    nanogs.simplify_blocks(
        source, tmp_path / "b.ply", threads=1, scratch="s3://bucket/prefix", **given
    )
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert keys(keyed) == ["prefix/mine.json"]


def test_what_reaches_a_store_is_named_where_it_is_missing():
    pytest.importorskip("fsspec")
    if find_spec("gcsfs"):
        pytest.skip("gcsfs is there")
    with pytest.raises(OptionError, match=r"^gs://bucket/job needs another package.*nstall gcsfs"):
        open_scratch("gs://bucket/job")


@pytest.mark.parametrize("name", ["job", "threads"])
def test_what_goes_missing_meanwhile_is_said_whatever_the_url(name, monkeypatch):
    pytest.importorskip("fsspec")
    scratch = open_scratch(f"memory://missing/{name}")
    scratch.prepare()
    scratch.write("left.tmp", [np.zeros(1, np.uint8)])

    def gone(path):
        raise FileNotFoundError(path)

    with pytest.raises(FileNotFoundError):  # which callers look for
        scratch.open("nothing.bin")
    monkeypatch.setattr(scratch.files, "rm_file", gone)
    with pytest.raises(OutputError, match=f"^memory://missing/{name} cannot be tidied"):
        scratch.tidy()
    monkeypatch.undo()
    scratch.remove()


def test_files_of_others_in_the_scratch_are_left_alone(tmp_path):
    source, own = tmp_path / "in.ply", tmp_path / "scratch" / "mine.json"
    nanogs.save(random_splats(1200), source)
    own.parent.mkdir()
    own.write_text("{}")
    given = {"ratio": 0.5, "preset": "fast", "block": 700, "threads": 1}
    nanogs.simplify_blocks(source, tmp_path / "a.ply", scratch=str(own.parent), **given)
    assert list(own.parent.iterdir()) == [own]


# ---- --resume and what is there -------------------------------------------------------------


def test_resume_says_what_it_finds(scene, tmp_path, expected):
    out, folder = tmp_path / "small.ply", tmp_path / "small.ply.job"
    nanogs.simplify_blocks(scene, out, resume=True, **GIVEN)  # nothing there: it begins
    finished = "exists and {} holds no job, as after a finished run; add -w"
    assert finished.format(folder) in ended(started(scene, out, "--resume"), code=2)
    with pytest.raises(OutputError, match="nothing to resume"):
        nanogs.simplify_blocks(scene, out, resume=True, **GIVEN)
    with pytest.raises(OutputError, match="exists already; pass overwrite=True"):
        nanogs.simplify_blocks(scene, out, **GIVEN)
    assert out.read_bytes() == expected
    nanogs.simplify_blocks(scene, out, resume=True, overwrite=True, **GIVEN)  # anew


def test_resume_with_an_output_in_the_way_says_so_at_once(scene, tmp_path, expected):
    out = tmp_path / "small.ply"
    with pytest.raises(CrashError):
        nanogs.simplify_blocks(scene, out, progress=crash_at("grow", 1), **GIVEN)
    out.write_text("mine")
    before = records(out)
    with pytest.raises(OutputError, match="exists already; pass overwrite=True"):
        nanogs.simplify_blocks(scene, out, resume=True, **GIVEN)
    assert (out.read_text(), records(out)) == ("mine", before)
    with pytest.raises(OutputError, match="`resume=True` continues it"):  # -w alone does not
        nanogs.simplify_blocks(scene, out, overwrite=True, **GIVEN)
    other = GIVEN | {"ratio": 0.2}
    with pytest.raises(OutputError, match=r"differs: the request \(ratio"):
        nanogs.simplify_blocks(scene, out, overwrite=True, resume=True, **other)
    fits = [sys.executable, "-m", "nanogs", "simplify", scene, out, "--ratio", "0.1", "--resume"]
    enough = ["--max-memory", "2GB", "-w", "--up", "0,0,1", "--sh-degree", "0"]
    done = subprocess.run([*map(str, fits), *enough], capture_output=True, text=True)
    assert done.returncode == 2
    other = "the preset or its parameters, the views (--cameras, --up), --sh-degree"
    assert f"holds another job (what differs: {other}); resume it with the same" in done.stderr
    report = nanogs.simplify_blocks(scene, out, overwrite=True, resume=True, **GIVEN)
    assert report.blocks.resumed >= 3
    assert out.read_bytes() == expected
    assert [path.name for path in tmp_path.iterdir()] == ["small.ply"]


def test_a_relative_scratch_is_found_from_elsewhere(scene, tmp_path, expected, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    out = tmp_path / "small.ply"
    with pytest.raises(CrashError):
        nanogs.simplify_blocks(scene, out, scratch="shared", progress=crash_at("grow", 1), **GIVEN)
    place = json.loads((tmp_path / "small.ply.job" / "job.json").read_text())["scratch"]
    assert place.startswith(str(tmp_path / "here" / "shared" / "nanogs-"))
    monkeypatch.chdir(tmp_path)
    nanogs.simplify_blocks(scene, out, scratch="here/shared", resume=True, **GIVEN)
    assert out.read_bytes() == expected
    assert list((tmp_path / "here").iterdir()) == []


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_models_in_a_store(tmp_path, keyed):
    """A file that is sent is there whole or not at all; nothing is replaced unasked."""
    source, url = tmp_path / "in.ply", "s3://bucket/models/a b.spz"
    nanogs.save(random_splats(1200), source)
    nanogs.convert(source, tmp_path / "a.spz")
    said = launch.run("convert", source, url, "--json")
    assert json.loads(said.stdout)["output"] == url
    with nanogs.open(url) as model:
        assert model.name == url
        assert model.path.read_bytes() == (tmp_path / "a.spz").read_bytes()
    again = launch.run("simplify", source, url, "-r", "0.5", "--preset", "fast")
    assert (again.returncode, again.stderr) == (
        2, f"error: {url} exists already; add -w to replace it.\n"
    )  # fmt: skip
    for place, word in (("s3://typo/a.spz", "typo"), ("s3://bucket/none.spz", "no such file")):
        result = launch.run("info", place)
        assert result.returncode == 2
        *told, error = result.stderr.splitlines()
        assert (error.startswith(f"error: {place}"), word in error) == (True, True)
        assert set(told) <= {"1/1 fetch"}  # where it takes more than two seconds
    result = launch.run("simplify", source, "s3://typo/a.ply", "-r", "0.5", "--dry-run")
    assert (result.returncode, "s3://typo/a.ply" in result.stderr) == (2, True)
    large = tmp_path / "large.ply"  # in more than one part
    nanogs.save(random_splats(250_000, degree=3), large)
    nanogs.convert(large, "s3://bucket/models/large.ply")
    assert ask(f"{keyed}/bucket/models/large.ply") == large.read_bytes()
    sent = ["models/a b.spz", "models/large.ply"]
    assert sorted(keys(keyed)) == [*sent, "prefix/mine.json"]
    for key in sent:
        ask(f"{keyed}/bucket/{key.replace(' ', '%20')}", "DELETE")
