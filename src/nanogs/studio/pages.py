"""The open pages of a studio: an event stream for each, and the models that the events name."""

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

KEPT = {"filtered": 2, "draft": 4, "made": 4}  # models kept for a page, by kind of event
MOST = 16  # most pages at a time
BEAT = 10.0  # seconds between heartbeats on an idle stream
LEFT = 10.0  # seconds after which the requests of a closed page are dropped
_MOST_EVENTS = 2000  # most events queued for a page whose stream is interrupted
_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")

Event = dict[str, Any]
Say = Callable[[str], Awaitable[None]]


@dataclass(slots=True, eq=False)
class Page:
    """One page in a browser.

    Attributes:
        events: Events queued to be sent, as text.
        news: Set when there is something to send, or when a newer stream replaces this one.
        lines: Number of streams opened so far; each one replaces the one before.
        models: The latest models by kind of event: ID and bytes.
        left: Time when the last stream was closed, by `time.monotonic`; None while one is open.
    """

    events: deque[str] = field(default_factory=lambda: deque(maxlen=_MOST_EVENTS))
    news: asyncio.Event = field(default_factory=asyncio.Event)
    lines: int = 0
    models: dict[str, deque[tuple[str, bytes]]] = field(default_factory=dict)
    left: float | None = field(default_factory=time.monotonic)


class Pages:
    """All pages of a studio; the scene is kept for pages that are opened later."""

    def __init__(self) -> None:
        self._pages: dict[str, Page] = {}
        self._shared: dict[str, bytes] = {}  # the latest models for all pages, by ID
        self.scene: Event | None = None
        self.last_left: float | None = None  # time when a page was last closed, `time.monotonic`

    def get(self, name: object) -> Page:
        """Return the page of a name, which is made if it is new.

        Raises:
            OptionError: The name is invalid, or there are too many pages.
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
        """If there is no room for another page, remove the one that was closed the longest ago."""
        left = [(page.left, name) for name, page in self._pages.items() if page.left is not None]
        if left and len(self._pages) >= MOST:
            del self._pages[min(left)[1]]

    def deliver(self, name: str, event: Event, models: dict[str, bytes]) -> None:
        """Queue an event for a page, or for all pages.

        Args:
            name: Name of the page; empty for all.
            event: The event.
            models: Bytes of the models that the event names, by ID.
        """
        if event["type"] == "scene":
            self.scene = event
        if not name and models:
            self._shared = models
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
        """Return the bytes of a model by its ID; None if it is not kept any more."""
        if name in self._shared:
            return self._shared[name]
        kept = (each for page in self._pages.values() for each in page.models.values())
        return next((data for models in kept for each, data in models if each == name), None)

    async def stream(self, page: Page, say: Say) -> None:
        """Send a page its server-sent events, until a newer stream is opened or it is cancelled.

        Args:
            page: The page.
            say: Sends a text to the page.
        """
        page.lines += 1
        mine, page.left = page.lines, None
        page.news.set()  # wakes an older stream, which then ends
        try:
            await say(": here\n\n" if self.scene is None else _text(self.scene))
            while page.lines == mine:
                page.news.clear()
                while page.events and page.lines == mine:  # the rest is for the newer stream
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

    def gone(self) -> list[str]:
        """Return the names of pages that were closed more than `LEFT` seconds ago."""
        now = time.monotonic()
        return [
            name
            for name, page in self._pages.items()
            if page.left is not None and now - page.left > LEFT
        ]


def _text(event: Event) -> str:
    return f"data: {json.dumps(plain(event), allow_nan=False)}\n\n"
