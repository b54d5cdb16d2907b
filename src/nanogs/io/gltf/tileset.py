"""Reading 3D Tiles: a `tileset.json` that refers to glTF files with splats.

Specification: https://docs.ogc.org/cs/22-025r4/22-025r4.html. Tiles form a tree. With `REPLACE`, a
tile's children replace it by finer content; with `ADD`, they are drawn in addition to it. A level
is the whole scene as drawn by a viewer that descends to a limited depth: level 0 descends to the
leaves, level 1 one step less, and so on up to the first tiles with contents. A tile without content
is represented by its descendants, except in tilesets that nanogs wrote: there all tiles of a level
have the same depth, and one without content has no splat of this level.

The tileset's frame is z up. Transforms of tiles are applied, except one with a far translation,
which places the scene on Earth, at coordinates where single precision is coarser than a splat. The
model is read in the local frame of that place, and a note gives the place.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from nanogs._types import F64
from nanogs.errors import FormatError
from nanogs.findings import join_findings
from nanogs.io.generator import read_own
from nanogs.io.gltf import read as gltf
from nanogs.io.gltf.scene import Z_UP
from nanogs.io.info import FileInfo
from nanogs.io.joined import common_mode, joined_info, mode_notes
from nanogs.io.json_fields import numbers, read_json, referenced_path, refused, rows, table
from nanogs.io.parts import FileSource, Whole, check_level, level_note
from nanogs.place import text_of
from nanogs.source import joined_rows
from nanogs.splats import Splats

MAX_BYTES = 8 << 20  # of a tileset.json; a tile takes some 300 bytes for 10 K splats or more
_MAX_TILESETS = 1000
_IDENTITY = np.eye(4)
# Distance in scene units from the origin at which float32 has steps of a hundredth of a unit.
_FAR = 1e5


@dataclass(frozen=True, slots=True)
class _Tile:
    """A tile, reduced to the fields that reading splats needs.

    Attributes:
        depth: Number of steps from the root.
        contents: Its glTF files.
        above: (4, 4) float64: transform from the frame of the contents to that of the tileset, both
            y up.
        adds: Whether it is still drawn when its children are (`ADD`).
        children: The tiles below it.
    """

    depth: int
    contents: tuple[Path, ...]
    above: F64
    adds: bool
    children: tuple["_Tile", ...]


@dataclass(frozen=True, slots=True)
class _Tileset:
    """A tree of tiles, with notes about reading it.

    Attributes:
        path: The `tileset.json`.
        root: The root of the tree.
        own: Whether nanogs wrote it.
        notes: Notes about reading it.
    """

    path: Path
    root: _Tile
    own: bool
    notes: tuple[str, ...]

    def levels(self) -> int:
        """Return the number of levels; at least one tile must have contents."""
        depths = [tile.depth for tile in _all(self.root) if tile.contents]
        if not depths:
            raise FormatError(f"{self.path} names no content; export the tileset again.")
        return max(depths) - min(depths) + 1

    def level(self, number: int) -> list[_Tile]:
        """Return the tiles with contents of a level, in the order of the file.

        Raises:
            OptionError: There is no such level.
        """
        check_level(self.path, number, self.levels())
        deepest = max(tile.depth for tile in _all(self.root) if tile.contents)
        return list(_drawn(self.root, deepest - number, empty=self.own))


def open_level(path: Path, level: int = 0) -> "TilesLevel":
    """Open a level of a `tileset.json`; 0 is the finest.

    Raises:
        OptionError: There is no such level.
        FormatError: A file is missing or damaged, holds no splats, or lies outside of the folder.
    """
    tileset = _read(path)
    return TilesLevel(tileset, level, tileset.level(level))


class TilesLevel(Whole):
    """A source of all splats of a level, in the order of its tiles."""

    def __init__(self, tileset: _Tileset, level: int, tiles: list[_Tile]) -> None:
        super().__init__(tileset.path)
        self._tileset, self._level, self._tiles = tileset, level, tiles
        self._opened: dict[Path, FileSource] = {}

    def _content(self, file: Path) -> FileSource:
        """Open a content to describe it; only `load` knows the transform of its tile."""
        if file not in self._opened:
            self._opened[file] = gltf.open_gltf(file)
        return self._opened[file]

    @property
    def files(self) -> Sequence[Path]:
        """The `tileset.json` and the files of the level's contents; see `FileSource`."""
        contents = [file for tile in self._tiles for file in tile.contents]
        return [self.path, *(each for file in contents for each in self._content(file).files)]

    @property
    def levels(self) -> tuple[int, ...]:
        """Number of splats of each level, from the headers of the contents; see `FileSource`."""
        tileset = self._tileset
        every = {file for tile in _all(tileset.root) for file in tile.contents}
        counts = {file: self._content(file).count for file in every}
        drawn = (tileset.level(number) for number in range(tileset.levels()))
        return tuple(sum(counts[f] for tile in level for f in tile.contents) for level in drawn)

    @property
    def packed(self) -> bool:
        """Whether some of its contents are packed as SPZ; see `FileSource`."""
        return any(self._content(file).packed for tile in self._tiles for file in tile.contents)

    @cached_property
    def info(self) -> FileInfo:
        """The description of the level, combined from those of the contents."""
        infos = [self._content(file).info for tile in self._tiles for file in tile.contents]
        return joined_info(self.path, "3d tiles", infos, sum(info.splats for info in infos))

    def load(self) -> Splats:
        """Read the splats of all tiles of the level."""
        tileset = self._tileset
        places = [(file, tile.above) for tile in self._tiles for file in tile.contents]
        models = [gltf.open_gltf(file, above).load() for file, above in places]
        levels = tileset.levels()
        which = [level_note(self._level, levels)] if levels > 1 else []
        modes = {model.render_mode for model in models}
        own = [*which, *tileset.notes, *mode_notes(modes)]
        joined = joined_rows(models)
        comments = dict.fromkeys(line for model in models for line in model.comments)
        notes = join_findings([joined.notes, own])
        return replace(joined, render_mode=common_mode(modes), comments=list(comments), notes=notes)


