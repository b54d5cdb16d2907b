"""Intermediate files of a job: in a folder, or under a URL (`remote`).

Files appear whole or not at all. They are not synced to the disk: after a power cut, a resumed job
finds by their checksums which of them never arrived.
"""

import contextlib
import hashlib
import secrets
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO, Protocol, cast

import numpy as np

from nanogs._types import Array
from nanogs.errors import OutputError
from nanogs.io.atomic import output_error
from nanogs.io.folder import make_folders, remove_empty
from nanogs.io.urls import is_url

SUFFIXES = (".npy", ".json", ".tmp")
PARENT_MARKER = "made.json"  # holds the number of folders around that `prepare` made
_CHUNK = 1 << 22


class Scratch(Protocol):
    """Storage of the intermediate files of a job, by name."""

    @property
    def place(self) -> str:
        """The folder or URL, as `open_scratch` takes it."""

    @property
    def label(self) -> str:
        """The folder or URL for messages, without secrets."""

    @property
    def at_once(self) -> int:
        """Number of files to read at a time; more than 1 where each read has a long latency."""

    def prepare(self) -> None:
        """Make the folder. Only the caller does: a worker that does not see it must not make one.

        Raises:
            OutputError: Nothing can be written there.
        """

    def write(self, name: str, parts: Iterable[Array]) -> tuple[int, str]:
        """Write a file, whole or not at all; return its size in bytes and its SHA-256.

        Raises:
            OutputError: It cannot be written.
        """

    def open(self, name: str, size: int | None = None) -> BinaryIO:
        """Open a file to read and seek in.

        Args:
            name: Of the file.
            size: Its bytes, if they are known.

        Raises:
            OSError: It is not there.
        """

    def discard(self, beginnings: tuple[str, ...]) -> None:
        """Delete all files of `write` whose names begin with one of `beginnings`."""

    def remove(self) -> None:
        """Delete all files of `write`, the folder, and the folders around it.

        The latter only if they are empty and `prepare` made them, in this run or an earlier one.
        """

    def tidy(self) -> None:
        """Delete temporary files of writers that were killed."""


class FolderScratch:
    """Intermediate files in a folder of this machine, or in one that all workers share."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @property
    def place(self) -> str:
        """The folder."""
        return str(self.folder)

    @property
    def label(self) -> str:
        """The folder."""
        return str(self.folder)

    @property
    def at_once(self) -> int:
        """One: files are read one at a time."""
        return 1

    def prepare(self) -> None:
        """Make the folder, and note how many around it were made too; see `Scratch.prepare`."""
        try:
            around = make_folders(self.folder)[1:]
            if around:
                (self.folder / PARENT_MARKER).write_text(f"{len(around)}")
        except NotADirectoryError as error:
            raise OutputError(
                f"{self.folder.parent} is not a folder; name another one with `scratch`."
            ) from error
        except OSError as error:
            raise output_error(self.folder, error) from error

    def write(self, name: str, parts: Iterable[Array]) -> tuple[int, str]:
        """Write a file under a temporary name and rename it; see `Scratch.write`."""
        temporary = self.folder / f"{name}.{secrets.token_hex(4)}.tmp"
        try:
            with temporary.open("xb", buffering=0) as file:
                written = write_hashed(cast("BinaryIO", file), parts)
            temporary.replace(self.folder / name)
        except OSError as error:
            raise output_error(self.folder / name, error) from error
        finally:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
        return written

    def open(self, name: str, size: int | None = None) -> BinaryIO:  # noqa: ARG002
        """Open a file to read and seek in; see `Scratch.open`."""
        return cast("BinaryIO", (self.folder / name).open("rb", buffering=0))

    def discard(self, beginnings: tuple[str, ...]) -> None:
        """Delete all files written here whose names begin with one of `beginnings`."""
        for path in self._files(SUFFIXES):
            if path.name.startswith(beginnings):
                path.unlink(missing_ok=True)

    def remove(self) -> None:
        """Delete all files written here, and the folder; see `Scratch.remove`."""
        try:
            made = made_parents((self.folder / PARENT_MARKER).read_bytes())
        except OSError:
            made = 0
        for path in self._files(SUFFIXES):
            path.unlink(missing_ok=True)
        remove_empty([self.folder, *self.folder.parents[:made]])

    def tidy(self) -> None:
        """Delete temporary files of writers that were killed."""
        for path in self._files((".tmp",)):
            path.unlink(missing_ok=True)

    def _files(self, suffixes: tuple[str, ...]) -> Iterator[Path]:
        if self.folder.is_dir():
            yield from [path for path in self.folder.iterdir() if path.suffix in suffixes]


def made_parents(marker: bytes) -> int:
    """Return the number of folders that a marker counts; an empty one counts one."""
    return int(marker) if marker.isdigit() else 1


def open_scratch(place: str) -> Scratch:
    """Return the storage at a folder or URL.

    Raises:
        OptionError: The package for that kind of URL is not installed.
    """
    if not is_url(place):
        return FolderScratch(Path(place))
    from nanogs.store.remote import UrlScratch

    return UrlScratch(place)


def hash_file(file: BinaryIO) -> tuple[int, str]:
    """Return the number of bytes of an open file from here on, and their SHA-256."""
    digest, count = hashlib.sha256(), 0
    while chunk := file.read(_CHUNK):
        digest.update(chunk)
        count += len(chunk)
    return count, digest.hexdigest()


def write_hashed(file: BinaryIO, parts: Iterable[Array]) -> tuple[int, str]:
    """Write arrays one by one; return the number of bytes and their SHA-256."""
    digest, count = hashlib.sha256(), 0
    for part in parts:
        data = part.reshape(-1).view(np.uint8).data
        digest.update(data)
        count += len(data)
        while data:
            data = data[file.write(data) :]
    return count, digest.hexdigest()
