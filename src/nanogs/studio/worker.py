"""The process that holds the scene and calls the library, one job after the other."""

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
from nanogs.cleanup import clean_all, when_undisturbed
from nanogs.errors import NanogsError
from nanogs.progress import Progress, Step
from nanogs.studio.choice import Choice
from nanogs.studio.jobs import Job
from nanogs.studio.scene import Manner, Scene
from nanogs.studio.showing import Shown

if TYPE_CHECKING:
    from nanogs.studio.desk import Desk

EVERY = 0.1  # seconds between two events about the same stage


class Cancelled(BaseException):
    """Nobody waits for this job any more; no error, so that nothing takes it for one."""


class Line:
    """To and from the server, for any thread."""

    def __init__(self, line: Connection) -> None:
        """Take over a connection."""
        self._line, self._lock = line, threading.Lock()
        self.recv = line.recv

    def send(self, message: tuple[Any, ...]) -> None:
        """Send a message."""
        with self._lock:
            self._line.send(message)


class Inbox:
    """Messages of the server, read by a thread of its own."""

    def __init__(self, line: Line) -> None:
        """Begin to read.

        Args:
            line: From the server; where it ends, so does this process.
        """
        self.jobs: queue.Queue[Job] = queue.Queue()
        self.successors: queue.Queue[Job] = queue.Queue()  # which wait for a job to stop
        self._line = line
        self._dropped: dict[int, Job | None] = {}
        self._seen: dict[str, str] = {}  # by page, the model that it has drawn last
        self._paces: dict[str, float] = {}
        self._news = threading.Condition()  # of what was dropped or seen
        threading.Thread(target=self._read, daemon=True).start()

    def dropped(self, job: Job) -> bool:
        """Whether nobody waits for a job any more."""
        return job.id in self._dropped

    def successor(self, job: Job) -> Job | None:
        """The newer request because of which a job was dropped."""
        return self._dropped.get(job.id)

    def pace(self, page: str) -> float | None:
        """Seconds that a splat takes a page to draw, if it has said so."""
        return self._paces.get(page)

    def begin(self, job: Job) -> None:
        """Forget the jobs before this one."""
        for each in [each for each in self._dropped if each < job.id]:
            del self._dropped[each]

    def rest(self, job: Job, model: str, least: float, most: float) -> None:
        """Wait until a job's model was seen, `least` to `most` seconds, or until it is dropped."""
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


class Teller:
    """How a job speaks to the server."""

    def __init__(self, line: Line, inbox: Inbox, job: Job) -> None:
        """Speak for a job.

        Args:
            line: To the server.
            inbox: Which says whether it is still wanted.
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
        """Stop here if nobody waits any more.

        Raises:
            Cancelled: So it is.
        """
        if not self._inbox.dropped(self._job):
            return
        newer = self._inbox.successor(self._job)
        if self._useful and newer and isinstance(newer.work, Choice) and self._useful(newer.work):
            return
        raise Cancelled

    def progress(self, kind: str) -> Progress:
        """A function that takes steps and tells them; it raises `Cancelled`."""
        stage, since, number = "", 0.0, self._job.number

        def told(step: Step) -> None:
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

        return told

    @property
    def pace(self) -> float | None:
        """Seconds that a splat takes the page to draw, if it has said so."""
        return self._inbox.pace(self.page)

    def rest(self, model: str, least: float, most: float) -> None:
        """Wait until the page has drawn a model; a newer request ends the job."""
        self._inbox.rest(self._job, model, least, most)
        self.check()

    @contextmanager
    def shielded(self, useful: Callable[[Choice], bool]) -> Iterator[None]:
        """Go on in the block although a newer request came, if it is useful to that too."""
        self._useful = useful
        try:
            yield
        finally:
            self._useful = None
        self.check()


def work(connection: Connection, scene: Scene, manner: Manner) -> None:
    """Do jobs until the server ends; the first opens the scene.

    Args:
        connection: To and from the server.
        scene: The file.
        manner: How work is done.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _stop)
    line = Line(connection)
    inbox = Inbox(line)
    from nanogs.studio.desk import Desk  # which brings Numba

    keep_freed_memory()
    desk = Desk(scene, manner)
    threading.Thread(target=_draft_sooner, args=(desk, line, inbox), daemon=True).start()
    while True:
        job = inbox.jobs.get()
        inbox.begin(job)
        line.send(("done", *_outcome(desk, job, Teller(line, inbox, job))))


def _draft_sooner(desk: "Desk", line: Line, inbox: Inbox) -> None:
    """Make drafts of newer requests while the job that they replace is still about to stop.

    Of several, only the latest. What cannot be had is said when its turn comes.
    """
    while True:
        job = inbox.successors.get()
        while not inbox.successors.empty():
            job = inbox.successors.get()
        with suppress(NanogsError, MemoryError, OSError, Cancelled):
            desk.sooner(job, Teller(line, inbox, job))


def _outcome(desk: "Desk", job: Job, tell: Teller) -> tuple[str, dict[str, Any] | None]:
    """Do a job; how it ended, and the event that says so if another one does not."""
    try:
        tell.check()
        desk.do(job, tell)
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
    when_undisturbed(partial(_end, 128 + number))


def _end(code: int) -> None:
    clean_all()
    os._exit(code)
