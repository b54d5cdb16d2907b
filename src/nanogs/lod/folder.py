"""The sink for a folder of levels: one file per level, or chunks in one of their layouts."""

import hashlib
import json
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nanogs.block_layouts import BlockChunks
from nanogs.errors import FormatError
from nanogs.findings import join_findings
from nanogs.formatting import plain
from nanogs.io import registry, save
from nanogs.io.folder import atomic_folder, check_folder_writable, move_folder
from nanogs.io.format import FormatOptions
from nanogs.io.models import as_splats
from nanogs.lod import manifest, streamed_sog, tiles
from nanogs.lod.cells import Cells
from nanogs.lod.chunks import ChunkLayout, ChunkTree, plain_paths
from nanogs.lod.manifest import Manifest, describe_levels
from nanogs.progress import PartProgress, ignore_progress
from nanogs.report import SimplifyReport
from nanogs.sink import Environment, EnvironmentWritten, Judge, OpenSink, Written, refuse_large
from nanogs.source import Source
from nanogs.splats import Splats

if TYPE_CHECKING:
    from nanogs._types import Array

PLY = ".ply"


@dataclass(frozen=True, slots=True)
class LevelsFolder:
    """A sink that writes levels into a folder; see `sink.Sink`.

    Attributes:
        place: The folder to make.
        overwrite: Replace the folder if it holds nothing but earlier levels.
        source: Name of the model for the manifest.
        block_layout: The layout that divides levels into chunks; None for one file per level.
        suffix: Format of the files in a folder with one file per level.
        format_options: Options of that format, as `save` takes them.
        environment: The environment drawn with every level, for layouts that support one.
    """

    place: Path
    overwrite: bool
    source: str
    block_layout: ChunkLayout | None = None
    suffix: str = PLY
    format_options: FormatOptions | None = None
    environment: Environment | None = None

    def __post_init__(self) -> None:
        """Check that the format of files can be written, with these options.

        Raises:
            OptionError: It cannot.
        """
        registry.writer(Path(level_name(0, self.suffix)), self.format_options)

    def refuse_large(self, count: int, row: int, max_memory: int | None) -> None:
        """Refuse levels in files of their own that are too large to be held; see `Sink`."""
        if self.block_layout is None:
            place = self.place / level_name(0, self.suffix)
            remedy = "leave the format of the levels out, which is .ply then"
            refuse_large(place, count, row, max_memory, self.format_options, remedy)

    def check(self) -> None:
        """Check that the folder can be written; see `Sink`."""
        check_folder_writable(self.place, made_files, overwrite=self.overwrite)

    def open(self, making: Path, options: FormatOptions) -> "LevelsFilling":  # noqa: ARG002
        """Start filling an empty folder at `making`; see `Sink`."""
        shutil.rmtree(making, ignore_errors=True)
        making.mkdir()
        return self._filling(making)

    @contextmanager
    def filled(self) -> Iterator["LevelsFilling"]:
        """Fill a temporary folder in a `with` block, then move it to `place` if no error occurred.

        Raises:
            OutputError: The folder may not be replaced, or it cannot be written.
        """
        with atomic_folder(self.place, made_files, overwrite=self.overwrite) as making:
            yield self._filling(making)

    def _filling(self, making: Path) -> "LevelsFilling":
        if self.block_layout is None:
            return _Files(making, self.source, self.suffix, self.format_options)
        return ChunksFilling(making, self.source, self.block_layout, self.environment)

    def move(self, made: Path) -> None:
        """Move the finished folder to `place`; see `Sink`."""
        move_folder(made, self.place, made_files, overwrite=self.overwrite)

    def files(self, made: Path) -> Sequence[str]:
        """Return all files of the folder, that which describes them first; see `Sink`."""
        first = self.block_layout.name if self.block_layout else manifest.NAME
        return (first, *sorted((made_files(made) or frozenset()) - {first}))


class LevelsFilling(OpenSink):
    """The base of folders that are being filled, level by level."""

    def __init__(self, folder: Path, source: str) -> None:
        super().__init__()
        self._folder, self._source = folder, source

    def finish(self, reports: Sequence[SimplifyReport], judge: Judge | None = None) -> Manifest:
        """Write the file that describes the folder, and measure the quality of each level.

        Args:
            reports: The report of each level.
            judge: Measures levels; None to measure nothing.
        """
        raise NotImplementedError


