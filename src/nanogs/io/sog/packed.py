"""SOG to be unpacked: the bytes of its textures, of which one at a time is decoded.

A texture cannot be decoded in part; an unpacked one can be read so. Of a streamed SOG, the rows of
a level are unpacked, model after model.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np

from nanogs._types import U8, Array
from nanogs.io.files import input_size
from nanogs.io.info import FileInfo
from nanogs.io.json_fields import parse
from nanogs.io.parts import Column, ColumnReader, Packed
from nanogs.io.sog import read as sog
from nanogs.io.sog.levels import (
    Levels,
    Piece,
    check_rows,
    common_mode,
    joined_notes,
    read_manifest,
)
from nanogs.io.sog.meta import MAX_META_BYTES, file_names
from nanogs.io.sog.read import Model, opened, texels_of
from nanogs.splats import RenderMode, Splats, empty_arrays, padded

_PALETTE = "shN_centroids"
_TEXEL = 25  # bytes that decoding holds for each, measured: copies of Pillow and ours
_ROWS = 1 << 16  # of a piece


class SogSource(Packed):
    """A `.sog` file or a `meta.json`, of which some runs of rows, or all, are unpacked.

    Args:
        path: The file.
        spans: (offset, count) of the runs of rows; all by default.
    """

    def __init__(self, path: Path, spans: Sequence[tuple[int, int]] | None = None) -> None:
        super().__init__(path)
        self._given = spans

    @cached_property
    def info(self) -> FileInfo:
        """The description, from the `meta.json`."""
        return sog.inspect(self.path)

    @property
    def files(self) -> Sequence[Path]:
        """The description and its textures; see `FileSource`."""
        if self.path.name.lower().endswith(".sog"):
            return (self.path,)
        with opened(self.path) as (container, name):
            data = parse(container.read(name, MAX_META_BYTES), container.where(name))
            names = file_names(data, container.where(name))
        return (self.path, *(self.path.parent / each for each in dict.fromkeys(names)))

    @cached_property
    def model(self) -> Model:
        """The model, its textures looked at."""
        with opened(self.path) as (container, name):
            return Model(container, name)

    @property
    def _spans(self) -> Sequence[tuple[int, int]]:
        return ((0, self.model.meta.count),) if self._given is None else self._given

    @cached_property
    def stored(self) -> Mapping[str, Column]:
        """The textures; see `Packed`."""
        count = sum(count for _, count in self._spans)
        shapes = {each: self.model.shape(each) for each in self.model.meta.files}
        return {
            each: Column("|u1", (rows if each == _PALETTE else count, channels))
            for each, (rows, channels) in shapes.items()
        }

    @cached_property
    def memory(self) -> int:
        """Bytes that decoding the largest texture takes."""
        with opened(self.path) as (container, _):
            packed = {each: container.size(f) for each, f in self.model.meta.files.items()}
        texels = {each: width * height for each, (width, height) in self.model.sizes.items()}
        return max(_TEXEL * texels[each] + 2 * packed[each] for each in texels)

    def unpack(self, _notes: list[str]) -> Iterator[Array]:
        """All columns; see `Packed`."""
        with opened(self.path) as (container, _):
            for name, column in self.stored.items():
                texels = texels_of(container, self.model.meta, name)
                spans = ((0, len(texels)),) if name == _PALETTE else self._spans
                for offset, count in spans:
                    for start in range(offset, offset + count, _ROWS):
                        stop = min(start + _ROWS, offset + count)
                        yield np.ascontiguousarray(texels[start:stop, : column.shape[1]])
                del texels  # before the next one is decoded

    def decode(self, columns: ColumnReader, start: int, stop: int) -> Splats:
        """Some rows; see `Packed`."""

        def texture(name: str) -> U8:
            span = (0, self.stored[name].shape[0]) if name == _PALETTE else (start, stop)
            return columns(name, *span)

        return self.model.decoded(texture)


def open_level(path: Path, level: int = 0) -> "SogLevel":
    """A level of a `lod-meta.json`; 0 is the finest.

    Raises:
        OptionError: There is no such level.
        FormatError: A file is missing or damaged, or the manifest contradicts it.
    """
    manifest = read_manifest(path)
    return SogLevel(path, manifest, manifest.pieces(path, level))


class SogLevel(Packed):
    """The models of a level, one after the other; what is kept of each is small."""

    def __init__(self, path: Path, manifest: Levels, pieces: Sequence[Piece]) -> None:
        super().__init__(path)
        self._manifest, self._pieces = manifest, pieces
        self._last: tuple[int, SogSource] | None = None

    @cached_property
    def info(self) -> FileInfo:
        """The description, from the manifest and those of the models."""
        infos = []
        for piece in self._pieces:
            info = sog.inspect(piece.path)
            check_rows(piece, info.splats)
            infos.append(replace(info, splats=piece.count))
        widest = max(infos, key=lambda info: info.sh_degree)
        return replace(
            widest,
            path=self.path,
            format="streamed sog",
            file_bytes=input_size(self.path) + sum(info.file_bytes for info in infos),
            splats=sum(info.splats for info in infos),
            render_mode=common_mode({info.render_mode for info in infos}),
        )

    @property
    def files(self) -> Sequence[Path]:
        """The manifest and all files of the level; see `FileSource`."""
        return (self.path, *(f for piece in self._pieces for f in SogSource(piece.path).files))

    @property
    def levels(self) -> tuple[int, ...]:
        """Splats of each level; see `FileSource`."""
        return tuple(sum(piece.count for piece in each) for each in self._manifest.levels)

    @cached_property
    def _opened(self) -> "_Pieces":
        return _Pieces(self._pieces)

    @cached_property
    def stored(self) -> Mapping[str, Column]:
        """The textures of all models; see `Packed`."""
        return self._opened.stored

    @cached_property
    def memory(self) -> int:
        """Bytes that the largest texture takes."""
        return self._opened.memory

    def unpack(self, notes: list[str]) -> Iterator[Array]:
        """All columns of each model; see `Packed`."""
        for piece in self._pieces:
            yield from _source_of(piece).unpack(notes)

    def decode(self, columns: ColumnReader, start: int, stop: int) -> Splats:
        """Some rows, whichever models they are in; see `Packed`."""
        found, n = self._opened, stop - start
        out = empty_arrays(n, found.degree)
        for number, (piece, (first, end)) in enumerate(
            zip(self._pieces, pairwise(found.ends), strict=True)
        ):
            low, high = max(start, first), min(stop, end)
            if low < high:

                def own(name: str, a: int, b: int, number: int = number) -> Array:
                    return columns(f"{number}:{name}", a, b)

                if self._last is None or self._last[0] != number:
                    self._last = number, _source_of(piece)
                part = self._last[1].decode(own, low - first, high - first)
                for name, array in out.items():
                    column = getattr(part, name)
                    column = padded(column, out["sh"].shape[1]) if name == "sh" else column
                    array[low - start : high - start] = column
        notes = joined_notes(found.said, self._manifest.notes)
        return Splats(**out, render_mode=found.mode, notes=notes)


class _Pieces:
    """The models of a level as far as their descriptions and the sizes of textures say."""

    def __init__(self, pieces: Sequence[Piece]) -> None:
        self.ends, self.memory = [0], 0
        self.said: list[Sequence[str]] = []
        self.stored: dict[str, Column] = {}
        degrees: set[int] = set()
        modes: set[RenderMode] = set()
        for number, piece in enumerate(pieces):
            found = _source_of(piece)
            degrees.add(found.model.degree)
            modes.add(found.model.meta.render_mode)
            self.said.append(found.model.meta.notes)
            self.ends.append(self.ends[-1] + piece.count)
            self.memory = max(self.memory, found.memory)
            self.stored |= {f"{number}:{name}": each for name, each in found.stored.items()}
        self.degree, self.mode = max(degrees), common_mode(modes)


def _source_of(piece: Piece) -> SogSource:
    found = SogSource(piece.path, piece.spans)
    check_rows(piece, found.model.meta.count)
    return found