def _all(root: _Tile) -> Iterator[_Tile]:
    waiting = [root]
    while waiting:
        tile = waiting.pop()
        yield tile
        waiting += reversed(tile.children)


def _drawn(root: _Tile, depth: int, *, empty: bool) -> Iterator[_Tile]:
    """Yield the tiles with contents that a viewer draws if it descends to `depth` at most.

    Args:
        root: Of the tree.
        depth: Number of steps from the root.
        empty: Whether nothing is drawn for a tile of that depth without content; otherwise its
            descendants are.
    """
    waiting = [root]
    while waiting:
        tile = waiting.pop()
        stays = tile.depth == depth and (empty or tile.contents)
        refined = bool(tile.children) and not stays
        if tile.contents and (tile.adds or not refined):
            yield tile
        if refined:
            waiting += reversed(tile.children)


class _Reader:
    """A reader of a tileset and the tilesets it refers to, which refuses to read a file twice."""

    def __init__(self) -> None:
        self._seen: set[Path] = set()
        self._tilesets = 0

    def root(self, path: Path) -> dict[str, Any]:
        """Read the root tile of a `tileset.json`, as JSON."""
        self._tilesets += 1
        if self._tilesets > _MAX_TILESETS:
            raise refused(str(path), f"is one of more than {_MAX_TILESETS} tilesets")
        return table(read_json(path, MAX_BYTES).get("root"), f"{path}, root")

    def tile(self, data: dict[str, Any], place: "_Place") -> _Tile:
        """Parse a tile and all tiles below it.

        Raises:
            FormatError: It is invalid or tiled implicitly, or names a file twice or outside of the
                folder.
        """
        where = f"{place.path}, tile"
        if "implicitTiling" in data:
            raise refused(where, "uses implicit tiling, which nanogs does not read")
        adds = _adds(data.get("refine"), place.adds, where)
        with np.errstate(all="ignore"):
            above = place.above @ _transform(data, where)
        if not np.isfinite(above).all():
            raise refused(where, "is too large after its transform and those of the tiles above it")
        inner = replace(place, above=above, adds=adds)
        contents, below = [], []
        for file in self._contents(data, place.path):
            if file.name.lower().endswith(".json"):
                outer = replace(inner, path=file)
                below.append(self.tile(self.root(file), outer))
            else:
                contents.append(file)
        step = replace(inner, depth=place.depth + 1)
        children = rows(data.get("children") or [], f"{where}, children")
        below += [self.tile(table(child, where), step) for child in children]
        above = Z_UP.T @ inner.above @ Z_UP
        return _Tile(place.depth, tuple(contents), above, adds, tuple(below))

    def _contents(self, data: dict[str, Any], path: Path) -> Iterator[Path]:
        given = [data["content"]] if data.get("content") is not None else []
        given += rows(data.get("contents") or [], f"{path}, contents")
        for content in given:
            where = f"{path}, content"
            entry = table(content, where)
            file = referenced_path(path.parent, entry.get("uri", entry.get("url")), where)
            if file in self._seen:
                raise refused(where, f"names {file.name} twice")
            self._seen.add(file)
            if file.suffix.lower() not in (".glb", ".gltf", ".json"):
                raise refused(where, f"names {file.name}, where glTF files are needed")
            yield file


