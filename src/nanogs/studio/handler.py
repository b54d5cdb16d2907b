"""Dispatch of each kind of job in the worker."""

from nanogs.ahead import prepare_kernels
from nanogs.pipeline.options.presets import DEFAULT_PRESET
from nanogs.progress import Stage, Tracker
from nanogs.studio import opening, saving
from nanogs.studio.asking import Channel, RequestHandler
from nanogs.studio.cache import WorkerCache
from nanogs.studio.jobs import Job
from nanogs.studio.scene import Scene, StudioSettings


class JobHandler:
    """Handles the jobs of a scene, which the first job opens."""

    def __init__(self, scene: Scene, settings: StudioSettings) -> None:
        """Prepare; the scene is not opened yet.

        Args:
            scene: The scene to open.
            settings: Settings of the studio.
        """
        self._cache = WorkerCache(scene, settings)
        self._answers: RequestHandler | None = None

    def do(self, job: Job, channel: Channel) -> None:
        """Do a job, and send its events.

        Raises:
            NanogsError: It cannot be done.
        """
        if job.kind == "open":
            self._open(channel)
        elif job.kind == "save":
            channel(saving.save(job.work, self._cache, channel.progress("save")))
        elif self._answers is not None and job.kind == "ask":
            self._answers.ask(job.work, channel)
        elif self._answers is not None and job.kind == "filter":
            self._answers.preview(job.work, channel)
        elif self._answers is not None:
            self._answers.explore(job.work, channel)

    def sooner(self, job: Job, channel: Channel) -> None:
        """Make the draft of a waiting request early; called in another thread than `do`.

        Raises:
            NanogsError: The draft cannot be made.
        """
        if self._answers is not None:
            self._answers.sooner(job.work, channel)

    def _open(self, channel: Channel) -> None:
        """Read the scene and send it to all pages."""
        prepare_kernels(DEFAULT_PRESET)
        cache = self._cache
        tracker = Tracker(channel.progress("open"), [Stage("read", 2.0), Stage("show", 1.0)])
        tracker.begin("read")
        whole = cache.whole(cache.settings.render_mode)
        tracker.begin("show")
        event, start, shown = opening.opened(cache.scene, cache.settings, whole)
        self._answers = RequestHandler(cache, start)
        channel(event, shown)
