"""Downloading and uploading files: http(s) with the standard library, other URLs with fsspec."""

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from nanogs.errors import ExistsError, FormatError, NanogsError, OptionError, OutputError
from nanogs.formatting import bytes_text
from nanogs.io.temporary import temporary_file_error
from nanogs.io.urls import Address
from nanogs.progress import PartProgress

_BUCKETS = ("s3", "s3a")
_PIECE = 1 << 20  # bytes
_LONGEST = 300  # characters of a store's error message that are shown


def fetch(address: Address, target: Path, on_progress: PartProgress) -> None:
    """Download the file of a URL to a new file.

    Args:
        address: The URL.
        target: The file to create.
        on_progress: Progress callback: bytes that have arrived, and the total, which is estimated
            if unknown.

    Raises:
        FormatError: It cannot be read.
        OptionError: A package is missing, or there is no such kind of URL.
        OutputError: The disk has no room for it.
    """
    with _readable(address) as (file, size):
        free = shutil.disk_usage(target.parent).free
        if size is not None and size > free:
            raise OutputError(
                f"{address} has {bytes_text(size)}, but the folder for temporary files has only"
                f" {bytes_text(free)} free; free some space, or name another folder in TMPDIR."
            )
        done = 0
        on_progress(0, 1)
        with target.open("xb") as out:
            while data := file.read(_PIECE):
                _put(out, data, address)
                done += len(data)
                on_progress(done, size or 2 * done)


def check_absent(address: Address, *, overwrite: bool) -> None:
    """Refuse a URL that cannot be written to, or where a file exists that may not be replaced.

    Raises:
        OptionError: It is http(s), or has a query or fragment, which stores would treat as part of
            the name; a package is missing, or there is no such kind of URL.
        OutputError: A folder is there, a file exists and `overwrite` is off, or the store refuses.
    """
    if address.on_web:
        raise OptionError(
            f"{address}: nanogs cannot write to web servers; name a file, or an address such as"
            " s3://bucket/scene.sog."
        )
    if re.search(r"[?#]", address.url):
        raise OptionError(
            f"{address}: the address of an output cannot have a ? or #; leave it out with what"
            " follows it."
        )
    files, path = store_of(address)
    with _reached(address, "cannot be written", OutputError):
        files.invalidate_cache()
        there = bool(files.exists(path))
        folder = there and bool(files.isdir(path)) and not files.isfile(path)
    if folder:
        raise OutputError(f"{address} is a folder; name a file in it as the output.")
    if there and not overwrite:
        raise ExistsError(f"{address} exists already")
    if address.kind in _BUCKETS:
        with _reached(address, "cannot be written", OutputError):
            _try_to_write(files, path)


def _try_to_write(files: Any, path: str) -> None:  # noqa: ANN401 - has no types
    """Start the upload of one byte and abort it, to find out whether a bucket can be written to.

    Nothing is created, and an existing file is not changed.
    """
    with suppress(_GivenUp), files.transaction:
        with files.open(path, "wb") as file:
            file.write(bytes(1))
        raise _GivenUp


class _GivenUp(Exception):  # noqa: N818 - not an error
    """Raised to abort a transaction, so that its files are discarded."""


def upload(made: Path, address: Address, on_progress: PartProgress, *, overwrite: bool) -> None:
    """Upload a file to a URL, where it appears whole or not at all.

    Args:
        made: The file.
        address: The URL.
        on_progress: Progress callback: bytes that have been sent, and the total.
        overwrite: Replace a file that exists there.

    Raises:
        OptionError: As for `check_absent`.
        OutputError: As for `check_absent`.
    """
    check_absent(address, overwrite=overwrite)  # again: minutes may have passed
    files, path = store_of(address)
    size, done = made.stat().st_size, 0
    # The files of a transaction appear when it ends, and are discarded if it fails.
    with (
        _reached(address, "cannot be written", OutputError),
        files.transaction,
        made.open("rb") as source,
        _sent(files, path) as target,
    ):
        on_progress(0, 1)
        while data := source.read(_PIECE):
            target.write(data)
            done += len(data)
            on_progress(done, size)


@contextmanager
def _sent(files: Any, path: str) -> Iterator[Any]:  # noqa: ANN401 - has no types
    """Open a file of a store for writing; on failure discard it: closing would publish a part."""
    target = files.open(path, "wb")
    try:
        yield target
    except BaseException:
        with suppress(Exception):
            target.discard()
        with suppress(Exception):
            target.closed = True  # or garbage collection would close it
        raise
    target.close()


@contextmanager
def _readable(address: Address) -> Iterator[tuple[IO[bytes], int | None]]:
    if address.on_web:
        from nanogs.io import web  # slow to import, and not needed by most runs

        with web.opened(address) as opened:
            yield opened
        return
    files, path = store_of(address)
    with _reached(address, "cannot be read", FormatError):
        files.invalidate_cache()
        if files.isdir(path) and not files.isfile(path):
            raise FormatError(f"{address} is a folder; name the model file inside it.")
        size = files.size(path)
        with files.open(path, "rb") as file:
            yield file, size


def store_of(address: Address) -> tuple[Any, str]:
    """Return the fsspec file system of a URL, and the path in it.

    Raises:
        OptionError: A package is missing, there is no such kind of URL, or it cannot be reached.
    """
    try:
        import fsspec
    except ImportError:
        extra = "s3" if address.kind in _BUCKETS else "urls"
        raise OptionError(
            f'{address}: {address.kind}:// needs fsspec: pip install "nanogs[{extra}]".'
        ) from None
    try:
        files, path = fsspec.core.url_to_fs(address.url)
    except ImportError as error:
        if address.kind in _BUCKETS:
            raise OptionError(f'{address} needs s3fs: pip install "nanogs[s3]".') from None
        reason = reason_of(error, address)
        raise OptionError(f"{address} needs another package: {reason}.") from None
    except Exception as error:
        reason = reason_of(error, address)
        raise OptionError(f"{address} cannot be reached ({reason}); check the address.") from None
    return files, str(path)


@contextmanager
def _reached(address: Address, fact: str, kind: type[NanogsError]) -> Iterator[None]:
    """Convert the errors of a store, which are of any type, to errors of nanogs.

    The original is not chained, because its text may contain the secrets of the URL.
    """
    try:
        yield
    except (NanogsError, MemoryError):
        raise
    except FileNotFoundError:
        what = "there is no such file" if kind is FormatError else "there is no such place"
        raise kind(f"{address}: {what}; check the address.") from None
    except Exception as error:
        reason = reason_of(error, address)
        remedy = "check the address and your permissions"
        raise kind(f"{address} {fact} ({reason}); {remedy}.") from None


def _put(out: IO[bytes], data: bytes, address: Address) -> None:
    try:
        out.write(data)
        out.flush()  # or a full disk would only raise when the file is closed
    except OSError as error:
        raise temporary_file_error(f"{address} cannot be put", error) from None


def reason_of(error: Exception, address: Address) -> str:
    """Return the message of an error of a store in one line, without the secrets of the URL."""
    text = " ".join(address.said(str(error)).split())[:_LONGEST]
    return text.rstrip(".") or type(error).__name__
