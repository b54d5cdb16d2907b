"""URLs in place of paths: recognising them, and showing them without secrets.

pathlib collapses `https://` to `https:/`, so a URL is converted to an `Address` as soon as it is
passed in. Messages and file names never contain its possible secrets: user and password, query,
and fragment.
"""

import re
import sys
from collections.abc import Sequence
from os import PathLike, fsencode, fspath
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote, unquote

from nanogs.errors import OptionError

if sys.platform == "win32":
    from pathlib import WindowsPath as _Native
else:
    from pathlib import PosixPath as _Native

# A scheme has two characters or more, so that a drive (C:/) is none.
_URL = re.compile(r"[a-z][a-z0-9+.-]+(::[a-z0-9+.-]+)*://", re.IGNORECASE)
_WEB = ("http", "https")
_UNSAFE = re.compile(r"[^\w .,+()-]")  # characters that some system does not allow in file names
_SHORTEST = 4  # secrets with fewer characters are not removed from texts: they match other words
_LONGEST = 120  # characters of a file's name


class _Called(_Native):
    """A path with a display name: `str` gives that name, and `fspath` the real path."""

    called: str

    def __new__(cls, place: str | PathLike[str], called: str) -> Self:
        self = super().__new__(cls, place)
        self.called = called
        return self

    if sys.version_info >= (3, 12):

        def __init__(self, place: str | PathLike[str], called: str) -> None:  # noqa: ARG002
            super().__init__(place)

        def with_segments(self, *segments: str | PathLike[str]) -> Path:  # type: ignore[override]
            """Return a plain `Path` for paths derived from this one, such as its parent."""
            return Path(*segments)

    else:

        @classmethod
        def _from_parsed_parts(cls, *parts: Any) -> Path:  # noqa: ANN401 - pathlib's own
            """Return a plain `Path`; the equivalent of `with_segments` in Python 3.11."""
            made: Path = _Native._from_parsed_parts(*parts)  # type: ignore[attr-defined]  # noqa: SLF001
            return made

    def __str__(self) -> str:
        # In Python 3.11, `resolve` creates the result without calling the class.
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


class UrlFile(_Called):
    """A temporary file in place of a URL, which is its display name."""


class Address(_Called):
    """A URL as a `Path` object, for functions that take paths; it is no file of the system.

    Its name and suffix are those of the URL without query and fragment, valid as a file name on
    every system, and `str` is the URL without its secrets.

    Attributes:
        url: The complete URL, with its secrets.
    """

    url: str

    def __new__(cls, url: str, _called: str = "") -> Self:
        """Make an address from a complete URL."""
        self = super().__new__(cls, _placed(url), redacted(url))
        self.url = url
        return self

    if sys.version_info >= (3, 12):

        def __init__(self, url: str, _called: str = "") -> None:
            super().__init__(_placed(url), redacted(url))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Address) and self.url == other.url

    def __hash__(self) -> int:
        return hash(self.url)

    def __reduce__(self) -> Any:  # noqa: ANN401 - as pickle has it
        return type(self), (self.url,)

    @property
    def kind(self) -> str:
        """The protocol of the URL, in lower case: "https", "s3"."""
        return self.url.partition("://")[0].rpartition("::")[2].lower()

    @property
    def on_web(self) -> bool:
        """Whether it is http or https."""
        return self.url.lower().startswith(tuple(f"{kind}://" for kind in _WEB))

    def beside(self, name: str) -> "Address":
        """Return the URL of another file in the same folder, with the same query.

        The query is kept because it may contain access keys.

        Args:
            name: Name of the file, or its path relative to the folder.
        """
        main = _main(self.url)
        ends = re.search(r"[?#]", main)
        path, rest = (main[: ends.start()], main[ends.start() :]) if ends else (main, "")
        given = quote(name) if self.on_web else name
        other = f"{path.rpartition('/')[0]}/{given}{rest}"
        return Address(self.url.replace(main, other, 1))

    def said(self, text: str) -> str:
        """Remove the secrets of the URL from a text, such as the error message of a library."""
        text = text.replace(self.url, str(self))
        for part in self.url.split("::"):
            place = part.partition("://")[2].partition("/")[0]
            who, query = place.rpartition("@")[0], "".join(re.split(r"([?#])", part)[1:])
            words = (who, who.partition(":")[2], query, *re.split(r"[?#&=]", query))
            for secret in words:
                text = text.replace(secret, "...") if len(secret) >= _SHORTEST else text
        return text


