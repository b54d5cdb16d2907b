"""Reading the input files of a job, and checking that they have not changed since it began."""

from collections.abc import Sequence
from functools import cached_property
from os import fspath
from pathlib import Path
from typing import TYPE_CHECKING, Self

from nanogs.errors import FormatError
from nanogs.io import open as open_model
from nanogs.io.parts import FileSource, Packed, Whole
from nanogs.pipeline.options.settings import Access, InputFile
from nanogs.source import Layout, Source
from nanogs.splats import Splats

if TYPE_CHECKING:
    from nanogs.pipeline.tasks.unpack import Unpacked


def input_file(source: FileSource) -> InputFile:
    """Describe an open file, to recognise it later.

    Raises:
        FormatError: It cannot be read.
    """
    where = source.path.absolute()  # not resolved: the target of a link may have another suffix
    return InputFile(fspath(where), *_identity(source), source.count, access_of(source))


def access_of(source: FileSource) -> Access:
    """Return how the rows of a file are read."""
    if isinstance(source, Packed):
        return Access.PACKED
    return Access.WHOLE if isinstance(source, Whole) else Access.ROWS


def check_unchanged(file: InputFile) -> None:
    """Raise if a file has changed since the job began.

    Raises:
        FormatError: It has changed, or is missing.
    """
    open_unchanged(file).close()


def open_unchanged(file: InputFile) -> FileSource:
    """Open a file, after checking that it has not changed since the job began.

    Raises:
        FormatError: It has changed, is missing, or cannot be read here.
    """
    if not Path(file.path).exists():
        raise FormatError(
            f"{file.path} was not found; the caller and all workers must see the inputs under the"
            " same path."
        )
    try:
        source = open_model(file.path)
        same = _identity(source) == (file.bytes, file.modified)
    except (OSError, FormatError) as error:
        raise FormatError(
            f"{file.path} has changed since the job began, or cannot be read here: {error}"
        ) from error
    if not same or access_of(source) is not file.access:
        raise FormatError(f"{file.path} has changed since the job began; begin it anew.")
    return source


def _identity(source: FileSource) -> tuple[int, int]:
    """Return total bytes and latest modification time (ns) of all files of a model."""
    found = [each.stat() for each in source.files]
    return sum(each.st_size for each in found), max(each.st_mtime_ns for each in found)


class Inputs:
    """The input files of a job, opened when rows are read; only one is open at a time.

    Args:
        files: The files as they were when the job began.
        unpacked: Unpacked columns of compressed files, if there are any.
    """

    def __init__(self, files: Sequence[InputFile], unpacked: "Unpacked | None") -> None:
        self.parts = [_Input(self, number, file) for number, file in enumerate(files)]
        self._files, self._unpacked = files, unpacked
        self._last: tuple[int, Source] | None = None
        self._read: set[int] = set()

    def of(self, number: int) -> Source:
        """Return the open source of a file; the one opened before is closed.

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
        """Check that the files read so far have not changed since the job began.

        Raises:
            FormatError: One of them has.
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
    """One file of `Inputs` as a source, which is opened when it is needed."""

    def __init__(self, inputs: Inputs, number: int, file: InputFile) -> None:
        self._inputs, self._number = inputs, number
        self.name, self.count = file.path, file.splats

    @cached_property
    def columns(self) -> Layout:
        """Columns of the file; see `Source`."""
        return self._inputs.of(self._number).columns

    def _span(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop`; see `Source`."""
        return self._inputs.of(self._number).read(start, stop)
