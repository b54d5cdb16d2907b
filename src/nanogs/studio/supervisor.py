"""Passing requests of pages to the worker process and events back, and restarting the worker."""

import asyncio
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from nanogs.errors import OutputError
from nanogs.io.temporary import sweep
from nanogs.pipeline.job.folder import job_folder
from nanogs.studio.jobs import Job, Kind, Queue
from nanogs.studio.orders import SaveRequest
from nanogs.studio.process import Process
from nanogs.studio.scene import Scene, StudioSettings

Event = dict[str, Any]
Deliver = Callable[[str, Event, dict[str, bytes]], None]
"""Sends an event to the page with this name, or to all pages if the name is empty, together with
the models that the event names."""

PATIENCE = 5.0  # seconds that a cancelled job has to stop, before the worker is killed
PATIENCE_REPLACED = 30.0  # the same for a job replaced by a newer one, counted from its last event


class WorkerSupervisor:
    """The worker and its job queue; all methods are called in the thread of the event loop."""

    def __init__(self, scene: Scene, settings: StudioSettings, deliver: Deliver) -> None:
        """Prepare; `open` starts the worker.

        Args:
            scene: The scene that the worker opens.
            settings: Settings of the studio.
            deliver: Called with each event for a page.
        """
        self._scene, self._settings, self._deliver = scene, settings, deliver
        self.queue = Queue()
        self._process: Process | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._task: asyncio.Task[None] | None = None  # the task that ends a worker
        self._ending: Process | None = None  # the worker that it ends
        self._replaced = False  # whether the running job is replaced by a newer one
        self._job_folder: Path | None = None  # which the running save makes if it is in blocks
        self._curve: Job | None = None  # the request whose curve is measured while there are none

    def open(self) -> None:
        """Queue the job that reads the scene."""
        self.put(Job("open"))

    def put(self, job: Job) -> None:
        """Queue a job, and cancel those that it replaces."""
        if self._process is None and job.kind != "open":
            self.queue.put(Job("open"))
        replaced = self.queue.put(job)
        now = self.queue.running
        alike = now is not None and (now.kind, now.page) == (job.kind, job.page)
        if now is not None and self.queue.dropped and alike and now not in replaced:
            # It was given up earlier: the successor that it may serve is now this job.
            self._send(("cancel", (now.id, job)))
        self._give_up(replaced, PATIENCE_REPLACED, successor=job)
        self._go_on()

    def cancel(self, page: str, *kinds: Kind) -> None:
        """Cancel the jobs of a page, of some kinds or all."""
        if self._curve is not None and self._curve.page == page:
            self._curve = None
        kinds = kinds or ("ask", "filter", "save", "curve")
        self._give_up(self.queue.cancel(page, kinds), PATIENCE)
        now = self.queue.running
        if now is not None and self.queue.dropped and now.page == page and self._replaced:
            self._send(("cancel", (now.id, None)))  # there is no successor that it may serve
            self._await(PATIENCE)

    def seen(self, page: str, model: str, pace: float | None) -> None:
        """Tell the worker that a page has drawn a model, and the seconds that a splat takes."""
        self._send(("seen", (page, model, pace)))

    def end(self) -> None:
        """End the worker."""
        self._stop_timer()
        if self._process is not None:
            process, self._process = self._process, None
            process.end()
            self._sweep()

    def _give_up(self, jobs: list[Job], patience: float, successor: Job | None = None) -> None:
        """Tell pages that jobs are cancelled, and ask the worker to stop the running one."""
        for job in jobs:
            if job is self.queue.running:
                self._send(("cancel", (job.id, successor)))
                self._await(patience)
            else:
                self._tell(job, {"type": "cancelled"})

    def _tell(self, job: Job, event: Event) -> None:
        """Send an event about a job to its page."""
        if job.kind != "curve":
            self._deliver(job.page, event | {"number": job.number, "kind": job.kind}, {})

    def _go_on(self) -> None:
        """Start the next job if none is running, and the worker if there is none."""
        job = self.queue.next()
        if job is None and self.queue.idle and self._curve is not None:
            self.queue.put(Job("curve", self._curve.page, None, self._curve.work))
            job = self.queue.next()
        if job is None:
            return
        if self._process is None:
            loop = asyncio.get_running_loop()

            def on_message(message: Any) -> None:  # noqa: ANN401 - a message, or None
                with suppress(RuntimeError):  # the loop has ended
                    loop.call_soon_threadsafe(self._hear, process, message)

            self._process = process = Process(self._scene, self._settings, on_message)
        self._job_folder = _new_job_folder(job)
        self._send(("job", job))

    def _send(self, message: tuple[str, Any]) -> None:
        if self._process is not None:
            self._process.send(message)

    def _hear(self, process: Process, message: Any) -> None:  # noqa: ANN401 - a message, or None
        """Handle a message of a worker; None means that it has ended."""
        if process is not self._process or process is self._ending:
            return  # it was ended before, or is being ended and can take no other job
        if message is None:
            self._lost(process)
        elif message[0] == "event":
            _, page, event, models = message
            self._deliver(page, event, models)
            if self._timer is not None and self.queue.running and self._replaced:
                self._await(PATIENCE_REPLACED)
        else:
            self._ended(*message[1:])

    def _ended(self, outcome: str, event: Event | None) -> None:
        """Handle the end of a job, which was done or cancelled or has failed."""
        self._stop_timer()
        job = self.queue.running
        self.queue.done()
        if job is None:
            return
        if event is not None:
            self._tell(job, event)
        if job.kind == "ask" and outcome == "done":
            self._curve = job
        elif job.kind == "curve" and outcome != "cancelled":
            self._end_curve(job)
        elif job.kind == "open" and outcome == "failed":
            self._end_unopened()
        self._go_on()

    def _end_curve(self, job: Job) -> None:
        """Leave the curve as it is, and tell its page that nothing is done any more."""
        self._curve = None
        self._deliver(job.page, {"type": "explored"}, {})

    def _end_unopened(self) -> None:
        """Cancel all jobs and end the worker after opening has failed; the next request retries."""
        waiting = []
        while (job := self.queue.next()) is not None:
            waiting.append(job)
            self.queue.done()
        self.end()
        for job in waiting:
            self._tell(job, {"type": "cancelled"})

    def _await(self, seconds: float) -> None:
        """Start the timer that ends the worker if its job has not stopped after some seconds."""
        self._stop_timer()
        self._replaced = seconds == PATIENCE_REPLACED
        self._timer = asyncio.get_running_loop().call_later(seconds, self._replace)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _replace(self) -> None:
        """End a worker whose job does not stop; the next request starts another."""
        self._timer = None
        if self._process is not None:
            self._ending = self._process
            self._task = asyncio.create_task(self._lose(self._process))

    def _lost(self, process: Process) -> None:
        """Handle a worker that has ended by itself."""
        self._stop_timer()
        self._task = asyncio.create_task(self._lose(process))

    async def _lose(self, process: Process) -> None:
        """End a worker, report the end of its job, and start another if jobs are waiting."""
        await asyncio.to_thread(process.end)
        if process is not self._process:
            return  # another call has handled it already
        self._process = None
        self._stop_timer()  # of a cancellation meanwhile; it would end the next worker
        self._sweep()
        job, dropped = self.queue.running, self.queue.dropped
        self.queue.done()
        if job is not None and dropped:
            self._tell(job, {"type": "cancelled"})
        elif job is not None:
            message = (
                f"The process that did the work has ended ({process.ended_by}); the next request"
                " starts a new one."
            )
            self._tell(job, {"type": "failed", "message": message})
        if job is not None and job.kind == "curve":
            self._end_curve(job)  # trying it again would end the same way
        elif job is not None and job.kind == "open":
            self._end_unopened()  # so would this, for as long as a job is waiting
        if not self.queue.idle:
            self.open()

    def _sweep(self) -> None:
        """Remove the files of a save that was interrupted: nothing resumes it."""
        job = self.queue.running
        if job is not None and isinstance(job.work, SaveRequest):
            sweep(job.work.target)
            if self._job_folder is not None:
                shutil.rmtree(self._job_folder, ignore_errors=True)


def _new_job_folder(job: Job) -> Path | None:
    """Return the job folder of a save; None if it exists, as of a command that was interrupted."""
    if not isinstance(job.work, SaveRequest):
        return None
    with suppress(OutputError):  # which the worker reports
        folder = job_folder(job.work.target, None)
        return None if os.path.lexists(folder) else folder
    return None
