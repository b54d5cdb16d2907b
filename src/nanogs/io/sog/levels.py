"""Reading streamed SOG: a manifest `lod-meta.json` of SOG models with several levels of detail.

Layout: https://github.com/playcanvas/splat-transform (MIT). `filenames` lists the `meta.json` of
each model and `lodLevels` is the number of levels, 0 the finest. Each leaf of `tree` is a region;
its `lods` give, for each level, the rows of the region: `count` rows of model `file` from `offset`
on. Each level is the whole scene, so levels are read one at a time and never joined. `environment`
names one more model, with the sky and everything far away: viewers draw all of it with every level,
and so it is read as the last rows of each.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from nanogs.errors import FormatError
from nanogs.formatting import counted
from nanogs.io.container import Bundle
from nanogs.io.files import input_size, reading
from nanogs.io.info import FileInfo
from nanogs.io.joined import JoinedPacked, joined_info
from nanogs.io.json_fields import integer, is_plain, parse, read_json, refused, rows, table
from nanogs.io.parts import check_level
from nanogs.io.registry import LEVELS, META
from nanogs.io.sog.meta import MAX_COUNT, is_manifest
from nanogs.io.sog.read import SogSource

# Parsed JSON takes up to 25 times the size of its text in memory; a leaf has some 500 bytes for
# 10 K splats or more.
MAX_MANIFEST_BYTES = 8 << 20
_DIGITS = 3  # most digits of the number of a level
_MAX_LEVELS = 64


@dataclass(frozen=True, slots=True)
class Piece:
    """The rows of one level that are stored in one SOG model.

    Attributes:
        folder: The folder of the file `name`.
        name: Name of the model's `meta.json` or `.sog`, or of the zip that contains the model.
        spans: (offset, count) of runs of rows, ascending, without overlap; None for all rows.
        inside: The model's folder in the zip, with a slash at its end.
    """

    folder: Path
    name: str
    spans: tuple[tuple[int, int], ...] | None
    inside: str = ""

    @property
    def path(self) -> Path:
        """The model's file."""
        return self.folder / self.name

    @property
    def count(self) -> int:
        """Number of rows in all spans; for a whole model the count of its `meta.json`.

        Raises:
            FormatError: The `meta.json` is missing or damaged.
        """
        if self.spans is None:
            return SogSource(self.path, None, self.inside).meta.count
        return sum(count for _, count in self.spans)


class Leaf(NamedTuple):
    """A region of the scene, a node of the tree.

    Attributes:
        bound: Its bounding box from the JSON, unchecked, because reading a level does not need it.
        entries: Its rows in each level: (level, number of the file, (offset, count)).
    """

    bound: object
    entries: tuple[tuple[int, int, tuple[int, int]], ...]


@dataclass(frozen=True, slots=True)
class Levels:
    """A checked `lod-meta.json`.

    Attributes:
        levels: The pieces of each level, the finest level first.
        environment: The model that belongs to every level, or None.
        leaves: The regions of the scene.
    """

    levels: tuple[tuple[Piece, ...], ...]
    environment: Piece | None
    leaves: tuple["Leaf", ...] = ()

    def pieces(self, path: Path, level: int) -> tuple[Piece, ...]:
        """Return the pieces of one level, that of the environment last; `path` is for messages.

        Raises:
            OptionError: There is no such level.
            FormatError: The level is empty.
        """
        check_level(path, level, len(self.levels))
        if not self.levels[level]:
            raise refused(f"{path}, tree", f"has no splats of level {level}")
        return (*self.levels[level], *([self.environment] if self.environment else ()))


def read_manifest(path: Path) -> Levels:
    """Read and check a `lod-meta.json`, or the one in a `.ssog`.

    Raises:
        FormatError: It is missing, damaged, or names a file outside its folder.
    """
    data = read_json(path, MAX_MANIFEST_BYTES) if is_manifest(path) else _archived(path)
    if data.get("version", 1) != 1:
        raise refused(str(path), "has a newer version than 1, which nanogs does not read")
    depth = integer(data.get("lodLevels"), f"{path}, lodLevels", 1, _MAX_LEVELS)
    names = rows(data.get("filenames"), f"{path}, filenames")
    if len(set(map(str, names))) < len(names):
        raise refused(f"{path}, filenames", "names a file twice")
    spans: list[dict[int, list[tuple[int, int]]]] = [{} for _ in range(depth)]
    leaves = tuple(_leaves(data.get("tree"), depth, len(names), str(path)))
    for leaf in leaves:
        for level, file, span in leaf.entries:
            spans[level].setdefault(file, []).append(span)
    if not spans[0]:
        raise refused(f"{path}, tree", "has no splats of level 0")
    levels = [
        tuple(_piece(path, names[file], found[file]) for file in sorted(found)) for found in spans
    ]
    return Levels(tuple(levels), _environment(path, data.get("environment"), names), leaves)


def _archived(path: Path) -> dict[str, Any]:
    """Parse the `lod-meta.json` in a zip."""
    input_size(path)  # refuses Git LFS pointers and web pages
    with reading(path) as file:
        bundle = Bundle(path, file)
        where = bundle.where(LEVELS)
        if bundle.size(LEVELS) > MAX_MANIFEST_BYTES:
            raise refused(where, "is too large for a description of levels")
        return parse(bundle.read(LEVELS, MAX_MANIFEST_BYTES), where)


