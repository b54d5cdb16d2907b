"""Answers to requests of a page: effects of filters, a quick draft, and the measured result."""

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, replace
from threading import Lock
from typing import TYPE_CHECKING, Any, Protocol

from nanogs.pipeline.options.target import Goal
from nanogs.progress import Progress, Stage, Tracker
from nanogs.splats import Splats
from nanogs.studio.cache import FilteredScene, ModelKey, WorkerCache, grown_key, model_key
from nanogs.studio.choice import Choice, FilterChoice
from nanogs.studio.curve import Curve, Point
from nanogs.studio.showing import MOST_SHOWN, Shown, few, marked, show

if TYPE_CHECKING:
    from nanogs.pipeline.grown import Grown
    from nanogs.views.opening import Opening

Event = dict[str, Any]
SETTLED = 0.3  # seconds without a newer request after which a slider counts as released
UNSEEN = 2.0  # most seconds, beyond its pace, to wait for a page to draw before computing goes on
QUICK = 0.1  # seconds in which a page should be able to draw a draft
FEWEST_DRAFTED = 5_000  # splats of a draft at least, however slowly a page draws
TRIES = 3  # most results made for a PSNR or a size, each nearer to it
NEAR = 0.3  # dB by which a PSNR may exceed the goal; the command's search has the same tolerance
NEAR_SIZE = 0.03  # relative tolerance below a file size


class Channel(Protocol):
    """Interface by which a job sends events to its page and notices that it is cancelled."""

    @property
    def page(self) -> str:
        """Name of the page that the job is for."""

    @property
    def id(self) -> int:
        """ID of the job."""

    def __call__(self, event: Event, shown: Shown | None = None) -> None:
        """Send an event to the page of the job, with a model that it names."""

    def progress(self, kind: str) -> Progress:
        """Return a progress callback that sends the steps, and raises if the job is cancelled."""

    @property
    def pace(self) -> float | None:
        """Seconds that the page takes to draw one splat, if it has reported it."""

    def rest(self, model: str, least: float, most: float) -> None:
        """Wait `least` to `most` seconds for the page to draw a model; raise if cancelled."""

    def shielded(self, useful: Callable[[Choice], bool]) -> AbstractContextManager[None]:
        """Ignore a newer request in the context if `useful` says that the work serves it too."""


