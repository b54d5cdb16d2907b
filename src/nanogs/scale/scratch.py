"""Where a job keeps its intermediate files: a folder, or what fsspec reaches by a URL.

Files appear whole or not at all. They are not forced to the disk: after a power cut, a resumed job
finds by their checksums which of them never arrived.
"""

import contextlib
import hashlib
import secrets
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, Protocol, cast

import numpy as np

from nanogs._types import Array
from nanogs.errors import OptionError, OutputError
from nanogs.io.atomic import output_error

_SUFFIXES = (".bin", ".json", ".tmp")
_CHUNK = 1 << 22


class Scratch(Protocol):
    """Files by name."""

    @property
    def place(self) -> str:
        """The folder or URL, as `open_scratch` takes it."""

    def prepare(self) -> None:
        """Make the folder. Only the caller does: a worker that does not see it must not make one.

        Raises:
            OutputError: Nothing can be written there.
        """

    def write(self, name: str, parts: Iterable[Array]) -> tuple[int, str]:
        """Write a file, whole or not at all; its bytes and their SHA-256.

        Raises:
            OutputError: It cannot be written.
        """

    def open(self, name: str) -> BinaryIO:
        """A file to read and seek in.

        Raises:
            OSError: It is not there.
        """

    def remove(self) -> None:
        """Take away all files that `write` made, and the folder, and the one around it if empty."""

    def tidy(self) -> None:
        """Take away what killed writers left."""


class FolderScratch:
    """A folder of this machine, or one that all workers share."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @property
    def place(self) -> str:
        """The folder or URL."""
        return str(self.folder)

    def prepare(self) -> None:
        """As `Scratch` says."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise output_error(self.folder, error) from error

    def write(self, name: str, parts: Iterable[Array]) -> tuple[int, str]:
        """As `Scratch` says."""
        temporary = self.folder / f"{name}.{secrets.token_hex(4)}.tmp"
        try:
            with temporary.open("xb", buffering=0) as file:
                written = _write_hashed(cast("BinaryIO", file), parts)
            temporary.replace(self.folder / name)
        except OSError as error:
            raise output_error(self.folder / name, error) from error
        finally:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
        return written

    def open(self, name: str) -> BinaryIO:
        """As `Scratch` says."""
        return cast("BinaryIO", (self.folder / name).open("rb", buffering=0))

    def remove(self) -> None:
        """As `Scratch` says."""
        for path in self._files(_SUFFIXES):
            path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # unless something else is in it
            self.folder.rmdir()
            self.folder.parent.rmdir()

    def tidy(self) -> None:
        """As `Scratch` says."""
        for path in self._files((".tmp",)):
            path.unlink(missing_ok=True)

    def _files(self, suffixes: tuple[str, ...]) -> Iterator[Path]:
        if self.folder.is_dir():
            yield from [path for path in self.folder.iterdir() if path.suffix in suffixes]


class UrlScratch:
    """A folder by URL, such as s3://bucket/job, through fsspec; uploads are whole or nothing."""

    def __init__(self, url: str) -> None:
        try:
            import fsspec
        except ImportError:
            raise OptionError(
                f"{url} needs fsspec and its part for this kind of URL; install nanogs[cluster]."
            ) from None
        self.url = url.rstrip("/")
        try:
            found = fsspec.core.url_to_fs(self.url)
        except (ImportError, ValueError) as error:
            raise OptionError(
                f"{url} cannot be reached ({error}); install what it needs."
            ) from None
        self.files: Any = found[0]
        self.root: str = found[1]

    @property
    def place(self) -> str:
        """The folder or URL."""
        return self.url

    def prepare(self) -> None:
        """As `Scratch` says."""
        try:
            self.files.makedirs(self.root, exist_ok=True)
        except OSError as error:
            reason = error.strerror or str(error)
            raise OutputError(f"{self.url} cannot be written to ({reason}).") from error

    def write(self, name: str, parts: Iterable[Array]) -> tuple[int, str]:
        """As `Scratch` says."""
        try:
            with self.files.open(f"{self.root}/{name}", "wb") as file:
                return _write_hashed(file, parts)
        except OSError as error:
            reason = error.strerror or str(error)
            raise OutputError(f"{self.url}/{name} cannot be written ({reason}).") from error

    def open(self, name: str) -> BinaryIO:
        """As `Scratch` says."""
        return cast("BinaryIO", self.files.open(f"{self.root}/{name}", "rb"))

    def remove(self) -> None:
        """As `Scratch` says."""
        if self.files.exists(self.root):
            for path in self.files.ls(self.root, detail=False):
                if str(path).endswith(_SUFFIXES):
                    self.files.rm_file(path)
            with contextlib.suppress(OSError, NotImplementedError):
                self.files.rmdir(self.root)
                self.files.rmdir(self.root.rpartition("/")[0])

    def tidy(self) -> None:
        """Nothing is left: an upload that is not closed never appears."""


def open_scratch(place: str) -> Scratch:
    """The files at a folder or URL.

    Raises:
        OptionError: What reaches that kind of URL is not installed.
    """
    return UrlScratch(place) if is_url(place) else FolderScratch(Path(place))


def is_url(place: str) -> bool:
    """Whether a place is one that fsspec reaches."""
    return "://" in place


def hash_file(file: BinaryIO) -> tuple[int, str]:
    """Bytes of an open file from here on, and their SHA-256."""
    digest, count = hashlib.sha256(), 0
    while chunk := file.read(_CHUNK):
        digest.update(chunk)
        count += len(chunk)
    return count, digest.hexdigest()


def _write_hashed(file: BinaryIO, parts: Iterable[Array]) -> tuple[int, str]:
    digest, count = hashlib.sha256(), 0
    for part in parts:
        data = part.reshape(-1).view(np.uint8).data
        digest.update(data)
        count += len(data)
        while data:
            data = data[file.write(data) :]
    return count, digest.hexdigest()
