"""The sink of levels that become one file: `.ssog`, the folder of a streamed SOG as a zip."""

import shutil
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from nanogs.io import atomic
from nanogs.io.container import plain_entry
from nanogs.io.format import FormatOptions
from nanogs.io.registry import ARCHIVE, LEVELS
from nanogs.lod.chunks import ChunkLayout
from nanogs.lod.folder import ChunksFilling, LevelsFolder
from nanogs.lod.manifest import Manifest
from nanogs.report import SimplifyReport
from nanogs.sink import Environment, Judge, made_beside, move_file

_PIECE = 1 << 22  # bytes


@dataclass(frozen=True, slots=True)
class LevelsArchive(LevelsFolder):
    """A sink of levels in chunks; see `sink.Sink`. Its place is a file."""

    def check(self) -> None:
        """As `Sink` says."""
        atomic.check_writable(self.place, overwrite=self.overwrite)

    def open(self, making: Path, options: FormatOptions) -> "ArchiveFilling":  # noqa: ARG002
        """As `Sink` says."""
        making.unlink(missing_ok=True)
        folder = making.with_name(f"{making.name}.folder")
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        assert self.chunks is not None, "there are no others in an archive"  # noqa: S101
        return ArchiveFilling(folder, self.source, self.chunks, making, self.environment)

    @contextmanager
    def filled(self) -> Iterator["ArchiveFilling"]:
        """The sink opened beside its place, which it takes when the block ends without an error.

        Raises:
            OutputError: The file may not be replaced, or it cannot be written.
        """
        with made_beside(self, ARCHIVE) as made:
            yield self.open(made, {})

    def move(self, made: Path) -> None:
        """As `Sink` says."""
        self.check()
        move_file(made, self.place, overwrite=self.overwrite)

    def files(self, made: Path) -> Sequence[str]:  # noqa: ARG002 - it is one
        """As `Sink` says."""
        return (".",)


class ArchiveFilling(ChunksFilling):
    """A folder that is being filled, and put into one file at the end."""

    def __init__(
        self,
        folder: Path,
        source: str,
        layout: ChunkLayout,
        made: Path,
        environment: Environment | None = None,
    ) -> None:
        super().__init__(folder, source, layout, environment)
        self._made = made

    def finish(self, reports: Sequence[SimplifyReport], judge: Judge | None = None) -> Manifest:
        """As `LevelsFilling` says; the folder goes into the file, which is written last."""
        manifest = super().finish(reports, judge)
        coarse_first = [name for level in reversed(self.names) for name in level]
        write_archive(self._folder, [LEVELS, *self.beside, *coarse_first], self._made)
        shutil.rmtree(self._folder)
        return manifest


def write_archive(folder: Path, names: Sequence[str], path: Path) -> None:
    """Put files into a zip, not packed again, the same bytes at any time.

    What describes the levels comes first, the environment and the coarsest level after it, so that
    the beginning of the file is all that a first picture needs.

    Args:
        folder: Where they are.
        names: Paths in there, in the order in which they are written.
        path: The file to write.
    """
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name in names:
            entry = plain_entry(name)
            entry.file_size = (folder / name).stat().st_size
            with (folder / name).open("rb") as source, archive.open(entry, "w") as out:
                shutil.copyfileobj(source, out, _PIECE)
