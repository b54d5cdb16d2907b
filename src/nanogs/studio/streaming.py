"""A streaming response for server-sent events that ends at once when the page is closed."""

import asyncio
from collections.abc import Awaitable, Callable

from starlette.responses import Response
from starlette.types import Receive, Scope, Send


class EventStream(Response):
    """A response of server-sent events, until their source ends or the client disconnects."""

    media_type = "text/event-stream"

    def __init__(self, talk: Callable[[Callable[[str], Awaitable[None]]], Awaitable[None]]) -> None:
        """Prepare the response.

        Args:
            talk: Coroutine function that gets a function to send texts; it is cancelled when the
                page is closed. If that happens while a text is sent, sending raises an `OSError`.
        """
        super().__init__()
        self._talk = talk

    async def __call__(self, _scope: Scope, receive: Receive, send: Send) -> None:
        """Send the headers, then the events."""
        head = [(b"content-type", b"text/event-stream; charset=utf-8")]
        await send({"type": "http.response.start", "status": 200, "headers": head})

        async def say(text: str) -> None:
            await send({"type": "http.response.body", "body": text.encode(), "more_body": True})
            await asyncio.sleep(0)  # lets `_closed` notice that the client has disconnected
            if closed.done():  # the server would drop all further texts without an error
                raise ConnectionResetError("The page was closed.")

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
