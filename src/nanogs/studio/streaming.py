"""A response that goes on until the page is closed, which it notices at once."""

import asyncio
from collections.abc import Awaitable, Callable

from starlette.responses import Response
from starlette.types import Receive, Scope, Send


class EventStream(Response):
    """Server-sent events, as long as something says them and somebody listens."""

    media_type = "text/event-stream"

    def __init__(self, talk: Callable[[Callable[[str], Awaitable[None]]], Awaitable[None]]) -> None:
        """Prepare to send.

        Args:
            talk: Is given what sends a text, and is cancelled when the page is closed.
        """
        super().__init__()
        self._talk = talk

    async def __call__(self, _scope: Scope, receive: Receive, send: Send) -> None:
        """Send the head, and what is said."""
        head = [(b"content-type", b"text/event-stream; charset=utf-8")]
        await send({"type": "http.response.start", "status": 200, "headers": head})

        async def say(text: str) -> None:
            await send({"type": "http.response.body", "body": text.encode(), "more_body": True})

        async def talk() -> None:
            await self._talk(say)

        talking = asyncio.create_task(talk())
        closed = asyncio.create_task(_closed(receive))
        try:
            await asyncio.wait({talking, closed}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in (talking, closed):
                task.cancel()
            await asyncio.gather(talking, closed, return_exceptions=True)
        await send({"type": "http.response.body", "body": b""})


async def _closed(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass
