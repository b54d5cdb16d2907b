"""The pages that look at a studio: a line of events for each, and the models that these name."""

import asyncio
import json
import re
import time
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

from nanogs.errors import OptionError
from nanogs.formatting import plain

KEPT = {"filtered": 2, "draft": 4, "made": 4}  # models of a page, of each kind of event
MOST = 16  # pages
BEAT = 10.0  # seconds between signs of life
_MOST_EVENTS = 2000  # that wait for a page whose line is broken
_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")

Event = dict[str, Any]
Say = Callable[[str], Awaitable[None]]


@dataclass(slots=True, eq=False)
class Page:
    """One page of a browser.

    Attributes:
        events: Texts that wait to be sent.
        lines: Open lines; a second one takes the place of the first.
        models: By kind of event, the latest: ID and bytes.
        left: When the last line was closed, by `time.monotonic`; None while one is open.
    """

    events: deque[str] = field(default_factory=lambda: deque(maxlen=_MOST_EVENTS))
    news: asyncio.Event = field(default_factory=asyncio.Event)
    lines: int = 0
    models: dict[str, deque[tuple[str, bytes]]] = field(default_factory=dict)
    left: float | None = field(default_factory=time.monotonic)


class Pages:
    """All pages; events for all are kept for those that come later."""

    def __init__(self) -> None:
        self._pages: dict[str, Page] = {}
        self._shared: dict[str, bytes] = {}
        self.scene: Event | None = None
        self.last_left: float | None = None  # when a page was closed, by `time.monotonic`

    def get(self, name: object) -> Page:
        """The page of a name, which is new perhaps.

        Raises:
            OptionError: The name is none, or there are too many pages.
        """
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            raise OptionError("A page has a name of 1 to 64 letters, digits, - and _.")
        if name not in self._pages:
            self._forget()
            if len(self._pages) >= MOST:
                raise OptionError(f"{MOST} pages are open already; close one of them.")
            self._pages[name] = Page()
        return self._pages[name]

    def _forget(self) -> None:
        """Forget the page that was left first, where there is no room for another."""
        left = [(page.left, name) for name, page in self._pages.items() if page.left is not None]
        if left and len(self._pages) >= MOST:
            del self._pages[min(left)[1]]

    def deliver(self, name: str, event: Event, models: dict[str, bytes]) -> None:
        """Take an event for a page, or for all.

        Args:
            name: Of the page; empty for all.
            event: What has happened.
            models: Bytes of models that the event names, by ID.
        """
        if event["type"] == "scene":
            self.scene = event
        if not name:
            self._shared |= models
        elif name in self._pages:
            kept = self._pages[name].models.setdefault(
                event["type"], deque(maxlen=KEPT.get(event["type"], 1))
            )
            kept.extend(models.items())
        pages = [self._pages[name]] if name in self._pages else []
        text = _text(event)
        for page in pages if name else self._pages.values():
            page.events.append(text)
            page.news.set()

    def model(self, name: str) -> bytes | None:
        """The bytes of a model by its ID; None of one that is not kept."""
        if name in self._shared:
            return self._shared[name]
        kept = (each for page in self._pages.values() for each in page.models.values())
        return next((data for models in kept for each, data in models if each == name), None)

    async def stream(self, page: Page, say: Say) -> None:
        """Send a page its events, as server-sent ones, until it has another line or is cancelled.

        Args:
            page: The page.
            say: Sends a text.
        """
        page.lines += 1
        mine, page.left = page.lines, None
        page.news.set()  # so that an older line ends
        try:
            await say(": here\n\n" if self.scene is None else _text(self.scene))
            while page.lines == mine:
                page.news.clear()
                while page.events:
                    await say(page.events.popleft())
                try:
                    await asyncio.wait_for(page.news.wait(), BEAT)
                except TimeoutError:
                    await say(": here\n\n")
        finally:
            if page.lines == mine:
                page.left = self.last_left = time.monotonic()

    @property
    def watched(self) -> bool:
        """Whether any page is open."""
        return any(page.left is None for page in self._pages.values())

    def gone(self, seconds: float) -> list[str]:
        """Names of pages that were left longer ago than that."""
        now = time.monotonic()
        return [
            name
            for name, page in self._pages.items()
            if page.left is not None and now - page.left > seconds
        ]


def _text(event: Event) -> str:
    return f"data: {json.dumps(plain(event), allow_nan=False)}\n\n"