def is_url(text: object) -> bool:
    """Whether a text is a URL, such as "s3://bucket/scene.ply", and not a path."""
    return isinstance(text, str) and _URL.match(text) is not None


def path_text(name: str, given: object) -> str:
    """Return the text of a path or URL that is an option.

    Args:
        name: Of the option.
        given: Its value.

    Raises:
        OptionError: It is no path, or empty.
    """
    text = fspath(given) if isinstance(given, str | PathLike) else None
    if not isinstance(text, str):
        raise OptionError(f"`{name}` is a path, not {type(given).__name__}.")
    if not text.strip():
        raise OptionError(f"`{name}` is empty; name a place, or leave it out.")
    return text


def as_path(given: object) -> Path:
    """Convert an argument to a `Path`, or a URL to an `Address`; `file://` URLs become paths.

    Args:
        given: A path or a URL.

    Raises:
        OptionError: It is no path, empty, no possible name, or a `file://` URL of another machine.
    """
    if not isinstance(given, str | PathLike):
        raise OptionError(
            f"A path or URL is needed, not {type(given).__name__}; nanogs.save writes a model into"
            " a file."
        )
    if given == "":
        raise OptionError("A path is empty; name a file.")
    if isinstance(given, _Called):
        return given
    if not (isinstance(given, str) and is_url(given)):
        return _possible(Path(given))
    address = Address(given)
    if address.kind != "file" or "::" in given:
        return address
    from urllib.request import url2pathname  # slow to import

    host, slash, path = str(address).partition("://")[2].partition("/")
    if host.lower() not in ("", "localhost"):
        raise OptionError(f"{address} is on the machine {host}; write file:///folder/scene.ply.")
    return _possible(Path(url2pathname(slash + path)))


def _possible(path: Path) -> Path:
    """Return a path, if it can be one of a file.

    Raises:
        OptionError: It has a character that no file's name can have.
    """
    if not can_be_name(str(path)):
        raise OptionError(f"{str(path)!r} cannot be the name of a file; choose another.")
    return path


def can_be_name(text: str) -> bool:
    """Return whether the system could name a file so: without a NUL or a lone surrogate."""
    try:
        return b"\0" not in fsencode(text)
    except UnicodeEncodeError:
        return False


def local_path(given: object) -> Path:
    """Convert an argument to the path of a file or folder of this machine.

    Args:
        given: A path or a `file://` URL.

    Raises:
        OptionError: As for `as_path`, or it is another URL.
    """
    path = as_path(given)
    if isinstance(path, Address):
        raise OptionError(f"{path} is a URL; name a file or folder of this machine.")
    return path


def short_names(paths: Sequence[Path]) -> list[str]:
    """Name files by the last part of their paths, or by as many parts as tell them apart.

    So `a/model.ply` and `b/model.ply` keep their folders; a file that is given twice has one name.
    """
    return [_short(path, {other for other in paths if other.name == path.name}) for path in paths]


def _short(path: Path, alike: set[Path]) -> str:
    """Return the shortest name of a path that is not the end of another path with its last part."""
    parts = path.as_posix().split("/")
    others = [other.as_posix().split("/") for other in alike - {path}]
    if not others:
        return path.name
    for count in range(2, len(parts)):
        if all(other[-count:] != parts[-count:] for other in others):
            return "/".join(parts[-count:])
    return path.as_posix()


def redacted(url: str) -> str:
    """Return a URL without user, password, query and fragment."""
    parts = []
    for part in url.split("::"):
        kind, colon, rest = re.split(r"[?#]", part, maxsplit=1)[0].partition("://")
        host, slash, path = rest.partition("/")
        parts.append(f"{kind}{colon}{host.rpartition('@')[2]}{slash}{path}")
    return "::".join(parts)


def _main(url: str) -> str:
    """Return the part of a chained fsspec URL that names the file.

    In `zip://a.ply::s3://b/c.zip` that is `zip://a.ply`.
    """
    return next((part for part in url.split("::") if "://" in part), url)


def _placed(url: str) -> str:
    """Return the path from which an `Address` takes its name and suffix, valid on every system."""
    folder, _, last = _main(redacted(url)).rpartition("/")
    name = _UNSAFE.sub("_", unquote(last))[-_LONGEST:].strip(" .") or "model"
    return f"{folder}/{name}"