def _environment(path: Path, name: object, names: Sequence[object]) -> Piece | None:
    """Return the model that belongs to every level, or None if there is none."""
    if name is None or name == "":  # viewers treat both as none
        return None
    if name in names:
        raise refused(
            f"{path}, environment", "is also a model of the levels, but must be another one"
        )
    return _piece(path, name, None, "environment")


def _leaves(tree: object, depth: int, files: int, where: str) -> Iterator[Leaf]:
    """Yield every node of the tree that has splats."""
    where = f"{where}, tree"
    open_nodes = [table(tree, where)]
    while open_nodes:
        node = open_nodes.pop()
        children = rows(node.get("children") or [], f"{where}, children")
        open_nodes += [table(child, where) for child in reversed(children)]
        entries = []
        for key, given in table(node.get("lods") or {}, f"{where}, lods").items():
            number = int(key) if key.isdecimal() and len(key) <= _DIGITS else None
            level = integer(number, f"{where}, lods", 0, depth - 1)
            entry = _entry(table(given, f"{where}, lods"), files, f"{where}, lods")
            entries.append((level, *entry))
        if entries:
            yield Leaf(node.get("bound"), tuple(entries))


def _entry(entry: dict[str, Any], files: int, where: str) -> tuple[int, tuple[int, int]]:
    file = integer(entry.get("file"), f"{where}.file", 0, files - 1)
    offset = integer(entry.get("offset"), f"{where}.offset", 0, MAX_COUNT)
    return file, (offset, integer(entry.get("count"), f"{where}.count", 0, MAX_COUNT))


def _piece(
    path: Path, name: object, spans: list[tuple[int, int]] | None, key: str = "filenames"
) -> Piece:
    """Make a piece of a model that the manifest names, with runs of its rows, or None for all."""
    parts = name.split("/") if isinstance(name, str) else []
    if not parts or not all(map(is_plain, parts)):
        raise refused(f"{path}, {key}", "must name files below its own folder")
    ordered = None if spans is None else _ordered(path, name, spans)
    if is_manifest(path):
        return Piece(path.parent.joinpath(*parts[:-1]), parts[-1], ordered)
    *folders, file = parts
    if file != META or not folders:
        raise refused(f"{path}, {key}", f"must name a {META} in a folder of the zip")
    return Piece(path.parent, path.name, ordered, "/".join(folders) + "/")


def _ordered(path: Path, name: object, spans: list[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    """Sort the non-empty runs of a level's rows in a model, and refuse runs that overlap."""
    ordered = sorted(span for span in spans if span[1])
    end = 0
    for offset, count in ordered:
        if offset < end:
            raise refused(f"{path}, tree", f"names rows of {name} twice in a level")
        end = offset + count
    return tuple(ordered)


def _opened(piece: Piece) -> SogSource:
    """Open the model of a piece, which must have all rows of the piece."""
    source = SogSource(piece.path, piece.spans, piece.inside)
    available = source.meta.count
    if any(offset + count > available for offset, count in piece.spans or ()):
        raise FormatError(
            f"{piece.path} has {counted(available, 'splat')}, fewer than its lod-meta.json says;"
            " export or download the model again."
        )
    return source


def open_level(path: Path, level: int = 0) -> "SogLevel":
    """Open a level of a `lod-meta.json`; 0 is the finest.

    Raises:
        OptionError: There is no such level.
        FormatError: A file is missing or damaged, or the manifest contradicts it.
    """
    manifest = read_manifest(path)
    return SogLevel(path, manifest, manifest.pieces(path, level))


class SogLevel(JoinedPacked):
    """A level of a streamed SOG: the rows of its models, one model after another."""

    def __init__(self, path: Path, manifest: Levels, pieces: Sequence[Piece]) -> None:
        super().__init__(path, (piece.count for piece in pieces))
        self._manifest, self._pieces = manifest, pieces

    @cached_property
    def _models(self) -> list[SogSource]:
        return [_opened(piece) for piece in self._pieces]

    @cached_property
    def info(self) -> FileInfo:
        """The metadata of the level, joined from those of its models."""
        models = [model.info for model in self._models]
        info = joined_info(self.path, "streamed sog", models, self.count)
        return info if is_manifest(self.path) else replace(info, file_bytes=input_size(self.path))

    @property
    def files(self) -> Sequence[Path]:
        """The manifest and all files of the level; see `FileSource`."""
        if not is_manifest(self.path):
            return (self.path,)
        models = (file for model in self._models for file in model.files)
        return tuple(dict.fromkeys((self.path, *models)))

    @property
    def levels(self) -> tuple[int, ...]:
        """Number of splats of each level, including the environment; see `FileSource`."""
        levels = self._manifest.levels
        return tuple(sum(piece.count for piece in each) + self.environment for each in levels)

    @cached_property
    def environment(self) -> int:
        """Number of splats that belong to every level; see `FileSource`."""
        found = self._manifest.environment
        return found.count if found else 0
