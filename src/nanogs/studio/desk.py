"""Dispatch of each kind of job in the worker."""

from typing import Any

from nanogs.ahead import compile_ahead, nothing_compiled
from nanogs.kernels.compiling import when_compiling
from nanogs.pipeline.options.presets import DEFAULT_PRESET
from nanogs.progress import Stage, Tracker
from nanogs.studio import opening, saving
from nanogs.studio.asking import RequestHandler, Telling
from nanogs.studio.held import WorkerCache
from nanogs.studio.jobs import Job
from nanogs.studio.scene import Scene, StudioSettings


class JobHandler:
    """Handles the jobs of a scene, which the first job opens."""

    def __init__(self, scene: Scene, manner: StudioSettings) -> None:
        """Prepare; the scene is not opened yet.

        Args:
            scene: The scene to open.
            manner: Settings of the studio.
        """
        self._held = WorkerCache(scene, manner)
        self._answers: RequestHandler | None = None

    def do(self, job: Job, tell: Telling) -> None:
        """Do a job, and send its events.

        Raises:
            NanogsError: It cannot be done.
        """
        if job.kind == "open":
            self._open(tell)
        elif job.kind == "save":
            tell(self._saved(job.work, tell))
        elif self._answers is not None and job.kind == "ask":
            self._answers.ask(job.work, tell)
        elif self._answers is not None and job.kind == "filter":
            self._answers.preview(job.work, tell)
        elif self._answers is not None:
            self._answers.explore(job.work, tell)

    def sooner(self, job: Job, tell: Telling) -> None:
        """Make the draft of a waiting request early; called in another thread than `do`.

        Raises:
            NanogsError: The draft cannot be made.
        """
        if self._answers is not None:
            self._answers.sooner(job.work, tell)

    def _open(self, tell: Telling) -> None:
        """Read the scene and send it to all pages."""
        if nothing_compiled():
            compile_ahead(DEFAULT_PRESET)
        else:
            when_compiling(lambda: compile_ahead(DEFAULT_PRESET))
        held = self._held
        tracker = Tracker(tell.progress("open"), [Stage("read", 2.0), Stage("show", 1.0)])
        tracker.begin("read")
        whole = held.whole(held.manner.render_mode)
        tracker.begin("show")
        event, start, shown = opening.opened(held.scene, held.manner, whole)
        self._answers = RequestHandler(held, start)
        tell(event, shown)

    def _saved(self, order: Any, tell: Telling) -> dict[str, Any]:  # noqa: ANN401 - an `Order`
        return saving.save(order, self._held, tell.progress("save"))
