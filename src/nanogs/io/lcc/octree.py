"""Reading a level of `.lcc2` (XGRIDS): an octree whose nodes are `.sog` or `.spz` files.

Layout, as splat-transform reads it (https://github.com/playcanvas/splat-transform, MIT): a JSON
file, mostly called meta.lcc2, in which some programs leave commas behind last entries, and files
below its folder.

- `totalLevels` is the number of levels, and `splatType` the format of all files, ".sog" unless it
  is ".spz". `root` is the tree, and its `splatFiles` are the paths of the files.
- A node has `child`, a list of nodes or an object with them, and `data`, of which `3dgs` has the
  index of a file (`name`) and the number of the node's splats in it (`count`, which may be
  missing). Nodes may share a file. A child of the root is of the coarsest level, and its children
  are of the next finer one; the finest level is 0.
- `env` in the root's `data` has the index of the file with the environment, which may be missing.
- Older files have `total_splats`, `lod_3dgs_info` and `lod_level`, the number of levels; paths are
  in the root's `files`, with a slash before them and without the suffix `.sog`.

Each file is in the frame of the whole, z up, whatever frame its format has otherwise. A level is
read file by file, in the order of the list. The environment, which viewers draw with every level,
is read as the last rows of each.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from nanogs.errors import FormatError
from nanogs.formatting import counted
from nanogs.frames import TRAINED, change_frame
from nanogs.io.info import FileInfo
from nanogs.io.joined import JoinedPacked, joined_info
from nanogs.io.json_fields import integer, is_plain, read_json, refused, rows, table
from nanogs.io.lcc.header import FRAME, MAX_LEVELS
from nanogs.io.parts import ColumnReader, Packed, check_level
from nanogs.io.sog.meta import MAX_COUNT
from nanogs.io.sog.read import SogSource
from nanogs.io.spz.read import open_spz
from nanogs.paths import exists
from nanogs.slices import BLOCK_ROWS
from nanogs.splats import Splats

_MAX_JSON = 8 << 20  # parsed JSON takes up to 25 times the size of its text in memory
_OLD = {"total_splats", "lod_3dgs_info", "lod_level"}
_RECORDS = "Extension records of its .spz files were left out: {}."


@dataclass(frozen=True, slots=True)
class Part:
    """A file of the model.

    Attributes:
        path: The file.
        stated: Number of splats that the nodes state for it, or None.
    """

    path: Path
    stated: int | None


@dataclass(frozen=True, slots=True)
class Octree:
    """A checked `.lcc2`.

    Attributes:
        path: The JSON file.
        kind: Format of the files, ".sog" or ".spz".
        levels: The files of each level, the finest level first.
        environment: The file that belongs to every level, or None.
    """

    path: Path
    kind: str
    levels: tuple[tuple[Part, ...], ...]
    environment: Part | None

    def opened(self, part: Part) -> Packed:
        """Open a file of the model.

        Raises:
            FormatError: It is missing or damaged, or has another number of splats than stated.
        """
        source = SogSource(part.path) if self.kind == ".sog" else open_spz(part.path)
        if part.stated not in (None, source.count):
            raise FormatError(
                f"{part.path} has {counted(source.count, 'splat')}, but {self.path.name} says"
                f" {part.stated:,}; export or download the model again."
            )
        return source

    def count(self, part: Part) -> int:
        """Return the number of splats of a file, as stated or from its header."""
        return self.opened(part).count if part.stated is None else part.stated


def read_octree(path: Path) -> Octree:
    """Read and check a `.lcc2`.

    Raises:
        FormatError: It is missing, damaged, or names a file outside its folder.
    """
    data = read_json(path, _MAX_JSON, trailing_commas=True)
    root, old = table(data.get("root"), f"{path}, root"), data.keys() >= _OLD
    key = "lod_level" if old else "totalLevels"
    depth = integer(data.get(key), f"{path}, {key}", 1, MAX_LEVELS)
    kind = data.get("splatType", ".sog")
    if kind not in (".sog", ".spz"):
        raise refused(f"{path}, splatType", 'must be ".sog" or ".spz"')
    key = "files" if old else "splatFiles"
    where = f"{path}, root.{key}"
    files = [_file(path, name, where, old=old) for name in rows(root.get(key), where)]
    if not files or len(set(files)) < len(files):
        raise refused(where, "names a file twice" if files else "names no file")
    sky = _file_index(_data(root, "env", str(path)), len(files), f"{path}, root.data.env")
    counts = _counts(root, depth, len(files), str(path))
    levels = [
        tuple(Part(files[i], found[i]) for i in sorted(found) if i != sky and found[i] != 0)
        for found in counts
    ]
    environment = Part(files[sky], None) if sky is not None and exists(files[sky]) else None
    return Octree(path, kind, tuple(levels), environment)


def _file(path: Path, name: object, where: str, *, old: bool) -> Path:
    """Return the path of a file that the list names, which must be below the folder of `path`."""
    text = name.removeprefix("/") if isinstance(name, str) else ""
    parts = [part for part in text.split("/") if part != "."]
    if not parts or not all(map(is_plain, parts)):
        raise refused(where, "must name files below its own folder")
    file = path.parent.joinpath(*parts)
    return file.with_name(f"{file.name}.sog") if old and not file.name.endswith(".sog") else file


def _counts(
    root: dict[str, Any], depth: int, files: int, where: str
) -> list[dict[int, int | None]]:
    """Return the files of each level by index, with the number of splats that nodes state."""
    found: list[dict[int, int | None]] = [{} for _ in range(depth)]
    for below, node in _nodes(root, f"{where}, child"):
        data = _data(node, "3dgs", where)
        if (index := _file_index(data, files, f"{where}, 3dgs")) is None:
            continue
        if below > depth:
            raise refused(where, f"has splats below its {counted(depth, 'level')}")
        level, count = found[depth - below], data.get("count")
        if count is not None:
            count = integer(count, f"{where}, 3dgs.count", 0, MAX_COUNT)
        before = level.get(index, 0)
        level[index] = None if count is None or before is None else before + count
    return found


def _nodes(root: dict[str, Any], where: str) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield every node below the root, and how many steps below."""
    waiting = [(0, root)]
    while waiting:
        above, node = waiting.pop()
        children = node.get("child") or []
        children = list(children.values()) if isinstance(children, dict) else rows(children, where)
        found = [(above + 1, table(child, where)) for child in children]
        yield from found
        waiting += found


