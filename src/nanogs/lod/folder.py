"""The sink of levels: a folder with a file a level, or with chunks in one of their layouts."""

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
from nanogs.io import losses, registry, save
from nanogs.io.folder import atomic_folder, check_folder_writable, move_folder
from nanogs.io.format import FormatOptions
from nanogs.io.models import as_splats
from nanogs.lod import manifest, streamed_sog, tiles
from nanogs.lod.cells import Cells
from nanogs.lod.chunks import ChunkLayout, ChunkTree, plain_paths
from nanogs.lod.manifest import Manifest, describe_levels
from nanogs.progress import Parts, untold
from nanogs.report import SimplifyReport
from nanogs.sink import Environment, Filling, Judge, Written, refuse_large
from nanogs.source import Source
from nanogs.splats import Splats

if TYPE_CHECKING:
    from nanogs._types import Array

PLY = ".ply"


@dataclass(frozen=True, slots=True)
class LevelsFolder:
    """A sink of levels; see `sink.Sink`.

    Attributes:
        place: The folder to make.
        overwrite: Replace the folder if it holds nothing but earlier levels.
        source: Name of the model for the manifest.
        chunks: How levels are divided; None for files of their own.
        suffix: Format of such files.
        format_options: Of that format, as `save` takes them.
        environment: What belongs to every level beside them, for layouts that have a place for it.
    """

    place: Path
    overwrite: bool
    source: str
    chunks: ChunkLayout | None = None
    suffix: str = PLY
    format_options: FormatOptions | None = None
    environment: Environment | None = None

    def __post_init__(self) -> None:
        """Refuse a format of files that is not written.

        Raises:
            OptionError: It is not.
        """
        registry.writer(Path(level_name(0, self.suffix)))

    def refuse_large(self, count: int, row: int, max_memory: int | None) -> None:
        """As `Sink` says."""
        if self.chunks is None:
            refuse_large(self.place / level_name(0, self.suffix), count, row, max_memory)

    def check(self) -> None:
        """As `Sink` says."""
        check_folder_writable(self.place, made_files, overwrite=self.overwrite)

    def open(self, making: Path, options: FormatOptions) -> "LevelsFilling":  # noqa: ARG002
        """As `Sink` says."""
        shutil.rmtree(making, ignore_errors=True)
        making.mkdir()
        return self._filling(making)

    @contextmanager
    def filled(self) -> Iterator["LevelsFilling"]:
        """The sink opened beside its place, which it takes when the block ends without an error.

        Raises:
            OutputError: The folder may not be replaced, or it cannot be written.
        """
        with atomic_folder(self.place, made_files, overwrite=self.overwrite) as making:
            yield self._filling(making)

    def _filling(self, making: Path) -> "LevelsFilling":
        if self.chunks is None:
            return _Files(making, self.source, self.suffix, self.format_options)
        return ChunksFilling(making, self.source, self.chunks, self.environment)

    def move(self, made: Path) -> None:
        """As `Sink` says."""
        move_folder(made, self.place, made_files, overwrite=self.overwrite)

    def files(self, made: Path) -> Sequence[str]:
        """As `Sink` says."""
        first = self.chunks.name if self.chunks else manifest.NAME
        return (first, *sorted((made_files(made) or frozenset()) - {first}))


class LevelsFilling(Filling):
    """A folder that is being filled, level by level."""

    def __init__(self, folder: Path, source: str) -> None:
        super().__init__()
        self._folder, self._source = folder, source

    def finish(self, reports: Sequence[SimplifyReport], judge: Judge | None = None) -> Manifest:
        """Write what describes the folder, and measure each level.

        Args:
            reports: Of each level.
            judge: Measures levels.
        """
        raise NotImplementedError


class _Files(LevelsFilling):
    """A file a level, `level_0` and so on, and `levels.json`."""

    def __init__(
        self, folder: Path, source: str, suffix: str, format_options: FormatOptions | None
    ) -> None:
        super().__init__(folder, source)
        self._suffix, self._format_options = suffix, format_options

    def add(self, model: Splats | Source, tell: Parts = untold) -> None:
        tell(0, 1)
        path = self._folder / level_name(len(self.written), self._suffix)
        save(model, path, format_options=self._format_options)
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        size, left_out = path.stat().st_size, losses(model, path)
        self.written.append(Written(len(model), (path.name,), size, left_out, digest))

    def finish(self, reports: Sequence[SimplifyReport], judge: Judge | None = None) -> Manifest:
        names = [name for each in self.written for name in each.files]
        self.measure(judge, [(self._folder / name, 0) for name in names])
        made = describe_levels(self._source, reports, self.written)
        text = json.dumps(made.to_dict(), indent=2, allow_nan=False)
        (self._folder / manifest.NAME).write_text(text + "\n", encoding="utf-8")
        return made


class ChunksFilling(LevelsFilling):
    """Chunks of all levels, in one of their layouts.

    Attributes:
        names: Of the files of each level, as paths from the folder.
        beside: Of those of the environment.
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
        self._cells: list[Mapping[str, Array]] = []  # of each block
        self._levels: list[list[list[Any]]] = []  # chunks of each block of each level
        self.names: list[list[str]] = []  # of the files of each level

    def add(self, model: Splats | Source, tell: Parts = untold) -> None:
        """As `Filling` says."""
        splats, level = as_splats(model), len(self.written)
        cells = self._cells[0] if level else self._layout.divide(splats.means)
        finer = self._levels[-1][0] if level else None
        blocks = [(len(splats), cells)]
        self.add_blocks([self._layout.encode(splats, blocks, finer, f"{level}_", tell)])

    def add_blocks(self, blocks: Iterable[BlockChunks]) -> None:
        """As `Filling` says."""
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
        # A model in a folder of its own is named by what describes it.
        named = [n for n in names if "/" not in n or n.endswith(f"/{streamed_sog.META}")]
        lost = join_findings(left_out)
        self.written.append(Written(splats, named, size, lost, requests=len(names)))

    def _write(self, name: str, data: bytes) -> None:
        if not plain_paths([name]):
            raise FormatError(f"{name!r} is no name of a chunk; remove the folder of the job.")
        path = self._folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(data)

    def finish(self, reports: Sequence[SimplifyReport], judge: Judge | None = None) -> Manifest:
        """As `LevelsFilling` says."""
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
        """Write the model that belongs to every level, and note it with each."""
        splats, size = given.made(), 0
        lost = [f"The environment: {loss}" for loss in self._layout.losses(splats)]
        for name, data in self._layout.environment_files(splats).items():
            self._write(name, data)
            self.beside.append(name)
            size += len(data)
        taken = given.count if given.own else 0
        noted = given.source, len(splats), size, len(self.beside), taken
        self.written = [each._replace(environment=noted) for each in self.written]
        # Of a part of the model, its levels say what is left out.
        notes = (*self.written[0].notes, *splats.notes, *(() if given.own else lost))
        self.written[0] = self.written[0]._replace(notes=tuple(map(str, notes)))


def level_name(level: int, suffix: str = PLY) -> str:
    """The file of a level; 0 is the finest."""
    return f"level_{level}{suffix}"


def made_files(folder: Path) -> frozenset[str] | None:
    """The files of a folder that `nanogs lod` made, in any layout; None for other folders."""
    owners = (manifest.made_files, streamed_sog.made_files, tiles.made_files)
    known = [names for made in owners if (names := made(folder)) is not None]
    return frozenset[str]().union(*known) if known else None