class RequestHandler:
    """Answers the requests of pages, for a scene that is open.

    A lock lets one thread use the forest at a time. While a result is measured, which needs no
    forest, another thread may make the draft of a newer request (`sooner`).
    """

    def __init__(self, cache: WorkerCache, start: "Opening") -> None:
        """Begin with nothing sent yet.

        Args:
            cache: The open scene.
            start: The first camera of the page.
        """
        self._cache, self._start = cache, start
        self._forest = Lock()
        self._drafted = (0, "")  # ID of the latest request with a draft, and of the draft's model
        self._shown: dict[str, ModelKey] = {}  # by page, the filtered scene sent last
        self._told: dict[str, Curve] = {}  # by page, the curve whose points were sent

    def ask(self, choice: Choice, channel: Channel) -> None:
        """Answer a request with events: `draft`, `made`, `point`, `measured`.

        If the filters have changed, `filtered` comes first.

        Raises:
            NanogsError: The request cannot be met.
        """
        with self._forest:
            self._ask(choice, channel)

    def _ask(self, choice: Choice, channel: Channel) -> None:
        begun = time.perf_counter()
        self._filter(choice, channel)
        grown = self._roughly(choice, channel)
        curve = self._curve(choice, grown, channel)
        count = curve.count_for(choice.goal)
        if self._drafted[0] != channel.id:
            self._draft(grown, curve, count, choice, channel)
        channel.rest(self._drafted[1], SETTLED, UNSEEN)
        grown = self._grow(choice, channel)
        tried: list[tuple[Event, Shown, Point]] = []
        while len(tried) < TRIES and (not tried or count != tried[-1][2].count):
            tried.append(self._made(grown, curve, count, choice, channel))
            point = tried[-1][2]
            curve.add(point)
            channel(_point(point, choice))
            if _near(choice.goal, point):
                break
            count = curve.count_for(choice.goal)
        event, shown, _ = min(tried, key=lambda made: _miss(choice.goal, made[2]))
        seconds = time.perf_counter() - begun
        channel({"type": "measured", "seconds": seconds} | event, replace(shown, models={}))

    def explore(self, choice: Choice, channel: Channel) -> None:
        """Measure plain cuts of several counts, for the plot; nothing if the forest is not held.

        Raises:
            NanogsError: They cannot be measured.
        """
        with self._forest:
            if not self._cache.is_grown(choice):
                return
            grown = self._cache.fully(choice, channel.progress("curve"))
            curve = self._cache.curve(choice, grown)
            while (count := curve.missing()) is not None:
                draft, on_step = grown.draft(count), channel.progress("curve")
                with self._lent():
                    measured = grown.measure(draft, format=choice.format, progress=on_step)
                curve.add(Point(count, measured.bytes, measured.judged.psnr, coarse=True))
                channel(_point(curve.points[count, True], choice))

    def preview(self, choice: Choice, channel: Channel) -> None:
        """Show which splats the filters of a choice would remove, without removing them.

        Raises:
            NanogsError: No splat would be left.
        """
        with self._forest:
            self._begin_filters(channel)
            whole = self._cache.whole(choice.render_mode)
            found = self._cache.previewed(choice)
            shown = show(marked(whole, found.stays), self._start, len(whole))
            channel(_filtered(found, preview=True), shown)

    def sooner(self, choice: Choice, channel: Channel) -> None:
        """Make the draft of a waiting request early, if the forest of its model is in memory.

        Nothing is done if the request has begun meanwhile and made its draft itself.

        Raises:
            NanogsError: The draft cannot be made.
        """
        with self._forest:
            grown = self._cache.here(choice)
            if grown is not None and self._drafted[0] != channel.id:
                curve = self._cache.curve(choice, grown)
                self._draft(grown, curve, curve.count_for(choice.goal), choice, channel)

    @contextmanager
    def _lent(self) -> Iterator[None]:
        """Release the lock of the forest in the context."""
        self._forest.release()
        try:
            yield
        finally:
            self._forest.acquire()

    @staticmethod
    def _begin_filters(channel: Channel) -> None:
        Tracker(channel.progress("filters"), [Stage("sift", 1.0)]).begin("sift")

    def _filter(self, choice: Choice, channel: Channel) -> None:
        """Filter the scene, and send the filtered one if the page shows another as its scene."""
        key, opened = model_key(choice), (self._cache.settings.render_mode, FilterChoice())
        if self._shown.get(channel.page, opened) == key:
            return
        self._begin_filters(channel)
        found = self._cache.sifted(choice)
        count = len(found.splats)
        channel(_filtered(found, preview=False), show(few(found.splats), self._start, count))
        self._shown[channel.page] = key

    def _roughly(self, choice: Choice, channel: Channel) -> "Grown":
        with channel.shielded(lambda newer: model_key(newer) == model_key(choice)):
            return self._cache.roughly(choice, channel.progress("draft"))

    def _grow(self, choice: Choice, channel: Channel) -> "Grown":
        with channel.shielded(lambda newer: grown_key(newer) == grown_key(choice)):
            return self._cache.fully(choice, channel.progress("draft"))

    def _curve(self, choice: Choice, grown: "Grown", channel: Channel) -> Curve:
        """Return the curve of a choice; all its points are sent if the page had another curve."""
        curve = self._cache.curve(choice, grown)
        if self._told.get(channel.page) is not curve:
            for point in curve.points.values():
                channel(_point(point, choice))
            self._told[channel.page] = curve  # not before: a cancelled request stops in between
        return curve

    def _draft(
        self, grown: "Grown", curve: Curve, count: int, choice: Choice, channel: Channel
    ) -> None:
        most = min(MOST_SHOWN, _drawn_at_once(channel.pace))
        splats = grown.draft(min(count, most) if count <= grown.available else count)
        if choice.sh_degree is not None:
            splats = splats.with_sh_degree(choice.sh_degree)
        shown = show(few(splats), self._start, max(count, len(splats)))
        channel(_estimated("draft", grown, curve, max(count, len(splats))), shown)
        self._drafted = channel.id, shown.entry["id"]

    def _made(
        self, grown: "Grown", curve: Curve, count: int, choice: Choice, channel: Channel
    ) -> tuple[Event, Shown, Point]:
        """Make a full result, show it, then measure it.

        Returns:
            The event with its figures, the model that is shown, and the point on the curve.
        """
        on_step = channel.progress("draft")
        splats, report = grown.simplify(count, format=choice.format, progress=on_step)
        shown = show(self._drawable(grown, splats), self._start, len(splats))
        channel(_estimated("made", grown, curve, len(splats)), shown)
        on_step = channel.progress("measure")
        with self._lent():
            # Wait first: the browser may be drawing on the same processors that measure.
            channel.rest(shown.entry["id"], 0.0, UNSEEN + len(splats) * (channel.pace or 0.0))
            measured = grown.measure(splats, format=choice.format, progress=on_step)
        judged = measured.judged
        event = {
            "splats": len(splats), "bytes": measured.bytes, "psnr": judged.psnr,
            "ssim": judged.ssim, "stop": str(report.stop), "notes": list(report.notes),
            "available": grown.available, "fewest": grown.fewest,
        }  # fmt: skip
        point = Point(len(splats), measured.bytes, judged.psnr, coarse=False)
        return event, shown, point

    @staticmethod
    def _drawable(grown: "Grown", splats: Splats) -> Splats:
        return splats if len(splats) <= MOST_SHOWN else grown.draft(MOST_SHOWN)


