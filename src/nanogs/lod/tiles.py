"""Writing 3D Tiles 1.1: a `tileset.json` over `.glb` files with KHR_gaussian_splatting.

Specification: https://docs.ogc.org/cs/22-025r4/22-025r4.html. Tiles of the coarsest level come
first; each is replaced by its children, which are of the next finer level and fill its cell. The
tileset's frame is that of 3D Tiles, z up; a viewer turns glTF's y there, and `gltf_write` turns the
y of the model, which points down, to glTF's. Nothing is known of the scene's place on Earth, so the
root's transform is the identity; whoever knows the place writes it there.

Contents are uncompressed, or packed as SPZ, which is all that CesiumJS draws; see `gltf_spz`.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from nanogs._types import F64
from nanogs.io import gltf_spz, gltf_write, limits
from nanogs.io.gltf import MAX_DEGREE
from nanogs.io.gltf_scene import EXTENSION
from nanogs.lod.boxes import Box, box_around, union
from nanogs.lod.cells import Cells, divide
from nanogs.lod.chunks import SortedLevel, Written, generator, plain_paths, read_own
from nanogs.lod.manifest import Manifest
from nanogs.splats import Splats

NAME = "tileset.json"
# Runtimes learn from it which extensions the contents use; that glTF is a content is core in 1.1.
_CONTENT = "3DTILES_content_gltf"
_DEVIATIONS = 3.0  # as far as rasterisers draw; what is outside of a box may be culled
# A level's error is the width, in deviations, of what one sees of its splats: by the usual 16
# pixels of error, a tile is replaced when they are wider than that.
_WIDTH = 4.0


def _plain_losses(splats: Splats) -> tuple[str, ...]:
    """What `gltf_write` leaves out, and the comments, which would be in every tile."""
    found = limits.left_out(splats, ".glb", max_degree=MAX_DEGREE)
    return (*found, *limits.rounded(splats, ".glb"))


@dataclass(frozen=True, slots=True)
class _Form:
    """How contents are written, what they leave out, and the extensions that tell of them."""

    write: Callable[[Splats, BinaryIO], None]
    losses: Callable[[Splats], tuple[str, ...]]
    extensions: dict[str, list[str]]


_PACKED = [EXTENSION, gltf_spz.PACKED]
_FORMS = {
    False: _Form(gltf_write.write, _plain_losses, {"extensionsUsed": [EXTENSION]}),
    True: _Form(
        gltf_spz.write,
        gltf_spz.losses,
        {"extensionsUsed": _PACKED, "extensionsRequired": _PACKED},
    ),
}


@dataclass(frozen=True, slots=True)
class _Tile:
    """A cell of one level.

    Attributes:
        content: Its file, or None where the level has nothing in it.
        box: Around its splats; None without any.
        width: The typical visible width of its splats, scene units; of the whole level's for an
            empty one.
    """

    content: str | None
    box: Box | None
    width: float


class Tiles:
    """A folder that is being filled, level by level."""

    def __init__(self, folder: Path, chunk: int, *, spz: bool = False) -> None:
        """Begin.

        Args:
            folder: Where to; it exists and is empty.
            chunk: Most splats of a tile, 1 or more.
            spz: Whether contents are packed.
        """
        self._folder, self._chunk, self._form = folder, chunk, _FORMS[spz]
        self._cells: Cells | None = None
        self._levels: list[dict[int, _Tile]] = []  # tiles by their node, in the order of the walk

    def add(self, splats: Splats) -> Written:
        """Write the next level, the finest first, one tile at a time.

        Args:
            splats: N splats, all finite.
        """
        if self._cells is None:
            self._cells = divide(splats.means, self._chunk)
        finer = frozenset(self._levels[-1]) if self._levels else self._cells.all_leaves()
        level, typical = SortedLevel(splats, self._cells), _width(splats)
        tiles: dict[int, _Tile] = {}
        written = 0
        for node in self._cells.cut(level.counts, self._chunk, finer):
            part, _ = level.take(*self._cells.leaves[node].tolist())
            if not len(part):
                tiles[node] = _Tile(None, None, typical)
                continue
            path = self._folder / f"{len(self._levels)}_{len(tiles)}.glb"
            with path.open("wb") as file:
                self._form.write(part, file)
            written += path.stat().st_size
            tiles[node] = _Tile(path.name, box_around(part, _DEVIATIONS), _width(part))
        self._levels.append(tiles)
        names = tuple(tile.content for tile in tiles.values() if tile.content)
        return Written(names, written)

    def finish(self, _made: Manifest) -> None:
        """Write `tileset.json`."""
        depth = len(self._levels) - 1
        tops = [self._tile(depth, node) for node in self._levels[-1]]
        box = union(box for _, box in tops)
        diagonal = float(np.linalg.norm(box.high - box.low))
        root = tops[0][0]
        if len(tops) > 1:
            # Without a content, and so wrong by as much as there is to see.
            children = [tile for tile, _ in tops]
            root = _described(box, max(diagonal, _error(children))) | {"children": children}
        data = {
            "asset": {"version": "1.1", "extras": {"generator": generator()}},
            "extensionsUsed": [_CONTENT],
            "extensions": {_CONTENT: self._form.extensions},
            "geometricError": max(diagonal, root["geometricError"]),
            "root": {"transform": np.eye(4).ravel().tolist(), "refine": "REPLACE"} | root,
        }
        text = json.dumps(data, separators=(",", ":"), allow_nan=False)
        (self._folder / NAME).write_text(text, encoding="utf-8")

    def _tile(self, level: int, node: int) -> tuple[dict[str, Any], Box]:
        """A tile with all below it, and the box around all of that."""
        own = self._levels[level][node]
        below = [self._tile(level - 1, inner) for inner in self._inside(level, node)]
        children = [tile for tile, _ in below]
        box = union([*([own.box] if own.box else []), *(box for _, box in below)])
        tile = _described(box, max(own.width, _error(children)) if children else 0.0)
        if own.content:
            tile["content"] = {"uri": own.content}
        return tile | ({"children": children} if children else {}), box

    def _inside(self, level: int, node: int) -> list[int]:
        """The nodes of the next finer level's tiles in a tile's cell."""
        cells = self._cells
        if cells is None or level == 0:
            return []
        first, end = cells.leaves[node]
        finer = self._levels[level - 1]
        return [inner for inner in finer if first <= cells.leaves[inner, 0] < end]

    def losses(self, splats: Splats) -> tuple[str, ...]:
        """What the files leave out of a model, one sentence each."""
        return self._form.losses(splats)


def made_files(folder: Path) -> frozenset[str] | None:
    """The files of a tileset that nanogs wrote; None for other folders."""
    data = read_own(folder / NAME, "asset", "extras", "generator")
    if data is None:
        return None
    uris: list[object] = []
    waiting = [data.get("root")]
    while waiting:
        tile = waiting.pop()
        if not isinstance(tile, dict):
            continue
        content, children = tile.get("content"), tile.get("children")
        uris += [content.get("uri")] if isinstance(content, dict) else []
        waiting += children if isinstance(children, list) else []
    return frozenset({NAME, *plain_paths(uris)})


def _described(box: Box, error: float) -> dict[str, Any]:
    return {"boundingVolume": {"box": _volume(box)}, "geometricError": error}


def _error(tiles: list[dict[str, Any]]) -> float:
    """The largest error of some tiles: no child's is larger than its parent's."""
    return float(max((tile["geometricError"] for tile in tiles), default=0.0))


def _volume(box: Box) -> list[float]:
    """The centre and the three half axes of a box, in the frame of the tileset."""
    corners = np.stack([_turned(box.low), _turned(box.high)])
    centre, half = corners.mean(axis=0), np.abs(corners[1] - corners[0]) / 2
    return [*centre.tolist(), *np.diag(half).ravel().tolist()]


def _turned(point: F64) -> F64:
    """From y down by half a turn about z to y up, and on by a quarter about x to z up."""
    x, y, z = point
    return np.array([-x, -z, -y])


def _width(splats: Splats) -> float:
    """The visible width of a typical splat along its longest axis, scene units."""
    return _WIDTH * float(np.median(splats.scales().max(axis=1)))
