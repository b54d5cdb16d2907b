"""A folder of levels put together from the files of a job, in the job's folder, and then renamed.

A run that is killed between any two of its steps begins to put together anew, or finds that the
folder has got its name.
"""

import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nanogs.errors import FormatError
from nanogs.io.atomic import atomic_write, output_error
from nanogs.io.folder import check_folder_writable, move_folder
from nanogs.lod import streamed_sog, tiles
from nanogs.lod.chunks import plain_paths
from nanogs.lod.file_levels import level_name
from nanogs.lod.layout import NAMES, Layout, made_files
from nanogs.lod.manifest import NAME as MANIFEST
from nanogs.lod.tileset import Tile, Tree, describe
from nanogs.pipeline.chunked import places_of, read_cells, tiles_of
from nanogs.pipeline.folder import RESULT, refuse_finished
from nanogs.pipeline.result import write_result
from nanogs.pipeline.run import Done
from nanogs.pipeline.work import Work
from nanogs.progress import Tracker
from nanogs.store.tables import Record, Table

_FOLDER = f"{RESULT}levels"


@dataclass(frozen=True, slots=True)
class LevelsFolder:
    """The ending of a job that makes levels.

    Attributes:
        folder: The folder to make.
        layout: How the levels lie in it.
        describe: Writes what describes plain levels into a folder that holds them, given what was
            done and the splats of each.
        overwrite: Replace the folder if it holds nothing but earlier levels.
    """

    folder: Path
    layout: Layout
    describe: Callable[[Done, list[int], Path], None]
    overwrite: bool

    def check(self, folder: Path, *, resume: bool) -> None:
        """As `Ending` says."""
        if resume and not self.overwrite:
            refuse_finished(folder, self.folder)
        check_folder_writable(self.folder, made_files, overwrite=self.overwrite)

    def check_begun(self, folder: Path) -> None:
        """As `Ending` says."""
        if self._placed(folder / f"{_FOLDER}.json") is None:
            check_folder_writable(self.folder, made_files, overwrite=self.overwrite)

    def finish(self, done: Done, folder: Path, progress: Tracker) -> list[int]:
        """As `Ending` says."""
        note, making = folder / f"{_FOLDER}.json", folder / _FOLDER
        counts = self._placed(note)
        if counts is not None:
            return counts
        try:
            shutil.rmtree(making, ignore_errors=True)
            making.mkdir()
            counts = self._fill(done, making, progress)
            files = {name: (making / name).stat().st_size for name in made_files(making) or ()}
        except OSError as error:
            raise output_error(making, error) from error
        text = json.dumps({"counts": counts, "files": files, "sha256": self._digest(making)})
        with atomic_write(note, overwrite=True) as file:
            file.write(text.encode())
        move_folder(making, self.folder, made_files, overwrite=self.overwrite)
        return counts

    def _fill(self, done: Done, making: Path, progress: Tracker) -> list[int]:
        if self.layout is Layout.FILES:
            counts = _fill_plain(done.work, making, progress)
            self.describe(done, counts, making)
            return counts
        fill = _fill_sog if self.layout is Layout.SOG else _fill_tiles
        fill(done.work, making, progress)
        return [splats_of_level(done.work, n) for n in range(done.work.settings.levels)]

    def _placed(self, note: Path) -> list[int] | None:
        """The splats of each level, if the folder that the note is about has got its name."""
        with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
            known = json.loads(note.read_bytes())
            there = ((self.folder / n).stat().st_size == size for n, size in known["files"].items())
            if all(there) and self._digest(self.folder) == known["sha256"]:
                return [int(count) for count in known["counts"]]
        return None

    def _digest(self, folder: Path) -> str:
        """SHA-256 of what describes the levels in a folder."""
        name = NAMES.get(self.layout, MANIFEST)
        return hashlib.sha256((folder / name).read_bytes()).hexdigest()


def splats_of_level(work: Work, level: int) -> int:
    """Splats in all chunks of a level."""
    return sum(int(record.facts["splats"]) for record in work.of_blocks("chunk", level))


def _fill_plain(work: Work, making: Path, progress: Tracker) -> list[int]:
    counts = []
    for level in range(work.settings.levels):
        progress.part(level, work.settings.levels)
        target = int(work.of_job("budget", level).facts["target"])
        counts.append(write_result(work, level, making / level_name(level), target))
    return counts


def _fill_sog(work: Work, making: Path, progress: Tracker) -> None:
    trees = [
        streamed_sog.Tree(found[0]) if found else None
        for found in (read_cells(work.scratch, each) for each in work.of_blocks("cells"))
    ]
    names: list[str] = []
    for level, block, record in _copied(work, making, progress):
        for folder, places in places_of(record):
            tree = trees[block]
            assert tree is not None, "only a block with cells has models"  # noqa: S101
            tree.add(level, len(names), places)
            names.append(f"{folder}/{streamed_sog.META}")
    counts = [splats_of_level(work, level) for level in range(work.settings.levels)]
    full = [tree for tree in trees if tree]
    text = streamed_sog.describe(full, names, counts, work.settings.chunked.most)
    (making / streamed_sog.NAME).write_text(text, encoding="utf-8")


def _fill_tiles(work: Work, making: Path, progress: Tracker) -> None:
    made: list[list[dict[int, Tile]]] = [[] for _ in range(work.settings.levels)]
    for level, _, record in _copied(work, making, progress):
        made[level].append(tiles_of(record))
    levels = [_with_widths(level) for level in made]
    trees = []
    for block, record in enumerate(work.of_blocks("cells")):
        if found := read_cells(work.scratch, record):
            trees.append(Tree(found[0], [level[block] for level in levels]))
    text = describe(trees, tiles.form_of(plain=not work.settings.chunked.spz).extensions)
    (making / tiles.NAME).write_text(text, encoding="utf-8")


def _with_widths(level: list[dict[int, Tile]]) -> list[dict[int, Tile]]:
    """The tiles of all blocks at a level; empty ones get the typical width of the others."""
    widths = [tile.width for each in level for tile in each.values() if tile.content]
    typical = float(np.median(widths))
    return [
        {node: t if t.content else replace(t, width=typical) for node, t in each.items()}
        for each in level
    ]


def _copied(work: Work, making: Path, progress: Tracker) -> Iterator[tuple[int, int, Record]]:
    """Level and block of each table of files, which are written into the folder one at a time."""
    levels, blocks = work.settings.levels, work.partition.blocks
    for level in range(levels):
        for block, record in enumerate(work.of_blocks("chunk", level)):
            progress.part(level * blocks + block, levels * blocks)
            _copy(work, record, making)
            yield level, block, record


def _copy(work: Work, record: Record, making: Path) -> None:
    if not record.columns:
        return
    with Table(work.scratch, record) as table:
        for name in record.columns:
            if not plain_paths([name]):
                raise FormatError(f"{record.name} of the job names {name!r}; remove the folder.")
            path = making / name
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(table.read(name).data)
