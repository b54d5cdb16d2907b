"""The worker process, which holds the scene and calls the library, one job at a time."""

import os
import queue
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection
from types import FrameType
from typing import TYPE_CHECKING, Any

from nanogs.allocation import keep_freed_memory
from nanogs.cleanup import clean_all, exit_when_allowed
from nanogs.errors import NanogsError
from nanogs.progress import Progress, Step
from nanogs.studio.choice import Choice
from nanogs.studio.jobs import Job
from nanogs.studio.scene import Scene, StudioSettings
from nanogs.studio.showing import Shown

if TYPE_CHECKING:
    from nanogs.studio.handler import JobHandler

EVERY = 0.1  # least seconds between two progress events of the same stage


class Cancelled(BaseException):
    """The job has been cancelled; not an `Exception`, so that no handler catches it as an error."""


class Line:
    """The connection to the server, with a lock so that any thread can send."""

    def __init__(self, line: Connection) -> None:
        """Wrap a connection."""
        self._line, self._lock = line, threading.Lock()
        self.recv = line.recv

    def send(self, message: tuple[Any, ...]) -> None:
        """Send a message."""
        with self._lock:
            self._line.send(message)


class Inbox:
    """Messages of the server, read by a separate thread."""

    def __init__(self, line: Line) -> None:
        """Start the reading thread.

        Args:
            line: Connection to the server; this process exits when it is closed.
        """
        self.jobs: queue.Queue[Job] = queue.Queue()
        self.successors: queue.Queue[Job] = queue.Queue()  # requests that replace the running job
        self._line = line
        self._dropped: dict[int, Job | None] = {}
        self._seen: dict[str, str] = {}  # by page, ID of the model that it has drawn last
        self._paces: dict[str, float] = {}
        self._news = threading.Condition()  # notified of changes to `_dropped` and `_seen`
        threading.Thread(target=self._read, daemon=True).start()

    def dropped(self, job: Job) -> bool:
        """Return whether a job has been cancelled or replaced."""
        return job.id in self._dropped

    def successor(self, job: Job) -> Job | None:
        """Return the newer request that replaced a job, or None."""
        return self._dropped.get(job.id)

    def pace(self, page: str) -> float | None:
        """Return the seconds that a page takes to draw one splat, if it has reported it."""
        return self._paces.get(page)

    def begin(self, job: Job) -> None:
        """Remove the records of cancelled jobs before this one."""
        with self._news:  # the reading thread adds to them
            for each in [each for each in self._dropped if each < job.id]:
                del self._dropped[each]

    def rest(self, job: Job, model: str, least: float, most: float) -> None:
        """Wait `least` to `most` seconds for a job's model to be drawn, or until it is dropped."""
        begun = time.monotonic()
        with self._news:
            self._news.wait_for(lambda: self.dropped(job), least)
            left = max(0.0, begun + most - time.monotonic())
            self._news.wait_for(
                lambda: self.dropped(job) or self._seen.get(job.page) == model, left
            )

    def _read(self) -> None:
        try:
            while True:
                kind, said = self._line.recv()
                if kind == "seen":
                    self._note(*said)
                elif kind == "cancel":
                    with self._news:
                        self._dropped[said[0]] = said[1]
                        self._news.notify_all()
                    if said[1] is not None and said[1].kind == "ask":
                        self.successors.put(said[1])
                else:
                    self.jobs.put(said)
        except (EOFError, OSError):
            _end(1)

    def _note(self, page: str, model: str, pace: float | None) -> None:
        with self._news:
            self._seen[page] = model
            if pace is not None:
                self._paces[page] = pace
            self._news.notify_all()


