"""Writing 3D Tiles 1.1: a `tileset.json` that refers to `.glb` files with KHR_gaussian_splatting.

Specification: https://docs.ogc.org/cs/22-025r4/22-025r4.html. Tiles of the coarsest level are at
the top; each is replaced by its children, which are of the next finer level and fill its cell. The
tileset's frame is that of 3D Tiles, z up; viewers rotate contents from glTF's y up to it, and
`io.gltf` rotates the model, whose y points down, to glTF's frame. The root's transform places the
scene on Earth (`nanogs.place`); it is the identity by default. All else is in the scene's own
frame, near its origin, where single precision is finer than a splat.

Contents are packed as SPZ, the only encoding that CesiumJS 1.145 draws (see
`io.gltf.packed_write`), or plain.
"""

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np

from nanogs.errors import UnstorableError
from nanogs.io.generator import read_own
from nanogs.io.registry import TILESET
from nanogs.lod.boxes import box_around
from nanogs.lod.chunks import (
    ChunkLayout,
    ChunkTree,
    Made,
    SortedLevel,
    plain_paths,
)
from nanogs.lod.tileset import describe
from nanogs.place import from_columns
from nanogs.progress import PartProgress
from nanogs.splats import Splats
from nanogs.switches import tile_pixel

_DEVIATIONS = 3.0  # extent that rasterisers draw; anything outside of a box may be culled
# Visible width of a splat in standard deviations. A tile's geometric error is that width: with the
# default limit of 16 pixels, it is refined when its splats look wider than that.
_WIDTH = 4.0


def _plain_losses(splats: Splats) -> tuple[str, ...]:
    """Name the losses of `io.gltf.write`, and comments, which would be repeated in every tile."""
    from nanogs.io import limits
    from nanogs.io.gltf.primitives import MAX_DEGREE

    found = limits.left_out(splats, ".glb", max_degree=MAX_DEGREE)
    return (*found, *limits.rounded(splats, ".glb"))


@dataclass(frozen=True, slots=True)
class Form:
    """An encoding of tile contents: its writer, its losses, and the glTF extensions it uses."""

    write: Callable[[Splats, BinaryIO], None]
    losses: Callable[[Splats], tuple[str, ...]]
    extensions: dict[str, list[str]]


@cache
def form_of(*, packed: bool) -> Form:
    """Return the encoding of contents, packed as SPZ or plain."""
    from nanogs.io.gltf import packed_write as gltf_spz
    from nanogs.io.gltf import write as gltf_write
    from nanogs.io.gltf.primitives import PACKED
    from nanogs.io.gltf.scene import EXTENSION

    if not packed:
        return Form(gltf_write.write, _plain_losses, {"extensionsUsed": [EXTENSION]})
    both = [EXTENSION, PACKED]
    extensions = {"extensionsUsed": both, "extensionsRequired": both}
    return Form(gltf_spz.write, gltf_spz.losses, extensions)


@dataclass(frozen=True, slots=True)
class Tiles(ChunkLayout):
    """The layout of 3D Tiles.

    The plain data of a chunk are a tile: node, file, box and visible width of its splats. A tile
    without splats has no file, no box and the width 0.

    Attributes:
        packed: Whether contents are packed as SPZ.
        place: The root's transform, 16 numbers in column-major order; None for the identity. A
            tuple because jobs store it as plain data.
    """

    packed: bool = True
    place: tuple[float, ...] | None = None
    name: ClassVar[str] = TILESET
    suffix: ClassVar[str] = ".glb"

    weight: ClassVar[float] = 1.0
    held: ClassVar[tuple[float, int]] = 2.5, 0

    @property
    def _seconds(self) -> tuple[float, float]:
        return (2e-6, 4e-6) if self.packed else (1e-6, 1e-6)

    def _made(
        self,
        level: SortedLevel,
        finer: Sequence[Any] | None,
        prefix: str,
        on_progress: PartProgress,
    ) -> Made:
        undivided = frozenset(tile[0] for tile in finer) if finer else level.cells.all_leaves()
        nodes = level.cells.cut(level.counts, self.most, undivided)
        for number, node in enumerate(nodes):
            part, _ = level.take(*level.cells.leaves[node].tolist())
            if not len(part):
                yield [node, None, None, 0.0], {}
                continue
            name, file = f"{prefix}{number}.glb", io.BytesIO()
            self._pack(part, file)
            box = box_around(part, _DEVIATIONS)
            on_progress(number + 1, len(nodes))
            yield [node, name, box.tolist(), _width(part)], {name: file.getvalue()}

    def _pack(self, part: Splats, file: io.BytesIO) -> None:
        """Write the contents of a tile.

        Raises:
            OutputError: They cannot be written; if the packing is the reason, the message says so.
        """
        try:
            form_of(packed=self.packed).write(part, file)
        except UnstorableError as error:
            if not self.packed:
                raise
            text = f"{str(error).rstrip('.')}, or write tiles that are not packed (`plain=True`)."
            raise UnstorableError(text) from error

    def switch_pixel(self, level: int, deviation: float) -> float:  # noqa: ARG002 - by size
        """Return the size of a pixel at which a viewer switches to a level; see `ChunkLayout`."""
        return tile_pixel(_WIDTH * deviation)

    def losses(self, splats: Splats) -> tuple[str, ...]:
        """Name the parts of a model that the contents leave out; see `ChunkLayout`."""
        return form_of(packed=self.packed).losses(splats)

    def describe(
        self,
        trees: Sequence[ChunkTree],
        counts: Sequence[int],
        environment: bool = False,  # noqa: ARG002 - tiles have none
    ) -> str:
        """Return the contents of `tileset.json`; see `ChunkLayout`."""
        place = None if self.place is None else from_columns(self.place)
        return describe(trees, len(counts), form_of(packed=self.packed).extensions, place)


def made_files(folder: Path) -> frozenset[str] | None:
    """Return the files of a tileset that nanogs wrote; None for other folders."""
    data = read_own(folder / TILESET, "asset", "extras", "generator")
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
    return frozenset({TILESET, *plain_paths(uris)})


def _width(splats: Splats) -> float:
    """Return the visible width of a typical splat along its longest axis, scene units."""
    return _WIDTH * float(np.median(splats.scales().max(axis=1).astype(np.float64)))