class _Files(LevelsFilling):
    """A folder with one file per level, `level_0` and so on, and `levels.json`."""

    def __init__(
        self, folder: Path, source: str, suffix: str, format_options: FormatOptions | None
    ) -> None:
        super().__init__(folder, source)
        self._suffix, self._format_options = suffix, format_options

    def add(self, model: Splats | Source, on_progress: PartProgress = ignore_progress) -> None:
        on_progress(0, 1)
        path = self._folder / level_name(len(self.written), self._suffix)
        left_out = save(model, path, format_options=self._format_options)
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        size = path.stat().st_size
        self.written.append(Written(len(model), (path.name,), size, left_out, digest))

    def finish(self, reports: Sequence[SimplifyReport], judge: Judge | None = None) -> Manifest:
        names = [name for each in self.written for name in each.files]
        self.measure(judge, [(self._folder / name, 0) for name in names])
        made = describe_levels(self._source, reports, self.written)
        text = json.dumps(plain(made.to_dict()), indent=2, allow_nan=False)
        (self._folder / manifest.NAME).write_text(text + "\n", encoding="utf-8")
        return made


class ChunksFilling(LevelsFilling):
    """A folder with chunks of all levels, in one of their layouts.

    Attributes:
        names: Names of the files of each level, as paths from the folder.
        beside: Names of the files of the environment.
    """

    def __init__(
        self,
        folder: Path,
        source: str,
        layout: ChunkLayout,
        environment: Environment | None = None,
    ) -> None:
        super().__init__(folder, source)
        self._layout, self._environment = layout, environment
        self.beside: list[str] = []
        self._cells: list[Mapping[str, Array]] = []  # by block
        self._levels: list[list[list[Any]]] = []  # chunks by level and block
        self.names: list[list[str]] = []

    def add(self, model: Splats | Source, on_progress: PartProgress = ignore_progress) -> None:
        """Divide the next level into chunks and write them; see `OpenSink`."""
        splats, level = as_splats(model), len(self.written)
        cells = self._cells[0] if level else self._layout.divide(splats.means)
        finer = self._levels[-1][0] if level else None
        blocks = [(len(splats), cells)]
        self.add_blocks([self._layout.encode(splats, blocks, finer, f"{level}_", on_progress)])

    def add_blocks(self, blocks: Iterable[BlockChunks]) -> None:
        """Write the chunks of the next level, given block by block; see `OpenSink`."""
        names: list[str] = []
        cells, chunks, splats, size, left_out = [], [], 0, 0, []
        for block in blocks:
            for name, data in block.files:
                self._write(name, data)
                names.append(name)
                size += len(data)
            cells.append(block.cells)
            chunks.append(block.chunks)
            left_out.append(block.losses)
            splats += block.splats
        self._cells = self._cells or cells
        self._levels.append(chunks)
        self.names.append(names)
        # A model that is a folder is listed by its `meta.json` alone.
        named = [n for n in names if "/" not in n or n.endswith(f"/{registry.META}")]
        lost = join_findings(left_out)
        self.written.append(Written(splats, named, size, lost, requests=len(names)))

    def _write(self, name: str, data: bytes) -> None:
        if not plain_paths([name]):
            raise FormatError(f"{name!r} is not the name of a chunk; remove the job's folder.")
        path = self._folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(data)

    def finish(self, reports: Sequence[SimplifyReport], judge: Judge | None = None) -> Manifest:
        """Write the environment and the description, and measure levels; see `LevelsFilling`."""
        trees = [
            ChunkTree(Cells(**cells), [level[block] for level in self._levels])
            for block, cells in enumerate(self._cells)
            if cells
        ]
        path = self._folder / self._layout.name
        if self._environment is not None:
            self._write_environment(self._environment)
        counts = [each.splats for each in self.written]
        text = self._layout.describe(trees, counts, bool(self.beside))
        path.write_text(text, encoding="utf-8")
        levels = [(path, level) for level in range(len(self.written))]
        self.measure(judge, levels, self._layout.switch_pixel)
        return describe_levels(self._source, reports, self.written)

    def _write_environment(self, given: Environment) -> None:
        """Write the environment, and record it in the entry of each level."""
        splats, size = given.made(), 0
        lost = [f"The environment: {loss}" for loss in self._layout.losses(splats)]
        for name, data in self._layout.environment_files(splats).items():
            self._write(name, data)
            self.beside.append(name)
            size += len(data)
        moved = given.count if given.own else 0
        record = EnvironmentWritten(given.source, len(splats), size, len(self.beside), moved)
        self.written = [each._replace(environment=record) for each in self.written]
        # If it is a part of the model, the losses are already reported with the levels.
        notes = (*self.written[0].notes, *splats.notes, *(() if given.own else lost))
        self.written[0] = self.written[0]._replace(notes=tuple(map(str, notes)))


def level_name(level: int, suffix: str = PLY) -> str:
    """Return the file name of a level; 0 is the finest."""
    return f"level_{level}{suffix}"


def made_files(folder: Path) -> frozenset[str] | None:
    """Return the files of a folder made by `nanogs lod`, in any layout; None for other folders."""
    owners = (manifest.made_files, streamed_sog.made_files, tiles.made_files)
    known = [names for made in owners if (names := made(folder)) is not None]
    return frozenset[str]().union(*known) if known else None