@dataclass(frozen=True, slots=True)
class _Place:
    """The context of a tile that it inherits from its parent.

    Attributes:
        path: The `tileset.json` that it is in.
        depth: Number of steps from the root.
        above: (4, 4) float64: transform from its parent's frame to that of the tileset, both z up.
        adds: Whether its parent's refinement is `ADD`, the default of its own.
    """

    path: Path
    depth: int
    above: F64
    adds: bool


def _read(path: Path) -> _Tileset:
    """Read and check a `tileset.json`."""
    reader = _Reader()
    own = read_own(path, "asset", "extras", "generator") is not None
    try:
        tree = reader.tile(reader.root(path), _Place(path, 0, _IDENTITY, adds=False))
        place = _place_of(tree)
        if place is None:
            return _Tileset(path, tree, own, ())
        near = _in_frame_of(tree, place, np.linalg.inv(place).astype(np.float64))
    except RecursionError:
        raise refused(str(path), "has tiles that are nested too deeply") from None
    except np.linalg.LinAlgError:
        raise refused(f"{path}, tile", "flattens the splats with its transform") from None
    note = f"The position of the scene on Earth was left out: {text_of(Z_UP @ place @ Z_UP.T)}."
    return _Tileset(path, near, own, (note,))


def _place_of(root: _Tile) -> F64 | None:
    """Return the first tile transform, from the root on, with a far translation, or None.

    Both of its frames are y up.
    """
    far = (tile.above for tile in _all(root) if np.abs(tile.above[:3, 3]).max() > _FAR)
    return next(far, None)


def _in_frame_of(root: _Tile, place: F64, back: F64) -> _Tile:
    """Transform a tree to the local frame of `place`; `back` is the inverse of its transform."""
    children = tuple(_in_frame_of(tile, place, back) for tile in root.children)
    # A tile with no other transform gets exactly the identity, without rounding.
    same = np.array_equal(root.above, place)
    with np.errstate(all="ignore"):  # overflow is refused by `pose_of`
        above = _IDENTITY if same else back @ root.above
    return replace(root, above=above, children=children)


def _transform(data: dict[str, Any], where: str) -> F64:
    """Return the (4, 4) transform of a tile, which is stored in column-major order."""
    if data.get("transform") is None:
        return _IDENTITY
    return numbers(data["transform"], f"{where}, transform", 16).reshape(4, 4).T


def _adds(value: object, inherited: bool, where: str) -> bool:
    if value is None:
        return inherited
    if value not in ("ADD", "REPLACE"):
        raise refused(f"{where}, refine", "must be ADD or REPLACE")
    return value == "ADD"
