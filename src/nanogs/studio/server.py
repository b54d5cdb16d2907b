"""The HTTP server of a studio, which listens on the loopback address only."""

import asyncio
import json
import math
import socket
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from functools import partial
from importlib.resources import files
from pathlib import Path
from secrets import token_urlsafe
from typing import TYPE_CHECKING, Any

from nanogs._version import __version__
from nanogs.errors import ExistsError, NanogsError, OptionError
from nanogs.formatting import utf8
from nanogs.studio.choice import Choice, choice_of
from nanogs.studio.jobs import Job
from nanogs.studio.listing import Folder
from nanogs.studio.orders import SaveRequest, refuse_unfit, shown_path
from nanogs.studio.pages import Pages
from nanogs.studio.safety import Guard
from nanogs.studio.scene import Scene, StudioSettings
from nanogs.studio.supervisor import WorkerSupervisor
from nanogs.templates import template

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.types import ASGIApp

_TICK = 0.5
_TYPES = {
    ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml", ".png": "image/png",
    ".json": "application/json", ".woff2": "font/woff2",
}  # fmt: skip
Endpoint = Callable[["Request"], Awaitable["Response"]]


class Studio:
    """The server of a studio: the constructor opens the port, `run` answers requests."""

    def __init__(
        self,
        scene: Scene,
        settings: StudioSettings,
        *,
        folder: Path,
        port: int = 0,
        idle: float = 60.0,
    ) -> None:
        """Listen on a port of this machine.

        Args:
            scene: The scene to open.
            settings: Settings of the studio.
            folder: The only folder whose files the page may name.
            port: Port number; 0 for any free one.
            idle: Seconds after which the studio ends once all pages are closed; 0 for never.

        Raises:
            OptionError: starlette or uvicorn is missing, or the port is taken.
        """
        _check_installed()
        self._scene, self._settings, self._idle = scene, settings, idle
        self._folder = Folder(folder.resolve())
        self._socket = _listening(port)
        self._port: int = self._socket.getsockname()[1]
        self._token = token_urlsafe(24)
        self._pages = Pages()
        self._supervisor = WorkerSupervisor(scene, settings, self._pages.deliver)
        self._stop: Callable[[], None] = lambda: None

    @property
    def url(self) -> str:
        """URL of the page, with the secret token."""
        return f"http://127.0.0.1:{self._port}/{self._token}/"

    def run(self) -> None:
        """Answer requests until all pages have been closed for `idle` seconds."""
        import uvicorn

        class Server(uvicorn.Server):
            @contextmanager
            def capture_signals(self) -> Iterator[None]:
                yield  # the caller has set the signal handlers

        config = uvicorn.Config(
            self._application(), log_config=None, log_level="error", access_log=False,
            lifespan="on", timeout_graceful_shutdown=1, server_header=False, ws="none",
        )  # fmt: skip
        server = Server(config)

        def stop() -> None:
            server.should_exit = True

        self._stop = stop
        try:
            server.run(sockets=[self._socket])
        finally:
            self._supervisor.end()
            self._socket.close()

    def _application(self) -> "ASGIApp":
        from starlette.applications import Starlette
        from starlette.routing import Route

        def get(path: str, answer: Endpoint) -> Route:
            return Route(f"/{self._token}/{path}", _told(answer), methods=["GET"])

        def post(path: str, answer: Endpoint) -> Route:
            return Route(f"/{self._token}/{path}", _told(answer), methods=["POST"])

        routes = [
            get("", self._page), get("viewer.js", self._viewer),
            get("static/{name}", self._static), get("events", self._events),
            get("files", self._files), get("models/{name}.spz", self._model),
            post("ask", self._ask), post("filter", self._filter),
            post("save", self._save), post("command", self._command),
            post("cancel", self._cancel), post("leave", self._leave),
            post("seen", self._seen),
        ]  # fmt: skip
        application = Starlette(routes=routes, lifespan=self._living)
        application.router.redirect_slashes = False
        return Guard(application, self._token, self._port)

    @asynccontextmanager
    async def _living(self, _application: object) -> AsyncIterator[None]:
        """Open the scene when the server starts, and watch for closed pages while it runs."""
        self._supervisor.open()
        watching = asyncio.create_task(self._watch())
        yield
        watching.cancel()

    async def _watch(self) -> None:
        """Drop the requests of closed pages, and stop the server when all pages are closed."""
        while True:
            await asyncio.sleep(_TICK)
            for name in self._pages.gone():
                self._drop(name)
            saving = any(job.kind == "save" for job in self._supervisor.queue)
            left = self._pages.last_left
            if left is None or self._pages.watched or saving or not self._idle:
                continue
            if time.monotonic() - left > self._idle:
                self._stop()

    def _drop(self, page: str) -> None:
        """Drop the requests of a page that is closed, but for a save."""
        self._supervisor.cancel(page, "ask", "filter", "curve")

    async def _page(self, _request: "Request") -> "Response":
        from starlette.responses import HTMLResponse

        page = template("nanogs.studio", "page.html.j2")
        text = page.render(name=self._scene.path.name, version=__version__)
        return HTMLResponse(utf8(text))

    async def _viewer(self, _request: "Request") -> "Response":
        return _file("nanogs.view", "viewer.js", "viewer.js")

    async def _static(self, request: "Request") -> "Response":
        name = request.path_params["name"]
        return _file("nanogs.studio", f"static/{name}", name)

    async def _events(self, request: "Request") -> "Response":
        from nanogs.studio.streaming import EventStream

        page = self._pages.get(request.query_params.get("page"))
        if self._pages.scene is None and self._supervisor.queue.idle:
            self._supervisor.open()  # an earlier attempt has failed
        return EventStream(partial(self._pages.stream, page))

    async def _model(self, request: "Request") -> "Response":
        from starlette.responses import Response

        data = self._pages.model(request.path_params["name"])
        if data is None:  # not an error: newer models have replaced the one a slow page asks for
            return Response(status_code=204)
        return Response(data, media_type="application/octet-stream")

    async def _files(self, request: "Request") -> "Response":
        folder = request.query_params.get("folder", "")
        return _json(await asyncio.to_thread(self._folder.listed, folder))

    async def _ask(self, request: "Request") -> "Response":
        data, number = await self._asked(request, "choice")
        order = self._unnamed(data)
        self._supervisor.put(Job("ask", data["page"], number, order.choice))
        return _json({"command": order.command()})

    async def _filter(self, request: "Request") -> "Response":
        data, number = await self._asked(request, "choice")
        self._supervisor.put(Job("filter", data["page"], number, self._chosen(data)))
        return _json({})

    async def _save(self, request: "Request") -> "Response":
        data, number = await self._asked(request, "choice", "path", "overwrite")
        if not isinstance(data.get("overwrite", False), bool):
            raise OptionError("overwrite is true or false.")
        order = self._order(data)
        await asyncio.to_thread(order.check_target)
        self._supervisor.put(Job("save", data["page"], number, order))
        return _json({"command": order.command()})

    async def _command(self, request: "Request") -> "Response":
        """Answer with the command that writes a file, or with a message why it cannot be written.

        Neither is an HTTP error, because the user may still be typing the name.
        """
        data, _ = await self._asked(request, "choice", "path")
        command, message, exists = None, None, False
        try:
            if data.get("path") is None:
                order = self._unnamed(data)
            else:
                order = self._order(data)
                await asyncio.to_thread(order.check_target)
            command = order.command()
        except ExistsError:
            command, exists = order.command(), True
        except NanogsError as error:
            message = str(error)
        return _json({"command": command, "message": message, "exists": exists})

    def _order(self, data: dict[str, Any]) -> SaveRequest:
        """Make the order to save the choice of a page, with a path relative to the folder.

        Raises:
            OptionError: It is invalid, or would replace the scene itself.
        """
        target = self._folder.inside(data.get("path"))
        if target == self._folder.root:
            raise OptionError("Name a file to save to.")
        if target == self._scene.path.resolve():
            raise OptionError(f"{data['path']} is the scene that is open; choose another name.")
        path = target.relative_to(self._folder.root)
        overwrite = bool(data.get("overwrite", False))
        return SaveRequest(self._scene, self._settings, self._chosen(data), path, overwrite)

    def _unnamed(self, data: dict[str, Any]) -> SaveRequest:
        """Make the order for the choice of a page with a placeholder path; see `_order`."""
        choice = self._chosen(data)
        return SaveRequest(self._scene, self._settings, choice, shown_path(self._scene, choice))

    def _chosen(self, data: dict[str, Any]) -> Choice:
        choice = choice_of(data.get("choice"))
        refuse_unfit(self._scene, choice)
        return choice

    async def _cancel(self, request: "Request") -> "Response":
        from starlette.responses import Response

        data, _ = await self._asked(request)
        self._supervisor.cancel(data["page"])
        return Response(status_code=204)

    async def _leave(self, request: "Request") -> "Response":
        """Drop the requests of a page that says that it is being closed or reloaded."""
        from starlette.responses import Response

        data, _ = await self._asked(request)
        self._drop(data["page"])
        return Response(status_code=204)

    async def _seen(self, request: "Request") -> "Response":
        """Note that a page has drawn a model, and the seconds that a splat took."""
        from starlette.responses import Response

        data, _ = await self._asked(request, "model", "pace")
        if not isinstance(model := data.get("model"), str):
            raise OptionError(f"A model that was drawn has a name, which is not {model!r}.")
        self._supervisor.seen(data["page"], model, _pace(data.get("pace")))
        return Response(status_code=204)

    async def _asked(self, request: "Request", *names: str) -> tuple[dict[str, Any], int | None]:
        """Parse a request: its entries, which may be only the named ones, and its number.

        Raises:
            OptionError: It is invalid.
        """
        try:
            data = json.loads(await request.body())
        except (ValueError, RecursionError):
            raise OptionError("The request is no JSON.") from None
        known = {"page", "number", *names}
        if not isinstance(data, dict) or not set(data) <= known:
            raise OptionError(f"A request has the entries {', '.join(sorted(known))}.")
        number = data.get("number")
        if isinstance(number, bool) or not isinstance(number, int | None):
            raise OptionError(f"The number of a request is a whole number, not {number!r}.")
        self._pages.get(data.get("page"))
        return data, number


