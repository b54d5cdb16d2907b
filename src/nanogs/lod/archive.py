"""The sink for levels in one `.ssog` file: the folder of a streamed SOG as a zip archive."""

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
from nanogs.sink import Environment, InOneFile, Judge, made_beside

_PIECE = 1 << 22  # bytes


@dataclass(frozen=True, slots=True)
class LevelsArchive(InOneFile, LevelsFolder):
    """A sink that writes levels in chunks into one archive file, `place`; see `sink.Sink`."""

    def check(self) -> None:
        """Check that the file can be written; see `Sink`."""
        atomic.check_writable(self.place, overwrite=self.overwrite)

    def open(self, making: Path, options: FormatOptions) -> "ArchiveFilling":  # noqa: ARG002
        """Start filling an empty folder beside the file `making`; see `Sink`."""
        making.unlink(missing_ok=True)
        folder = making.with_name(f"{making.name}.folder")
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        assert self.block_layout is not None, "there are no others in an archive"  # noqa: S101
        return ArchiveFilling(folder, self.source, self.block_layout, making, self.environment)

    @contextmanager
    def filled(self) -> Iterator["ArchiveFilling"]:
        """Fill a temporary file in a `with` block, then move it to `place` if no error occurred.

        Raises:
            OutputError: The file may not be replaced, or it cannot be written.
        """
        with made_beside(self, ARCHIVE) as made:
            yield self.open(made, {})


class ArchiveFilling(ChunksFilling):
    """A folder of chunks that is being filled, and packed into one file at the end."""

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
        """Finish the folder, then pack it into the file and remove it; see `LevelsFilling`."""
        manifest = super().finish(reports, judge)
        coarse_first = [name for level in reversed(self.names) for name in level]
        write_archive(self._folder, [LEVELS, *self.beside, *coarse_first], self._made)
        shutil.rmtree(self._folder)
        return manifest


def write_archive(folder: Path, names: Sequence[str], path: Path) -> None:
    """Write files into a zip archive without compression; the same files give the same bytes.

    The description of the levels should come first, then the environment and the coarsest level, so
    that a viewer can show a first picture from the beginning of the file.

    Args:
        folder: The folder of the files.
        names: Paths in the folder, in the order in which they are written.
        path: The file to write.
    """
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name in names:
            entry = plain_entry(name)
            entry.file_size = (folder / name).stat().st_size
            with (folder / name).open("rb") as source, archive.open(entry, "w") as out:
                shutil.copyfileobj(source, out, _PIECE)
