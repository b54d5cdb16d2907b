"""Downloading files by http and https, with the standard library alone."""

import base64
import gzip
import http.client
import io
import socket
import ssl
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import IO, Any, cast
from urllib.error import HTTPError, URLError
from urllib.parse import quote, unquote, urlsplit, urlunsplit
from urllib.request import Request, urlopen

from nanogs._version import __version__
from nanogs.errors import FormatError
from nanogs.io.urls import Address

_PATIENCE = 60.0  # timeout in seconds without a byte
_KEPT = "%/:=&?~#+!$,;'@()*[]"  # not escaped by `quote`; with %, as a URL may be escaped already


@contextmanager
def opened(address: Address) -> Iterator[tuple[IO[bytes], int | None]]:
    """Open a URL for reading from start to end; yield the file and its size in bytes, if known.

    User and password are sent only to the host of the URL, not to hosts that it redirects to.

    Raises:
        FormatError: There is no such host or file, access is denied, or fewer bytes arrived than
            were announced.
    """
    try:
        with urlopen(_request(address), timeout=_PATIENCE) as answer:  # noqa: S310 - http alone
            whole = _Counted(answer, _length(answer))
            packed = (answer.headers.get("Content-Encoding") or "").lower() in ("gzip", "x-gzip")
            size = None if packed else whole.size
            file = gzip.GzipFile(fileobj=whole, mode="rb") if packed else whole
            yield cast("IO[bytes]", file), size
            if whole.size is not None and whole.read_bytes < whole.size:
                raise FormatError(
                    f"{address}: the connection broke after {whole.read_bytes:,} of"
                    f" {whole.size:,} bytes; run again."
                )
    except HTTPError as error:
        error.close()
        raise FormatError(f"{address}: {_refusal(error)}.") from None
    except URLError as error:
        raise FormatError(f"{address}: {_unreached(address, error.reason)}.") from None
    except (http.client.HTTPException, ssl.SSLError, ConnectionError, TimeoutError) as error:
        raise FormatError(f"{address}: {_unreached(address, error)}.") from None
    except (EOFError, gzip.BadGzipFile):
        raise FormatError(f"{address}: the download was cut short; run again.") from None
    except ValueError as error:  # an invalid port or host
        reason = address.said(str(error))
        raise FormatError(f"{address} is not a valid address ({reason}); check it.") from None


class _Counted(io.RawIOBase):
    """An HTTP response as a stream that counts the bytes read."""

    def __init__(self, answer: http.client.HTTPResponse, size: int | None) -> None:
        self._answer, self.size, self.read_bytes = answer, size, 0

    def readable(self) -> bool:
        return True

    def read(self, size: int = -1, /) -> bytes:
        data = self._answer.read(size if size >= 0 else None)
        self.read_bytes += len(data)
        return data


def _request(address: Address) -> Request:
    parts = urlsplit(address.url)
    who, _, host = parts.netloc.rpartition("@")
    host = host.encode("idna").decode() if not host.isascii() else host
    url = quote(urlunsplit((*parts._replace(netloc=host)[:4], "")), safe=_KEPT)
    request = Request(url, headers={"User-Agent": f"nanogs/{__version__}"})  # noqa: S310
    request.add_header("Accept-Encoding", "identity")
    if who:
        key = base64.b64encode(unquote(who).encode()).decode()
        request.add_unredirected_header("Authorization", f"Basic {key}")
    return request


def _length(answer: http.client.HTTPResponse) -> int | None:
    with suppress(TypeError, ValueError):
        return int(answer.headers["Content-Length"])
    return None


def _refusal(error: HTTPError) -> str:
    if error.code in (404, 410):
        return f"there is no such file ({error.code}); check the address"
    if error.code in (401, 403, 407):
        return (
            f"the server refuses access ({error.code}); check the address, its password, or whether"
            " its signature has expired"
        )
    return f"the server answers {error.code} in place of the file; try again later"


def _unreached(address: Address, reason: Any) -> str:  # noqa: ANN401 - an error or a text
    host = urlsplit(str(address)).netloc
    if isinstance(reason, socket.gaierror):
        return f"there is no host {host}, or no network; check the address"
    if isinstance(reason, TimeoutError):
        return f"{host} does not answer; try again later"
    said = getattr(reason, "strerror", None) or str(reason) or type(reason).__name__
    return f"{host} cannot be reached ({address.said(said).rstrip('.')}); check the address"
