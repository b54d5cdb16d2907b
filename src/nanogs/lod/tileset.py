"""Describing 3D Tiles: the `tileset.json` over tiles that are cells of one tree or of several."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nanogs._types import F64
from nanogs.lod.boxes import Box, union
from nanogs.lod.cells import Cells
from nanogs.lod.chunks import generator

# Runtimes learn from it which extensions the contents use; that glTF is a content is core in 1.1.
_CONTENT = "3DTILES_content_gltf"


@dataclass(frozen=True, slots=True)
class Tile:
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


@dataclass(frozen=True, slots=True, eq=False)
class Tiled:
    """A tree of tiles: the scene, or a block of it.

    Attributes:
        cells: What divides it.
        levels: Tiles by their node, in the order of the walk; the finest level first.
    """

    cells: Cells
    levels: Sequence[Mapping[int, Tile]]


def describe(trees: Sequence[Tiled], extensions: Mapping[str, Sequence[str]]) -> str:
    """The contents of `tileset.json`.

    Tiles of the coarsest level come first; each is replaced by those below it.

    Args:
        trees: One or more, of the same number of levels.
        extensions: Those of glTF that the contents use and require.
    """
    tops = [top for tree in trees for top in _tops(tree)]
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
        "extensions": {_CONTENT: extensions},
        "geometricError": max(diagonal, root["geometricError"]),
        "root": {"transform": np.eye(4).ravel().tolist(), "refine": "REPLACE"} | root,
    }
    return json.dumps(data, separators=(",", ":"), allow_nan=False)


def _tops(tree: Tiled) -> list[tuple[dict[str, Any], Box]]:
    depth = len(tree.levels) - 1
    return [_tile(tree, depth, node) for node in tree.levels[depth]]


def _tile(tree: Tiled, level: int, node: int) -> tuple[dict[str, Any], Box]:
    """A tile with all below it, and the box around all of that."""
    own = tree.levels[level][node]
    below = [_tile(tree, level - 1, inner) for inner in _inside(tree, level, node)]
    children = [tile for tile, _ in below]
    box = union([*([own.box] if own.box else []), *(box for _, box in below)])
    tile = _described(box, max(own.width, _error(children)) if children else 0.0)
    if own.content:
        tile["content"] = {"uri": own.content}
    return tile | ({"children": children} if children else {}), box


def _inside(tree: Tiled, level: int, node: int) -> list[int]:
    """The nodes of the next finer level's tiles in a tile's cell."""
    if level == 0:
        return []
    first, end = tree.cells.leaves[node]
    return [n for n in tree.levels[level - 1] if first <= tree.cells.leaves[n, 0] < end]


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
    """Turn from y down to z up: half a turn about z, then a quarter about x."""
    x, y, z = point
    return np.array([-x, -z, -y])
