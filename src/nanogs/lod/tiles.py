"""Writing 3D Tiles 1.1: a `tileset.json` over `.glb` files with KHR_gaussian_splatting.

Specification: https://docs.ogc.org/cs/22-025r4/22-025r4.html. Tiles of the coarsest level come
first; each is replaced by its children, which are of the next finer level and fill its cell. The
tileset's frame is that of 3D Tiles, z up; a viewer turns glTF's y there, and `io.gltf` turns the y
of the model, which points down, to glTF's. Nothing is known of the scene's place on Earth, so the
root's transform is the identity; whoever knows the place writes it there.

Contents are packed as SPZ, which is all that CesiumJS 1.145 draws (see `packed_write` there), or
plain.
"""

import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import BinaryIO

import numpy as np

from nanogs.lod.boxes import box_around
from nanogs.lod.cells import Cells, divide
from nanogs.lod.chunks import SortedLevel, Written, plain_paths, read_own
from nanogs.lod.manifest import Manifest
from nanogs.lod.tileset import Tile, Tree, describe
from nanogs.progress import Parts, untold
from nanogs.splats import Splats

NAME = "tileset.json"
_DEVIATIONS = 3.0  # as far as rasterisers draw; what is outside of a box may be culled
# A level's error is the width, in deviations, of what one sees of its splats: by the usual 16
# pixels of error, a tile is replaced when they are wider than that.
_WIDTH = 4.0


def _plain_losses(splats: Splats) -> tuple[str, ...]:
    """Name what `io.gltf.write` leaves out, and the comments, which would be in every tile."""
    from nanogs.io import limits
    from nanogs.io.gltf.primitives import MAX_DEGREE

    found = limits.left_out(splats, ".glb", max_degree=MAX_DEGREE)
    return (*found, *limits.rounded(splats, ".glb"))


@dataclass(frozen=True, slots=True)
class Form:
    """How contents are written, what they leave out, and the extensions that tell of them."""

    write: Callable[[Splats, BinaryIO], None]
    losses: Callable[[Splats], tuple[str, ...]]
    extensions: dict[str, list[str]]


@cache
def form_of(*, plain: bool) -> Form:
    """How contents are made, packed as SPZ or not."""
    from nanogs.io.gltf import packed_write as gltf_spz
    from nanogs.io.gltf import write as gltf_write
    from nanogs.io.gltf.primitives import PACKED
    from nanogs.io.gltf.scene import EXTENSION

    if plain:
        return Form(gltf_write.write, _plain_losses, {"extensionsUsed": [EXTENSION]})
    packed = [EXTENSION, PACKED]
    extensions = {"extensionsUsed": packed, "extensionsRequired": packed}
    return Form(gltf_spz.write, gltf_spz.losses, extensions)


def encode(
    level: SortedLevel, cells: Cells, nodes: Sequence[int], form: Form, prefix: str
) -> Iterator[tuple[int, Tile, bytes]]:
    """The tiles of a level, one at a time: node, tile and the content's bytes.

    An empty tile has no content, no box and the width 0.

    Args:
        level: Its splats.
        cells: What divides them.
        nodes: The level's tiles, as `Cells.cut` gives them.
        form: Of the contents.
        prefix: How names of files begin.
    """
    for number, node in enumerate(nodes):
        part, _ = level.take(*cells.leaves[node].tolist())
        if not len(part):
            yield node, Tile(None, None, 0.0), b""
            continue
        file = io.BytesIO()
        form.write(part, file)
        box = box_around(part, _DEVIATIONS)
        yield node, Tile(f"{prefix}{number}.glb", box, _width(part)), file.getvalue()


class Tiles:
    """A folder that is being filled, level by level."""

    def __init__(self, folder: Path, chunk: int, *, plain: bool = False) -> None:
        """Begin.

        Args:
            folder: Where to; it exists and is empty.
            chunk: Most splats of a tile, 1 or more.
            plain: Whether contents are not packed.
        """
        self._folder, self._chunk, self._form = folder, chunk, form_of(plain=plain)
        self._cells: Cells | None = None
        self._levels: list[dict[int, Tile]] = []  # tiles by their node, in the order of the walk

    def add(self, splats: Splats, tell: Parts = untold) -> Written:
        """Write the next level, the finest first, one tile at a time.

        Args:
            splats: N splats, all finite.
            tell: Told of the tiles written, and of how many.
        """
        if self._cells is None:
            self._cells = divide(splats.means, self._chunk)
        finer = frozenset(self._levels[-1]) if self._levels else self._cells.all_leaves()
        level, typical = SortedLevel(splats, self._cells), _width(splats)
        nodes = self._cells.cut(level.counts, self._chunk, finer)
        tiles: dict[int, Tile] = {}
        written = 0
        for node, tile, data in encode(
            level, self._cells, nodes, self._form, f"{len(self._levels)}_"
        ):
            tiles[node] = tile if tile.content else replace(tile, width=typical)
            if tile.content:
                (self._folder / tile.content).write_bytes(data)
            written += len(data)
            tell(len(tiles), len(nodes))
        self._levels.append(tiles)
        names = tuple(tile.content for tile in tiles.values() if tile.content)
        return Written(names, written)

    def finish(self, _made: Manifest) -> None:
        """Write `tileset.json`."""
        assert self._cells is not None, "a folder of levels has at least one"  # noqa: S101
        text = describe([Tree(self._cells, self._levels)], self._form.extensions)
        (self._folder / NAME).write_text(text, encoding="utf-8")

    def losses(self, splats: Splats) -> tuple[str, ...]:
        """Name the parts of a model that the files leave out, one sentence each."""
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


def _width(splats: Splats) -> float:
    """The visible width of a typical splat along its longest axis, scene units."""
    return _WIDTH * float(np.median(splats.scales().max(axis=1)))