def _data(node: dict[str, Any], name: str, where: str) -> dict[str, Any]:
    """Return an entry of a node's `data`, empty if there is none."""
    return table(
        table(node.get("data") or {}, f"{where}, data").get(name) or {}, f"{where}, {name}"
    )


def _file_index(data: Mapping[str, Any], files: int, where: str) -> int | None:
    """Return the index of the file that an entry names; None for an empty entry."""
    return integer(data.get("name"), f"{where}.name", 0, files - 1) if data else None


def open_octree(path: Path, level: int = 0) -> "OctreeLevel":
    """Open a level of a `.lcc2`; 0 is the finest.

    Raises:
        OptionError: There is no such level.
        FormatError: A file is missing or damaged, they contradict each other, or the level is
            empty.
    """
    octree = read_octree(path)
    check_level(path, level, len(octree.levels))
    if not octree.levels[level]:
        raise refused(f"{path}, root", f"has no splats of level {level}")
    return OctreeLevel(octree, level)


class OctreeLevel(JoinedPacked):
    """The source of a level: the rows of its files, followed by those of the environment."""

    def __init__(self, octree: Octree, level: int) -> None:
        self._octree, self._level = octree, level
        super().__init__(octree.path, (model.count for model in self._models))

    @cached_property
    def _models(self) -> list[Packed]:
        octree = self._octree
        beside = [octree.environment] if octree.environment else []
        return [octree.opened(part) for part in (*octree.levels[self._level], *beside)]

    @cached_property
    def info(self) -> FileInfo:
        """The metadata of the level, joined from those of its files."""
        infos = [model.info for model in self._models]
        return replace(joined_info(self.path, "lcc2", infos, self.count), elements=())

    @property
    def files(self) -> Sequence[Path]:
        """The JSON file and all files of the level; see `FileSource`."""
        return (self.path, *(model.path for model in self._models))

    @property
    def levels(self) -> tuple[int, ...]:
        """Number of splats of each level, the environment included; see `FileSource`."""
        octree = self._octree
        return tuple(sum(map(octree.count, each)) + self.environment for each in octree.levels)

    @cached_property
    def environment(self) -> int:
        """Number of splats of the environment, which are in every level; see `FileSource`."""
        found = self._octree.environment
        return self._octree.count(found) if found else 0

    def decode(self, columns: ColumnReader, start: int, stop: int) -> Splats:
        """Decode rows `start` to `stop` and turn them; see `Packed.decode`."""
        splats = super().decode(columns, start, stop)
        for low in range(0, len(splats), BLOCK_ROWS):
            block = splats.span(low, low + BLOCK_ROWS)
            turned = change_frame(block, FRAME, TRAINED)
            for name in ("means", "quats", "log_scales", "sh"):
                getattr(block, name)[:] = getattr(turned, name)
        names = sorted({name for model in self._models for name, _ in model.info.elements})
        records = [_RECORDS.format(", ".join(names))] if names else []
        return replace(splats, notes=(*splats.notes, *records))
