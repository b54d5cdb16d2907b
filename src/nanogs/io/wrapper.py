"""Wrappers of a `FileSource` that change one thing about it."""

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from weakref import finalize

from nanogs._types import I64
from nanogs.io.info import FileInfo
from nanogs.io.parts import FileSource
from nanogs.source import Layout, Source
from nanogs.splats import ExtraElement, Splats


class SourceWrapper(FileSource):
    """Base class of the wrappers: forwards everything to the wrapped `FileSource`.

    Args:
        file: The source to wrap, which is closed with this one.
    """

    def __init__(self, file: FileSource) -> None:
        super().__init__(file.path)
        self.file = file
        self.elements = file.elements

    @cached_property
    def info(self) -> FileInfo:
        """The metadata of the file."""
        return self.file.info

    @cached_property
    def columns(self) -> Layout:
        """The file's columns."""
        return self.file.columns

    @property
    def files(self) -> Sequence[Path]:
        """All files of the model; see `FileSource`."""
        return self.file.files

    @property
    def levels(self) -> tuple[int, ...]:
        """Number of splats of each level of detail; see `FileSource`."""
        return self.file.levels

    @property
    def frame(self) -> str:
        """The coordinate frame that the file states; see `FileSource`."""
        return self.file.frame

    @property
    def environment(self) -> int:
        """Number of splats that belong to all levels; see `FileSource`."""
        return self.file.environment

    @property
    def packed(self) -> bool:
        """Whether this very file holds quantised values; see `FileSource`."""
        return self.file.packed

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on values that override those of the file; see `FileSource`."""
        return self.file.remarks

    def _changed(self, splats: Splats) -> Splats:
        """Apply the change to rows of the file; by default none."""
        return splats

    def _span(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop`; see `Source.read`."""
        return self._changed(self.file.read(start, stop))

    def _take(self, rows: I64) -> Splats:
        """Read rows by number; see `Source.take`."""
        return self._changed(self.file.take(rows))

    def read_elements(self) -> tuple[ExtraElement, ...]:
        """Read the further PLY elements of the file; see `Source.read_elements`."""
        return self.file.read_elements()

    def load(self) -> Splats:
        """Read the whole model."""
        return self._changed(self.file.load())

    def close(self) -> None:
        """Close the file."""
        self.file.close()


class Downloaded(SourceWrapper):
    """The source of a downloaded file, which is removed on close or garbage collection.

    Args:
        file: The source of the temporary file, which is closed with this one.
        remove: Removes the temporary file; must allow to be called twice.
    """

    def __init__(self, file: FileSource, remove: Callable[[], None]) -> None:
        super().__init__(file)
        self._remove = finalize(self, remove)

    def close(self) -> None:
        """Close the file and remove it."""
        super().close()
        self._remove()


def unwrapped(source: Source) -> Source:
    """Return the innermost wrapped file; other sources are returned unchanged."""
    while isinstance(source, SourceWrapper):
        source = source.file
    return source
