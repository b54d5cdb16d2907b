"""The `tileset.json` of 3D Tiles, whose tiles are cells of one or more trees."""

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from nanogs._types import F64, I64
from nanogs.io.generator import GENERATOR
from nanogs.lod.boxes import union
from nanogs.lod.cells import Cells
from nanogs.lod.chunks import ChunkTree
from nanogs.place import columns

# Lists the glTF extensions that contents use; glTF contents themselves need no extension in 1.1.
_CONTENT = "3DTILES_content_gltf"


class Tile(NamedTuple):
    """A cell of one level.

    Attributes:
        content: Name of its file; None without splats.
        box: The box around its splats; None without splats.
        width: Visible width of a typical splat in it, scene units; without splats, of the level.
    """

    content: str | None
    box: F64 | None
    width: float


class _Level(NamedTuple):
    """The T tiles of a level in a tree.

    Attributes:
        tiles: The tiles by node.
        nodes: (T,) int64, their nodes, ordered by their leaves.
        firsts: (T,) int64, the first leaf of each of `nodes`, ascending.
    """

    tiles: Mapping[int, Tile]
    nodes: I64
    firsts: I64

    def below(self, first: int, end: int) -> list[int]:
        """Return the nodes whose leaves are in the range from `first` to `end`, in order."""
        begin, stop = np.searchsorted(self.firsts, (first, end))
        found: list[int] = self.nodes[begin:stop].tolist()
        return found


def describe(
    trees: Sequence[ChunkTree],
    levels: int,
    extensions: Mapping[str, Sequence[str]],
    place: F64 | None = None,
) -> str:
    """Return the contents of `tileset.json`.

    Tiles of the coarsest level are at the top; each is replaced by those below it.

    Args:
        trees: One or more, whose chunks are as `Tiles` describes them.
        levels: Number of levels.
        extensions: The glTF extensions that the contents use and require.
        place: (4, 4) transform of the root; by default the identity.
    """
    found = [_of_level(trees, level) for level in range(levels)]
    tops = [
        _tile(tree.cells, [level[number] for level in found], node)
        for number, tree in enumerate(trees)
        for node in found[-1][number].nodes.tolist()
    ]
    box = union(box for _, box in tops)
    diagonal = float(np.linalg.norm(box[1] - box[0]))
    root = tops[0][0]
    if len(tops) > 1:
        # The common root has no content, so its error is the extent of the scene.
        children = [tile for tile, _ in tops]
        root = _described(box, max(diagonal, _error(children))) | {"children": children}
    transform = np.eye(4) if place is None else place
    data = {
        "asset": {"version": "1.1", "extras": {"generator": GENERATOR}},
        "extensionsUsed": [_CONTENT],
        "extensions": {_CONTENT: extensions},
        # Viewers scale the errors of tiles by the transforms above them, but not this one.
        "geometricError": max(diagonal, root["geometricError"]) * _enlargement(transform),
        "root": {"transform": columns(transform), "refine": "REPLACE"} | root,
    }
    return json.dumps(data, separators=(",", ":"), allow_nan=False)


def _of_level(trees: Sequence[ChunkTree], level: int) -> list[_Level]:
    """Return the tiles of a level, for each tree; empty ones get the median width."""
    chunks = [tree.levels[level] for tree in trees]
    typical = float(np.median([width for each in chunks for _, file, _, width in each if file]))
    found = []
    for tree, each in zip(trees, chunks, strict=True):
        tiles = {
            node: Tile(file, np.array(box), width) if file else Tile(None, None, typical)
            for node, file, box, width in each
        }
        nodes = np.array(list(tiles), np.int64)
        firsts = tree.cells.leaves[nodes, 0]
        order = np.argsort(firsts, kind="stable")
        found.append(_Level(tiles, nodes[order], firsts[order]))
    return found


def _tile(cells: Cells, levels: Sequence[_Level], node: int) -> tuple[dict[str, Any], F64]:
    """Return the JSON of a tile of the last level given, with all tiles below, and their box."""
    own, inner = levels[-1].tiles[node], levels[:-1]
    nodes = inner[-1].below(*cells.leaves[node]) if inner else []
    below = [_tile(cells, inner, each) for each in nodes]
    children = [tile for tile, _ in below]
    box = union([*([] if own.box is None else [own.box]), *(box for _, box in below)])
    tile = _described(box, max(own.width, _error(children)) if children else 0.0)
    if own.content:
        tile["content"] = {"uri": own.content}
    return tile | ({"children": children} if children else {}), box


def _enlargement(transform: F64) -> float:
    """Return the largest scale factor of a transform; exactly 1 for a rotation."""
    longest = float(np.linalg.norm(transform[:3, :3], axis=0).max())
    return 1.0 if math.isclose(longest, 1.0, rel_tol=1e-12) else longest


def _described(box: F64, error: float) -> dict[str, Any]:
    return {"boundingVolume": {"box": _volume(box)}, "geometricError": error}


def _error(tiles: list[dict[str, Any]]) -> float:
    """Return the largest error of some tiles, which their parent's must reach."""
    return float(max((tile["geometricError"] for tile in tiles), default=0.0))


def _volume(box: F64) -> list[float]:
    """Return centre and three half-axes of a box as 12 numbers, in the frame of the tileset."""
    corners = np.stack([_turned(corner) for corner in box])
    centre, half = corners.mean(axis=0), np.abs(corners[1] - corners[0]) / 2
    return [*centre.tolist(), *np.diag(half).ravel().tolist()]


def _turned(point: F64) -> F64:
    """Rotate a point from y down to z up: half a turn about z, then a quarter about x."""
    x, y, z = point
    return np.array([-x, -z, -y])
