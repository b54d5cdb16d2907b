"""The input files of a job: what they were when it began, and whether they still are."""

from collections.abc import Sequence
from functools import cached_property
from os import fspath
from pathlib import Path
from typing import TYPE_CHECKING, Self

from nanogs.errors import FormatError
from nanogs.io import open as open_model
from nanogs.io.parts import FileSource, Packed, Whole
from nanogs.pipeline.settings import Access, InputFile
from nanogs.source import Layout, Source
from nanogs.splats import Splats

if TYPE_CHECKING:
    from nanogs.pipeline.unpack import Unpacked


def input_file(source: FileSource) -> InputFile:
    """A file as it is now.

    Raises:
        FormatError: It cannot be read.
    """
    where = source.path.absolute()  # and no link followed, whose target may have another suffix
    return InputFile(fspath(where), *_identity(source), source.count, access_of(source))


def access_of(source: FileSource) -> Access:
    """How rows of a file are come by."""
    if isinstance(source, Packed):
        return Access.PACKED
    return Access.WHOLE if isinstance(source, Whole) else Access.ROWS


def check_unchanged(file: InputFile) -> None:
    """Compare a file with what it was.

    Raises:
        FormatError: It has changed, or is gone.
    """
    open_unchanged(file).close()


def open_unchanged(file: InputFile) -> FileSource:
    """Open a file that is what it was.

    Raises:
        FormatError: It has changed, or is gone.
    """
    if not Path(file.path).exists():
        raise FormatError(
            f"{file.path} is not there; the caller and all workers must see the inputs under one"
            " name."
        )
    try:
        source = open_model(file.path)
        same = _identity(source) == (file.bytes, file.modified)
    except (OSError, FormatError):
        same = False
    if not same or access_of(source) is not file.access:
        raise FormatError(f"{file.path} has changed since the job began; begin it anew.")
    return source


def _identity(source: FileSource) -> tuple[int, int]:
    """Bytes of all files of a model, and when the last of them was modified, in nanoseconds."""
    found = [each.stat() for each in source.files]
    return sum(each.st_size for each in found), max(each.st_mtime_ns for each in found)


class Inputs:
    """The files of a job, each opened when rows of it are first read, and one at a time.

    Args:
        files: As they were when the job began.
        unpacked: Those of them that have been unpacked, if any.
    """

    def __init__(self, files: Sequence[InputFile], unpacked: "Unpacked | None") -> None:
        self.parts = [_Input(self, number, file) for number, file in enumerate(files)]
        self._files, self._unpacked = files, unpacked
        self._last: tuple[int, Source] | None = None
        self._read: set[int] = set()

    def of(self, number: int) -> Source:
        """The rows of a file.

        Raises:
            FormatError: It has changed since the job began, or cannot be read.
        """
        if self._last is None or self._last[0] != number:
            self.close()
            source = open_unchanged(self._files[number])
            if self._unpacked is not None:
                self._unpacked.give(number, source)
            self._last = number, source
            self._read.add(number)
        return self._last[1]

    def check(self) -> None:
        """Look whether the files that have been read are what they were.

        Raises:
            FormatError: One of them is not.
        """
        for number in self._read:
            check_unchanged(self._files[number])

    def close(self) -> None:
        """Close the file that is open."""
        if self._last is not None:
            self._last[1].close()
            self._last = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Input(Source):
    """One of the files."""

    def __init__(self, inputs: Inputs, number: int, file: InputFile) -> None:
        self._inputs, self._number = inputs, number
        self.name, self.count = file.path, file.splats

    @cached_property
    def columns(self) -> Layout:
        """The columns; see `Source`."""
        return self._inputs.of(self._number).columns

    def _span(self, start: int, stop: int) -> Splats:
        """Some rows; see `Source`."""
        return self._inputs.of(self._number).read(start, stop)