def _told(answer: Endpoint) -> Endpoint:
    """Wrap an endpoint so that errors become a response with a message for the page."""

    async def answered(request: "Request") -> "Response":
        try:
            return await answer(request)
        except ExistsError as error:
            return _json({"message": error.sentence("press the button again")}, 409)
        except NanogsError as error:
            return _json({"message": str(error)}, 422)

    return answered


def _pace(said: object) -> float | None:
    """Check the seconds that a page takes to draw one splat; None if it does not know.

    Raises:
        OptionError: It is not a number above 0.
    """
    if said is None:
        return None
    if isinstance(said, int | float) and not isinstance(said, bool) and 0 < said < math.inf:
        return float(said)
    raise OptionError(f"A pace is a number of seconds above 0, not {said!r}.")


def _json(data: object, status: int = 200) -> "Response":
    from starlette.responses import Response

    # As ASCII with escapes, which can represent any file name.
    text = json.dumps(data, allow_nan=False)
    return Response(text, status, media_type="application/json")


def _file(package: str, path: str, name: str) -> "Response":
    """Respond with a file of a package, or 404 if there is no such file."""
    from starlette.responses import PlainTextResponse, Response

    kind = _TYPES.get(Path(name).suffix)
    # On Windows a backslash too leads to another folder.
    leaves = name.startswith(".") or "/" in name or "\\" in name
    data = None if kind is None or leaves else _package(package, path)
    if data is None:
        return PlainTextResponse("There is nothing here.", 404)
    return Response(data, media_type=kind)


def _package(package: str, path: str) -> bytes | None:
    found = files(package).joinpath(path)
    try:
        return found.read_bytes() if found.is_file() else None
    except OSError:  # a longer name than the system allows
        return None


def _listening(port: int) -> socket.socket:
    """Open a socket that listens on the loopback address only.

    Raises:
        OptionError: The port is taken, or not permitted to this user.
    """
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        if sys.platform != "win32":  # there it would let several studios share a port
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(("127.0.0.1", port))
        listening.listen()
    except OSError as error:
        listening.close()
        reason = error.strerror or str(error)
        raise OptionError(f"Port {port} cannot be used ({reason}); choose another.") from None
    return listening


def _check_installed() -> None:
    """Raise, before anything is begun, if the packages of the web server are missing.

    Raises:
        OptionError: They are missing.
    """
    try:
        import starlette  # noqa: F401
        import uvicorn  # noqa: F401
    except ImportError:
        raise OptionError(
            'The studio needs starlette and uvicorn: pip install "nanogs[studio]".'
        ) from None
