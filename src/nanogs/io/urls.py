"""URLs where files are named: how they are told from files, and what they are called.

pathlib makes `https:/` of `https://`, so a URL is an `Address` from where it comes in. Nothing that
is said of it, and no file, has what may be secret in it: user and password, query, and fragment.
"""

import re
import sys
from os import PathLike, fspath
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote, unquote

from nanogs.errors import OptionError

if sys.platform == "win32":
    from pathlib import WindowsPath as _Native
else:
    from pathlib import PosixPath as _Native

_URL = re.compile(r"[a-z][a-z0-9+.-]+(::[a-z0-9+.-]+)*://", re.IGNORECASE)  # no drive: C:/
_WEB = ("http", "https")
_UNSAFE = re.compile(r"[^\w .,+()-]")  # in a file's name, on any system
_SHORTEST = 4  # characters of a secret that texts of others are searched for
_LONGEST = 120  # characters of a file's name


class _Called(_Native):
    """A path that is called otherwise in whatever is said: `str` has that, the system the path."""

    called: str

    def __new__(cls, place: str | PathLike[str], called: str) -> Self:
        self = super().__new__(cls, place)
        self.called = called
        return self

    if sys.version_info >= (3, 12):

        def __init__(self, place: str | PathLike[str], called: str) -> None:  # noqa: ARG002
            super().__init__(place)

        def with_segments(self, *segments: str | PathLike[str]) -> Path:  # type: ignore[override]
            """Make a plain path of whatever is derived from this one, such as its folder."""
            return Path(*segments)

    else:

        @classmethod
        def _from_parsed_parts(cls, *parts: Any) -> Path:  # noqa: ANN401 - pathlib's own
            """Do as `with_segments`, by the name that Python 3.11 calls."""
            made: Path = _Native._from_parsed_parts(*parts)  # type: ignore[attr-defined]  # noqa: SLF001
            return made

    def __str__(self) -> str:
        # Python 3.11 makes what `resolve` gives without calling the class.
        return getattr(self, "called", None) or super().__str__()

    def __fspath__(self) -> str:
        return super().__str__()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Called):
            return super().__eq__(other)
        return (fspath(self), str(self)) == (fspath(other), str(other))

    def __hash__(self) -> int:
        return hash(fspath(self))

    def __reduce__(self) -> Any:  # noqa: ANN401 - as pickle has it
        return type(self), (fspath(self), str(self))


class StandIn(_Called):
    """A temporary file in place of a URL, which it is called by."""


class Address(_Called):
    """A URL where a path is expected; no file of the system.

    Its name and suffix are those of the URL without query and fragment, fit for a file of every
    system, and `str` is the URL without its secrets.

    Attributes:
        url: All of it.
    """

    url: str

    def __new__(cls, url: str, _called: str = "") -> Self:
        """An address of all of a URL."""
        self = super().__new__(cls, _placed(url), said_of(url))
        self.url = url
        return self

    if sys.version_info >= (3, 12):

        def __init__(self, url: str, _called: str = "") -> None:
            super().__init__(_placed(url), said_of(url))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Address) and self.url == other.url

    def __hash__(self) -> int:
        return hash(self.url)

    def __reduce__(self) -> Any:  # noqa: ANN401 - as pickle has it
        return type(self), (self.url,)

    @property
    def kind(self) -> str:
        """The protocol of the URL, in small letters: "https", "s3"."""
        return self.url.partition("://")[0].rpartition("::")[2].lower()

    @property
    def on_web(self) -> bool:
        """Whether it is http or https."""
        return self.url.lower().startswith(tuple(f"{kind}://" for kind in _WEB))

    def beside(self, name: str) -> "Address":
        """Another file of the same folder, whose query is the same, in which keys may be.

        Args:
            name: Of the file, or a path from the folder.
        """
        main = _main(self.url)
        ends = re.search(r"[?#]", main)
        path, rest = (main[: ends.start()], main[ends.start() :]) if ends else (main, "")
        given = quote(name) if self.on_web else name
        other = f"{path.rpartition('/')[0]}/{given}{rest}"
        return Address(self.url.replace(main, other, 1))

    def said(self, text: str) -> str:
        """A text of others about the URL, such as an error, without its secrets."""
        text = text.replace(self.url, str(self))
        for part in self.url.split("::"):
            place = part.partition("://")[2].partition("/")[0]
            who, query = place.rpartition("@")[0], "".join(re.split(r"([?#])", part)[1:])
            words = (who, who.partition(":")[2], query, *re.split(r"[?#&=]", query))
            for secret in words:
                text = text.replace(secret, "...") if len(secret) >= _SHORTEST else text
        return text


def is_url(text: object) -> bool:
    """Whether a text is a URL, such as "s3://bucket/scene.ply", and no path."""
    return isinstance(text, str) and _URL.match(text) is not None


def place(given: str | PathLike[str]) -> Path:
    """The path that is meant, or the `Address` of a URL; of `file://` the path.

    Args:
        given: A path or a URL.

    Raises:
        OptionError: It is empty, or a file of another machine.
    """
    if given == "":
        raise OptionError("A path is empty; name a file.")
    if isinstance(given, _Called):
        return given
    if not (isinstance(given, str) and is_url(given)):
        return Path(given)
    address = Address(given)
    if address.kind != "file" or "::" in given:
        return address
    from urllib.request import url2pathname  # takes long to import

    host, slash, path = str(address).partition("://")[2].partition("/")
    if host.lower() not in ("", "localhost"):
        raise OptionError(f"{address} is on the machine {host}; write file:///folder/scene.ply.")
    return Path(url2pathname(slash + path))


def said_of(url: str) -> str:
    """A URL without user and password, query and fragment."""
    parts = []
    for part in url.split("::"):
        kind, colon, rest = re.split(r"[?#]", part, maxsplit=1)[0].partition("://")
        host, slash, path = rest.partition("/")
        parts.append(f"{kind}{colon}{host.rpartition('@')[2]}{slash}{path}")
    return "::".join(parts)


def _main(url: str) -> str:
    """Of URLs in each other, `zip://a.ply::s3://b/c.zip`, the one that names the file."""
    return next((part for part in url.split("::") if "://" in part), url)


def _placed(url: str) -> str:
    """The text that the parts of an address are taken from: its name is one for a file."""
    folder, _, last = _main(said_of(url)).rpartition("/")
    name = _UNSAFE.sub("_", unquote(last))[-_LONGEST:].strip(" .") or "model"
    return f"{folder}/{name}"
