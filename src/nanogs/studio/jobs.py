"""The queue of requests: one runs at a time, a newer one replaces an older, pages take turns."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import count
from typing import Any, Literal

Kind = Literal["open", "ask", "filter", "save", "curve"]
_numbers = count(1)


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """A job for the worker.

    Attributes:
        kind: What is to be done: "open" reads the scene, "ask" makes and measures a result,
            "filter" shows which splats filters remove, "save" writes a file, "curve" measures while
            there are no requests.
        page: Name of the page that asked; empty for none.
        number: The page's own number of its request, or None.
        work: The request: a `Choice` or a `SaveRequest`.
        id: Unique number of the job, ascending.
    """

    kind: Kind
    page: str = ""
    number: int | None = None
    work: Any = None
    id: int = field(default_factory=lambda: next(_numbers))


@dataclass(slots=True)
class Queue:
    """The waiting jobs, and the one that is running.

    Attributes:
        running: The running job, or None.
        dropped: Whether the running job has been cancelled or replaced.
    """

    running: Job | None = None
    dropped: bool = False
    _waiting: list[Job] = field(default_factory=list)
    _turns: list[str] = field(default_factory=list)  # pages, the most recently served one last

    def put(self, job: Job) -> list[Job]:
        """Add a job and remove those that it replaces.

        A job replaces the waiting job of the same page and kind, and also the running one unless
        that is a save. Jobs of the kind "curve" are replaced by every job.

        Returns:
            The replaced jobs: those that were waiting, and the running one if it is replaced.
        """
        replaced = [each for each in self._waiting if _replaces(job, each)]
        self._waiting = [each for each in self._waiting if each not in replaced] + [job]
        now = self.running
        given_up = now is not None and now.kind != "save" and _replaces(job, now)
        if now is not None and given_up and not self.dropped:
            self.dropped = True
            replaced.append(now)
        return replaced

    def cancel(self, page: str, kinds: tuple[Kind, ...] = ("ask", "filter", "save")) -> list[Job]:
        """Drop the jobs of a page and return them, including the running one."""
        gone = [each for each in self._waiting if each.page == page and each.kind in kinds]
        self._waiting = [each for each in self._waiting if each not in gone]
        now = self.running
        if now is not None and now.page == page and now.kind in kinds and not self.dropped:
            self.dropped = True
            gone.append(now)
        return gone

    def next(self) -> Job | None:
        """Start the next job and return it, if there is one and none is running.

        The least recently served page is next, with its oldest request; "open" precedes all others.
        """
        if self.running is not None or not self._waiting:
            return None
        job = min(self._waiting, key=self._since)
        self._waiting.remove(job)
        self._turns = [*(page for page in self._turns if page != job.page), job.page]
        self.running, self.dropped = job, False
        return job

    def done(self) -> None:
        """Mark the running job as ended."""
        self.running, self.dropped = None, False

    def __iter__(self) -> Iterator[Job]:
        """Iterate over the running job, unless it was dropped, and the waiting ones."""
        if self.running is not None and not self.dropped:
            yield self.running
        yield from self._waiting

    @property
    def idle(self) -> bool:
        """Whether no job is running or waiting."""
        return self.running is None and not self._waiting

    def _since(self, job: Job) -> tuple[int, int, int]:
        turn = self._turns.index(job.page) if job.page in self._turns else -1
        return job.kind != "open", turn, job.id


def _replaces(new: Job, old: Job) -> bool:
    return old.kind == "curve" or (new.kind, new.page) == (old.kind, old.page)
