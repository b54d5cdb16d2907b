"""Intermediate files under a URL, such as s3://bucket/job, through fsspec."""

import io
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import PurePosixPath
from typing import Any, BinaryIO, cast

import numpy as np

from nanogs._types import Array
from nanogs.errors import NanogsError, OutputError
from nanogs.io.transfer import reason_of, store_of
from nanogs.io.urls import Address
from nanogs.store.scratch import PARENT_MARKER, SUFFIXES, made_parents, write_hashed

# Object stores: they have no folders, so none is made or removed; for a name without slashes, that
# would be a bucket.
_STORES = frozenset({"s3", "s3a", "gs", "gcs", "abfs", "abfss", "az", "adl", "oss", "oci"})
_UPLOAD = 1 << 23  # bytes of a part of an upload, which are buffered until it is sent
_RANGE = 1 << 22  # most bytes of a request; they are held twice
_AT_ONCE = 8  # concurrent requests
_PROBE = "probe.tmp"


class UrlScratch:
    """Intermediate files under a URL; a table is complete once its record is there."""

    def __init__(self, url: str) -> None:
        self._address = Address(url.rstrip("/"))
        self.files, self.root = store_of(self._address)
        self.has_folders = self._address.kind not in _STORES

    @property
    def place(self) -> str:
        """The URL."""
        return self._address.url

    @property
    def label(self) -> str:
        """The URL without user and password."""
        return str(self._address)

    @property
    def at_once(self) -> int:
        """Number of files to read at a time, to hide the latency of requests."""
        return _AT_ONCE

    def prepare(self) -> None:
        """Make the folder, and try to write, read and delete there before anything is computed."""
        with self._reached(f"{self.label} cannot be written to"):
            if self.has_folders:
                new = sum(not self.files.exists(parent) for parent in self._parents())
                self.files.makedirs(self.root, exist_ok=True)
                if new:
                    self.files.pipe_file(f"{self.root}/{PARENT_MARKER}", f"{new}".encode())
        self.write(_PROBE, [np.zeros(1, np.uint8)])
        with self.open(_PROBE) as file:
            file.read()
        with self._reached(f"Nothing can be deleted in {self.label}"):
            self.files.rm_file(f"{self.root}/{_PROBE}")

    def write(self, name: str, parts: Iterable[Array]) -> tuple[int, str]:
        """Upload a file, whole or not at all; see `Scratch.write`."""
        with self._reached(f"{self.label}/{name} cannot be written"):
            file = self.files.open(f"{self.root}/{name}", "wb", block_size=_UPLOAD)
            try:
                written = write_hashed(file, parts)
            except BaseException:
                with suppress(Exception):  # closing it would publish the part as a whole file
                    file.discard()
                raise
            file.close()
        return written

    def open(self, name: str, size: int | None = None) -> BinaryIO:
        """Open a file to read and seek in; see `Scratch.open`."""
        path = f"{self.root}/{name}"
        if size is None:
            with self._reached(f"{self.label}/{name} cannot be read", missing=True):
                self.files.invalidate_cache()  # other processes write too
                size = int(self.files.size(path))
        return cast("BinaryIO", _Ranges(self, path, size))

    def read(self, path: str, start: int, stop: int) -> bytes:
        """Read a range of bytes of a file, in one request."""
        with self._reached(f"{path} cannot be read", missing=True):
            return bytes(self.files.cat_file(path, start=start, end=stop))

    def discard(self, beginnings: tuple[str, ...]) -> None:
        """Delete all files written here whose names begin with one of `beginnings`."""
        with self._reached(f"Nothing can be deleted in {self.label}"):
            for path in self._names(SUFFIXES):
                if path.rpartition("/")[2].startswith(beginnings):
                    self.files.rm_file(path)

    def remove(self) -> None:
        """Delete all files written here, and the folder; see `Scratch.remove`."""
        with self._reached(f"{self.label} cannot be emptied"):
            self._abort()
            paths, made = self._names(SUFFIXES), 0
            for path in paths:
                if path.endswith(f"/{PARENT_MARKER}"):
                    made = made_parents(self.files.cat_file(path))
                self.files.rm_file(path)
            if self.has_folders:
                with suppress(OSError, NotImplementedError):
                    self.files.rmdir(self.root)
                    for parent in self._parents()[:made]:
                        self.files.rmdir(parent)

    def tidy(self) -> None:
        """Delete temporary files and abort unfinished uploads of killed writers."""
        with self._reached(f"{self.label} cannot be tidied"):
            self._abort()
            for path in self._names((".tmp",)):
                self.files.rm_file(path)

    def _parents(self) -> list[str]:
        """Return the folders around the root, the nearest first."""
        around = map(str, PurePosixPath(self.root).parents)
        return [parent for parent in around if parent not in ("/", ".")]

    def _names(self, suffixes: tuple[str, ...]) -> list[str]:
        self.files.invalidate_cache()
        try:
            found = self.files.ls(self.root, detail=False)
        except FileNotFoundError:
            return []
        return [str(path) for path in found if str(path).endswith(suffixes)]

    def _abort(self) -> None:
        """Abort unfinished multipart uploads to S3: they are invisible, but cost money."""
        call = getattr(self.files, "call_s3", None)
        if call is None:
            return
        bucket, _, prefix = self.root.partition("/")
        with suppress(Exception):  # not every store supports listing, nor every key permits it
            found = call("list_multipart_uploads", Bucket=bucket, Prefix=f"{prefix}/")
            for each in found.get("Uploads", ()):
                given = {"Key": each["Key"], "UploadId": each["UploadId"]}
                call("abort_multipart_upload", Bucket=bucket, **given)

    @contextmanager
    def _reached(self, otherwise: str, *, missing: bool = False) -> Iterator[None]:
        """Turn any error of the store into an `OutputError` with a sentence.

        Stores raise errors of their own besides those of the system. They are not chained, because
        their texts may contain the secrets of the URL.

        Args:
            otherwise: What could not be done, as the beginning of the sentence.
            missing: Let `FileNotFoundError` pass, for callers that handle it.
        """
        try:
            yield
        except (NanogsError, MemoryError):
            raise
        except Exception as error:
            if missing and isinstance(error, FileNotFoundError):
                raise
            raise OutputError(f"{otherwise} ({reason_of(error, self._address)}).") from None


class _Ranges(io.RawIOBase):
    """A seekable file object for reading, each of whose reads is one request."""

    def __init__(self, scratch: UrlScratch, path: str, size: int) -> None:
        self.scratch, self.path, self.size, self.at = scratch, path, size, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self.at, io.SEEK_END: self.size}[whence]
        self.at = start + offset
        return self.at

    def read(self, size: int = -1, /) -> bytes:
        stop = self.size if size < 0 else min(self.at + size, self.size)
        data = self.scratch.read(self.path, self.at, stop) if stop > self.at else b""
        self.at += len(data)
        return data

    def readinto(self, buffer: Any, /) -> int:  # noqa: ANN401 - any buffer
        data = self.read(min(len(buffer), _RANGE))
        buffer[: len(data)] = data
        return len(data)
