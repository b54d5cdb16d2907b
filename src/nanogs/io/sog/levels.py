"""Reading streamed SOG: a `lod-meta.json` over SOG models of several levels of detail.

Layout: https://github.com/playcanvas/splat-transform (MIT). `filenames` lists the `meta.json` of
each model, `lodLevels` says how many levels there are, 0 the finest, and the leaves of `tree` say
in `lods`, by level, which `count` rows from `offset` on of which `file` stand for their region.
Each level is the whole scene: levels are read one at a time and never put together.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nanogs.errors import FormatError, OptionError
from nanogs.formatting import counted
from nanogs.io.container import Folder
from nanogs.io.files import input_size
from nanogs.io.json_fields import integer, is_plain, parse, refused, rows, table
from nanogs.io.sog.meta import MAX_COUNT
from nanogs.splats import RenderMode

# Python takes up to 25 times a JSON text's size; a leaf has some 500 bytes for 10 K splats or more.
MAX_MANIFEST_BYTES = 8 << 20
_MAX_LEVELS = 64


@dataclass(frozen=True, slots=True)
class Piece:
    """Rows of one level in one model.

    Attributes:
        folder: The model's folder.
        name: Name of its `meta.json`, or of its `.sog`.
        spans: (offset, count) of runs of rows, ascending, without overlap.
    """

    folder: Path
    name: str
    spans: tuple[tuple[int, int], ...]

    @property
    def path(self) -> Path:
        """The model's file."""
        return self.folder / self.name

    @property
    def count(self) -> int:
        """Number of rows in all spans."""
        return sum(count for _, count in self.spans)


@dataclass(frozen=True, slots=True)
class Levels:
    """A checked `lod-meta.json`.

    Attributes:
        levels: Pieces by level, from the finest on.
        notes: What is not part of any level, for the user.
    """

    levels: tuple[tuple[Piece, ...], ...]
    notes: tuple[str, ...]

    def pieces(self, path: Path, level: int) -> tuple[Piece, ...]:
        """The pieces of one level of that file.

        Raises:
            OptionError: There is no such level.
            FormatError: It holds nothing.
        """
        if not 0 <= level < len(self.levels):
            raise OptionError(
                f"{path} has levels 0 to {len(self.levels) - 1}; level {level} is not among them."
            )
        if not self.levels[level]:
            raise refused(f"{path}, tree", f"holds nothing of level {level}")
        return self.levels[level]


def read_manifest(path: Path) -> Levels:
    """Read and check a `lod-meta.json`.

    Raises:
        FormatError: It is missing, damaged, or names a file outside its folder.
    """
    if input_size(path) > MAX_MANIFEST_BYTES:
        raise refused(str(path), "is too large for a manifest")
    data = parse(Folder(path.parent).read(path.name, MAX_MANIFEST_BYTES), str(path))
    if data.get("version", 1) != 1:
        raise refused(str(path), "is of a newer version than 1, which nanogs does not read")
    depth = integer(data.get("lodLevels"), f"{path}, lodLevels", 1, _MAX_LEVELS)
    names = rows(data.get("filenames"), f"{path}, filenames")
    if len(set(map(str, names))) < len(names):
        raise refused(f"{path}, filenames", "names a file twice")
    spans: list[dict[int, list[tuple[int, int]]]] = [{} for _ in range(depth)]
    for level, file, span in _leaves(data.get("tree"), depth, len(names), str(path)):
        spans[level].setdefault(file, []).append(span)
    if not spans[0]:
        raise refused(f"{path}, tree", "holds nothing of level 0")
    levels = [
        tuple(_piece(path, names[file], found[file]) for file in sorted(found)) for found in spans
    ]
    return Levels(tuple(levels), _notes(data.get("environment")))


def _notes(environment: object) -> tuple[str, ...]:
    if environment is None:
        return ()
    shown = str(environment)[:80]
    return (f"The environment, {shown!r}, is a model of its own and was left out.",)


def _leaves(
    tree: object, depth: int, files: int, where: str
) -> Iterator[tuple[int, int, tuple[int, int]]]:
    """(level, file, (offset, count)) of every entry of the tree."""
    where = f"{where}, tree"
    open_nodes = [table(tree, where)]
    while open_nodes:
        node = open_nodes.pop()
        children = rows(node.get("children") or [], f"{where}, children")
        open_nodes += [table(child, where) for child in reversed(children)]
        for key, given in table(node.get("lods") or {}, f"{where}, lods").items():
            level = integer(int(key) if key.isdecimal() else None, f"{where}, lods", 0, depth - 1)
            yield level, *_entry(table(given, f"{where}, lods"), files, f"{where}, lods")


def _entry(entry: dict[str, Any], files: int, where: str) -> tuple[int, tuple[int, int]]:
    file = integer(entry.get("file"), f"{where}.file", 0, files - 1)
    offset = integer(entry.get("offset"), f"{where}.offset", 0, MAX_COUNT)
    return file, (offset, integer(entry.get("count"), f"{where}.count", 0, MAX_COUNT))


def _piece(path: Path, name: object, spans: list[tuple[int, int]]) -> Piece:
    parts = name.split("/") if isinstance(name, str) else []
    if not parts or not all(map(is_plain, parts)):
        raise refused(f"{path}, filenames", "must name files below its own folder")
    ordered = sorted(span for span in spans if span[1])
    end = 0
    for offset, count in ordered:
        if offset < end:
            raise refused(f"{path}, tree", f"names rows of {name} twice in a level")
        end = offset + count
    return Piece(path.parent.joinpath(*parts[:-1]), parts[-1], tuple(ordered))


def check_rows(piece: Piece, available: int) -> None:
    """Compare the rows of a piece with those that its model has.

    Raises:
        FormatError: The model has fewer.
    """
    if any(offset + count > available for offset, count in piece.spans):
        raise FormatError(
            f"{piece.path} has {counted(available, 'splat')}, fewer than its lod-meta.json says;"
            " export or download the model again."
        )


def joined_notes(models: Sequence[Sequence[str]], notes: Sequence[str]) -> list[str]:
    """Join the notes of the models and of the manifest, each once."""
    return [*dict.fromkeys(note for model in models for note in model), *notes]


def common_mode(modes: set[RenderMode]) -> RenderMode:
    """The render mode that all models state; a scene cannot be drawn in two ways at once."""
    return modes.pop() if len(modes) == 1 else RenderMode.DEFAULT