def _drawn_at_once(pace: float | None) -> int:
    """Return the number of splats that a page draws in `QUICK` seconds, by its pace if known."""
    return MOST_SHOWN if pace is None else max(FEWEST_DRAFTED, int(QUICK / pace))


def _estimated(kind: str, grown: "Grown", curve: Curve, count: int) -> Event:
    """Make the event for a model that is not measured, with estimates from the curve."""
    return {
        "type": kind, "splats": count, "bytes": curve.bytes_of(count),
        "psnr": curve.psnr_of(count), "about": True, "available": grown.available,
        "fewest": grown.fewest,
    }  # fmt: skip


def _filtered(found: FilteredScene, *, preview: bool) -> Event:
    took = [asdict(report) for report in found.reports]
    left = int(found.stays.sum())
    return {"type": "filtered", "took": took, "left": left, "preview": preview}


def _near(goal: Goal, point: Point) -> bool:
    """Return whether a result meets the goal within the tolerance."""
    if goal.psnr is not None:
        return 0 <= point.psnr - goal.psnr <= NEAR
    if goal.size is not None:
        return (1 - NEAR_SIZE) * goal.size <= point.bytes <= goal.size
    return True


def _miss(goal: Goal, point: Point) -> tuple[bool, float]:
    """Return a sort key for the distance from the goal: results that meet it sort first."""
    if goal.psnr is not None:
        return point.psnr < goal.psnr, abs(point.psnr - goal.psnr)
    if goal.size is not None:
        return point.bytes > goal.size, abs(point.bytes - goal.size)
    return False, 0.0


def _point(point: Point, choice: Choice) -> Event:
    return {
        "type": "point", "splats": point.count, "bytes": point.bytes, "psnr": point.psnr,
        "kind": "coarse" if point.coarse else "measured", "format": choice.format,
    }  # fmt: skip
