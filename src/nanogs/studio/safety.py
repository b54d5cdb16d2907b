"""Access control: a studio answers only its own page, in a browser on this machine.

A foreign page in the same browser may send requests to any port of this machine. It does not know
the token; it cannot read responses or send JSON across origins, because no CORS headers are ever
sent; and DNS rebinding, a host name of its own that resolves to this machine, shows in `Host`.
"""

from hmac import compare_digest
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from starlette.datastructures import Headers
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

MOST_BYTES = 1 << 16  # of a request body
_HTTP_PORT = 80  # the port that clients leave out of `Host` and `Origin`
HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self' 'wasm-unsafe-eval' blob:;"
    " worker-src blob:; connect-src 'self' data: blob:; img-src 'self' data: blob:;"
    " style-src 'self' 'unsafe-inline'; base-uri 'none'; form-action 'none';"
    " frame-ancestors 'none'",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
    "cache-control": "no-store",
    "x-frame-options": "DENY",
    "cross-origin-resource-policy": "same-origin",
}


class Guard:
    """ASGI middleware that passes only requests of the studio's own page to an application."""

    def __init__(self, inner: "ASGIApp", token: str, port: int) -> None:
        """Wrap an application.

        Args:
            inner: The application.
            token: Secret first segment of all paths.
            port: Port of the server.
        """
        self._inner, self._token = inner, token
        names = ("127.0.0.1", "localhost")
        self._hosts = {f"{name}:{port}" for name in names}
        if port == _HTTP_PORT:
            self._hosts.update(names)

    async def __call__(self, scope: "Scope", receive: "Receive", send: "Send") -> None:
        """Refuse a request, or pass it to the application and add the security headers."""
        if scope["type"] == "lifespan":  # start and end of the server itself
            await self._inner(scope, receive, send)
        if scope["type"] != "http":
            return
        from starlette.datastructures import Headers, MutableHeaders
        from starlette.responses import PlainTextResponse

        async def sent(message: "Message") -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(HEADERS)
            await send(message)

        refused = self._refused(scope, Headers(scope=scope))
        if refused is None:
            await self._inner(scope, receive, sent)
        else:
            status, text = refused
            await PlainTextResponse(text, status)(scope, receive, sent)

    def _refused(self, scope: "Scope", headers: "Headers") -> tuple[int, str] | None:
        """Return status and text of the refusal of a request; None if it may pass."""
        host = headers.get("host", "")
        if host not in self._hosts or len(headers.getlist("host")) != 1:
            return 421, "This address is not the studio's."
        token = scope["path"].split("/")[1:2]
        known = token and compare_digest(token[0].encode(), self._token.encode())
        if not known or scope["path"].count("/") < 2:
            return 404, "There is nothing here."
        if scope["method"] not in ("GET", "HEAD", "POST"):
            return 405, "This is not done here."
        return self._refused_post(headers, host) if scope["method"] == "POST" else None

    @staticmethod
    def _refused_post(headers: "Headers", host: str) -> tuple[int, str] | None:
        if headers.get("origin") != f"http://{host}":
            return 403, "Only the studio's own page may ask for this."
        kind = headers.get("content-type", "").partition(";")[0].strip().lower()
        if kind != "application/json":
            return 415, "Requests are JSON."
        length = headers.get("content-length", "")
        if not length.isdecimal():
            return 411, "The length of the request is missing."
        return (413, "The request is too long.") if int(length) > MOST_BYTES else None