class WorkerChannel:
    """Sends the events of a job to the server; see `Channel`."""

    def __init__(self, line: Line, inbox: Inbox, job: Job) -> None:
        """Prepare to send events of a job.

        Args:
            line: Connection to the server.
            inbox: Messages of the server, among them that the job is cancelled.
            job: The job.
        """
        self._line, self._inbox, self._job = line, inbox, job
        self._useful: Callable[[Choice], bool] | None = None
        self.page, self.id = job.page, job.id

    def __call__(self, event: dict[str, Any], shown: Shown | None = None) -> None:
        """Send an event, with a model that it names."""
        self.check()
        if event["type"] not in ("point", "scene"):
            event = event | {"number": self._job.number}
        if shown is not None:
            event = event | {"model": shown.entry}
        self._line.send(("event", self.page, event, shown.models if shown else {}))

    def check(self) -> None:
        """Raise if the job has been cancelled, unless it is shielded.

        Raises:
            Cancelled: It has been.
        """
        if not self._inbox.dropped(self._job):
            return
        newer = self._inbox.successor(self._job)
        if self._useful and newer and isinstance(newer.work, Choice) and self._useful(newer.work):
            return
        raise Cancelled

    def progress(self, kind: str) -> Progress:
        """Return a progress callback that sends events; it raises `Cancelled` if the job is."""
        stage, since, number = "", 0.0, self._job.number

        def on_step(step: Step) -> None:
            nonlocal stage, since
            self.check()
            now = time.monotonic()
            if step.stage == stage and now - since < EVERY:
                return
            stage, since = step.stage, now
            event = {
                "type": "progress", "number": number, "kind": kind, "stage": step.stage,
                "fraction": step.fraction,
            }  # fmt: skip
            self._line.send(("event", self.page, event, {}))

        return on_step

    @property
    def pace(self) -> float | None:
        """Seconds that the page takes to draw one splat, if it has reported it."""
        return self._inbox.pace(self.page)

    def rest(self, model: str, least: float, most: float) -> None:
        """Wait `least` to `most` seconds for the page to draw a model; raise if cancelled."""
        self._inbox.rest(self._job, model, least, most)
        self.check()

    @contextmanager
    def shielded(self, useful: Callable[[Choice], bool]) -> Iterator[None]:
        """Ignore a newer request in the context if `useful` says that the work serves it too."""
        self._useful = useful
        try:
            yield
        finally:
            self._useful = None
        self.check()


def work(connection: Connection, scene: Scene, settings: StudioSettings) -> None:
    """Run the worker process: do jobs until the server ends; the first opens the scene.

    Args:
        connection: Connection to the server.
        scene: The scene to open.
        settings: Settings of the studio.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _stop)
    line = Line(connection)
    inbox = Inbox(line)
    from nanogs.studio.handler import JobHandler  # imported here because it imports Numba

    keep_freed_memory()
    handler = JobHandler(scene, settings)
    threading.Thread(target=_draft_sooner, args=(handler, line, inbox), daemon=True).start()
    while True:
        job = inbox.jobs.get()
        inbox.begin(job)
        line.send(("done", *_outcome(handler, job, WorkerChannel(line, inbox, job))))


def _draft_sooner(handler: "JobHandler", line: Line, inbox: Inbox) -> None:
    """Make drafts of newer requests while the job that they replace is still stopping.

    Of several requests only the latest gets a draft. Errors are ignored here: they are raised again
    and reported when the request's turn comes.
    """
    while True:
        job = inbox.successors.get()
        while not inbox.successors.empty():
            job = inbox.successors.get()
        with suppress(NanogsError, MemoryError, OSError, Cancelled):
            handler.sooner(job, WorkerChannel(line, inbox, job))


def _outcome(
    handler: "JobHandler", job: Job, channel: WorkerChannel
) -> tuple[str, dict[str, Any] | None]:
    """Do a job, and return how it ended and, unless it succeeded, the event that reports it."""
    try:
        channel.check()
        handler.do(job, channel)
    except Cancelled:
        return "cancelled", {"type": "cancelled"}
    except NanogsError as error:
        return "failed", {"type": "failed", "message": str(error)}
    except MemoryError:
        return "failed", {"type": "failed", "message": "Memory ran out; free some and try again."}
    except OSError as error:
        said = f"{error.filename or 'The scene'}: {error.strerror or error}."
        return "failed", {"type": "failed", "message": said}
    return "done", None


def _stop(number: int, _frame: FrameType | None) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    exit_when_allowed(partial(_end, 128 + number))


def _end(code: int) -> None:
    clean_all()
    os._exit(code)
