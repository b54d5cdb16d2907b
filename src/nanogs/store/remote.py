"""Intermediate files by URL, such as s3://bucket/job, through fsspec."""

import io
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, BinaryIO, cast

import numpy as np

from nanogs._types import Array
from nanogs.errors import NanogsError, OptionError, OutputError
from nanogs.store.scratch import MADE, SUFFIXES, write_hashed

# Stores of objects by name: they have no folders, and none is to be made or taken away, which for
# a name without slashes would be a bucket.
_STORES = frozenset({"s3", "s3a", "gs", "gcs", "abfs", "abfss", "az", "adl", "oss", "oci"})
_UPLOAD = 1 << 23  # bytes that are uploaded at a time, and held until then
_RANGE = 1 << 22  # bytes that are asked for at a time, which are held twice
_AT_ONCE = 8  # requests
_PROBE = "probe.tmp"


class UrlScratch:
    """A folder by URL; a file is there once its record is."""

    def __init__(self, url: str) -> None:
        try:
            import fsspec
        except ImportError:
            raise OptionError(f"{url} needs fsspec; install nanogs[cluster].") from None
        self.url = url.rstrip("/")
        try:
            self.files, self.root = _find(fsspec, self.url)
        except ImportError as error:
            reason = str(error).rstrip(".")
            raise OptionError(f"{url} needs a package of its own: {reason}.") from None
        except ValueError as error:
            reason = str(error).rstrip(".")
            raise OptionError(f"{url} cannot be reached ({reason}); name another place.") from None
        kind = self.url.partition("://")[0].rpartition("::")[2]
        self.has_folders = kind not in _STORES

    @property
    def place(self) -> str:
        """The folder or URL."""
        return self.url

    @property
    def at_once(self) -> int:
        """As `Scratch` says."""
        return _AT_ONCE

    def prepare(self) -> None:
        """As `Scratch` says; what is not allowed shows here, before anything is computed."""
        with self._reached(f"{self.url} cannot be written to"):
            if self.has_folders:
                new = not self.files.exists(self.root.rpartition("/")[0])
                self.files.makedirs(self.root, exist_ok=True)
                if new:
                    self.files.touch(f"{self.root}/{MADE}")
        self.write(_PROBE, [np.zeros(1, np.uint8)])
        with self.open(_PROBE) as file:
            file.read()
        with self._reached(f"Nothing can be deleted in {self.url}"):
            self.files.rm_file(f"{self.root}/{_PROBE}")

    def write(self, name: str, parts: Iterable[Array]) -> tuple[int, str]:
        """As `Scratch` says."""
        with self._reached(f"{self.url}/{name} cannot be written"):
            file = self.files.open(f"{self.root}/{name}", "wb", block_size=_UPLOAD)
            try:
                written = write_hashed(file, parts)
            except BaseException:
                with suppress(Exception):  # closed, it would appear as if it were whole
                    file.discard()
                raise
            file.close()
        return written

    def open(self, name: str, size: int | None = None) -> BinaryIO:
        """As `Scratch` says."""
        path = f"{self.root}/{name}"
        if size is None:
            with self._reached(f"{self.url}/{name} cannot be read"):
                self.files.invalidate_cache()  # others write too
                size = int(self.files.size(path))
        return cast("BinaryIO", _Ranges(self, path, size))

    def read(self, path: str, start: int, stop: int) -> bytes:
        """Bytes of a file, one request."""
        with self._reached(f"{path} cannot be read"):
            return bytes(self.files.cat_file(path, start=start, end=stop))

    def discard(self, beginnings: tuple[str, ...]) -> None:
        """As `Scratch` says."""
        with self._reached(f"Nothing can be deleted in {self.url}"):
            for path in self._names(SUFFIXES):
                if path.rpartition("/")[2].startswith(beginnings):
                    self.files.rm_file(path)

    def remove(self) -> None:
        """As `Scratch` says."""
        with self._reached(f"{self.url} cannot be emptied"):
            self._abort()
            paths = self._names(SUFFIXES)
            for path in paths:
                self.files.rm_file(path)
            if self.has_folders:
                with suppress(OSError, NotImplementedError):
                    self.files.rmdir(self.root)
                    if any(path.endswith(f"/{MADE}") for path in paths):
                        self.files.rmdir(self.root.rpartition("/")[0])

    def tidy(self) -> None:
        """As `Scratch` says."""
        with self._reached(f"{self.url} cannot be tidied"):
            self._abort()
            for path in self._names((".tmp",)):
                self.files.rm_file(path)

    def _names(self, suffixes: tuple[str, ...]) -> list[str]:
        self.files.invalidate_cache()
        try:
            found = self.files.ls(self.root, detail=False)
        except FileNotFoundError:
            return []
        return [str(path) for path in found if str(path).endswith(suffixes)]

    def _abort(self) -> None:
        """Give up uploads to S3 that were never ended: nobody sees them, and they are paid for."""
        call = getattr(self.files, "call_s3", None)
        if call is None:
            return
        bucket, _, prefix = self.root.partition("/")
        with suppress(Exception):  # not every store, nor every key, may list them
            found = call("list_multipart_uploads", Bucket=bucket, Prefix=f"{prefix}/")
            for each in found.get("Uploads", ()):
                given = {"Key": each["Key"], "UploadId": each["UploadId"]}
                call("abort_multipart_upload", Bucket=bucket, **given)

    @contextmanager
    def _reached(self, otherwise: str) -> Iterator[None]:
        """Say in a sentence what the store answers; that a file is missing goes through.

        Stores raise errors of their own besides those of the system.
        """
        try:
            yield
        except (NanogsError, MemoryError):
            raise
        except Exception as error:
            if isinstance(error, FileNotFoundError) and "read" in otherwise:
                raise
            text = str(error).strip().splitlines()
            reason = text[0].rstrip(".") if text else type(error).__name__
            raise OutputError(f"{otherwise} ({reason}).") from error


class _Ranges(io.RawIOBase):
    """A file to read and seek in, of which each read is one request."""

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

    def readinto(self, buffer: Any, /) -> int:  # noqa: ANN401 - whatever has bytes
        data = self.read(min(len(buffer), _RANGE))
        buffer[: len(data)] = data
        return len(data)


def _find(fsspec: Any, url: str) -> tuple[Any, str]:  # noqa: ANN401 - has no types
    files, root = fsspec.core.url_to_fs(url)
    return files, str(root)
