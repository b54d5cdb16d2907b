"""Which request is next: one at a time, the newest of a kind, and pages in turn."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import count
from typing import Any, Literal

Kind = Literal["open", "ask", "filter", "save", "curve"]
_numbers = count(1)


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """Work for the worker.

    Attributes:
        kind: What is to be done: "open" reads the scene, "filter" shows what filters take, "curve"
            measures while nobody asks.
        page: Whose it is; empty for nobody's.
        number: The page's own number of its request, or None.
        work: What is asked: a `Choice` or an `Order`.
        id: Different for each.
    """

    kind: Kind
    page: str = ""
    number: int | None = None
    work: Any = None
    id: int = field(default_factory=lambda: next(_numbers))


@dataclass(slots=True)
class Queue:
    """Requests that wait, and the one that is being answered.

    Attributes:
        running: The job at hand, or None.
        dropped: Whether nobody waits for the running one any more.
    """

    running: Job | None = None
    dropped: bool = False
    _waiting: list[Job] = field(default_factory=list)
    _turns: list[str] = field(default_factory=list)  # pages, the one that was last served last

    def put(self, job: Job) -> list[Job]:
        """Add a request; what it replaces leaves the queue.

        A newer one of a page and kind takes the place of the one that waits and, but for saves, of
        a running one. What was measured while nobody asked gives way to everything.

        Returns:
            The jobs that nobody waits for any more: those that leave, and the running one if it is
            among them.
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
        """Drop all that a page waits for; the jobs, the running one among them."""
        gone = [each for each in self._waiting if each.page == page and each.kind in kinds]
        self._waiting = [each for each in self._waiting if each not in gone]
        now = self.running
        if now is not None and now.page == page and now.kind in kinds and not self.dropped:
            self.dropped = True
            gone.append(now)
        return gone

    def next(self) -> Job | None:
        """Begin with the next job, if there is one and none is running.

        Of several pages the one comes next that has not been served for the longest time, and of
        its requests the oldest.
        """
        if self.running is not None or not self._waiting:
            return None
        job = min(self._waiting, key=self._since)
        self._waiting.remove(job)
        self._turns = [*(page for page in self._turns if page != job.page), job.page]
        self.running, self.dropped = job, False
        return job

    def done(self) -> None:
        """The running job has ended."""
        self.running, self.dropped = None, False

    def __iter__(self) -> Iterator[Job]:
        """All jobs that somebody waits for."""
        if self.running is not None and not self.dropped:
            yield self.running
        yield from self._waiting

    @property
    def idle(self) -> bool:
        """Whether there is nothing to do."""
        return self.running is None and not self._waiting

    def _since(self, job: Job) -> tuple[int, int, int]:
        turn = self._turns.index(job.page) if job.page in self._turns else -1
        return job.kind != "open", turn, job.id


def _replaces(new: Job, old: Job) -> bool:
    return old.kind == "curve" or (new.kind, new.page) == (old.kind, old.page)
