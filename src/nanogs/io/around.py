"""Sources around that of a file, of which they change one thing."""

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from weakref import finalize

from nanogs._types import I64
from nanogs.io.info import FileInfo
from nanogs.io.parts import FileSource
from nanogs.source import Layout, Source
from nanogs.splats import ExtraElement, Splats


class Around(FileSource):
    """All that a file is, through another source.

    Args:
        file: The file, which is closed with this.
    """

    def __init__(self, file: FileSource) -> None:
        super().__init__(file.path)
        self.file = file
        self.elements = file.elements

    @cached_property
    def info(self) -> FileInfo:
        """The file's description of itself."""
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
        """Splats of each level of detail; see `FileSource`."""
        return self.file.levels

    @property
    def frame(self) -> str:
        """The frame that the file states; see `FileSource`."""
        return self.file.frame

    @property
    def environment(self) -> int:
        """Splats that belong to all levels; see `FileSource`."""
        return self.file.environment

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on values that are read otherwise than the file says; see `FileSource`."""
        return self.file.remarks

    def _changed(self, splats: Splats) -> Splats:
        """Rows of the file as they are here."""
        return splats

    def _span(self, start: int, stop: int) -> Splats:
        """Some rows; see `Source`."""
        return self._changed(self.file.read(start, stop))

    def _take(self, rows: I64) -> Splats:
        """Rows by number; see `Source`."""
        return self._changed(self.file.take(rows))

    def read_elements(self) -> tuple[ExtraElement, ...]:
        """The further elements of the file; see `Source`."""
        return self.file.read_elements()

    def load(self) -> Splats:
        """The whole model."""
        return self._changed(self.file.load())

    def close(self) -> None:
        """Close the file."""
        self.file.close()


class Fetched(Around):
    """A temporary file that goes away when it is closed, or forgotten.

    Args:
        file: The file, which is closed with this.
        remove: Removes it; may be called twice.
    """

    def __init__(self, file: FileSource, remove: Callable[[], None]) -> None:
        super().__init__(file)
        self._remove = finalize(self, remove)

    def close(self) -> None:
        """Close the file, and remove it."""
        super().close()
        self._remove()


def file_of(source: Source) -> Source:
    """The file as it is, without what is around it; other sources as they are."""
    while isinstance(source, Around):
        source = source.file
    return source
