"""SOG to be unpacked: the bytes of its textures, of which one at a time is decoded.

A texture cannot be decoded in part; an unpacked one can be read so. Of a streamed SOG, the rows of
its finest level are unpacked, model after model.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from nanogs._types import U8, Array
from nanogs.io.json_fields import parse
from nanogs.io.parts import Column, ColumnReader, Packed
from nanogs.io.sog import Model, opened, texels_of
from nanogs.io.sog_levels import Piece, check_rows, common_mode, joined_notes, read_manifest
from nanogs.io.sog_meta import MAX_META_BYTES, file_names
from nanogs.splats import RenderMode, Splats, empty_arrays, padded

_PALETTE = "shN_centroids"
_TEXEL = 25  # bytes that decoding holds for each, measured: copies of Pillow and ours
_ROWS = 1 << 16  # of a piece


def packed(path: Path) -> Packed:
    """A `.sog` file or a `meta.json` to be unpacked.

    Raises:
        FormatError: As for `sog.inspect`.
    """
    return _Textures(path)


def packed_level(path: Path) -> Packed:
    """The finest level of a `lod-meta.json` to be unpacked.

    Raises:
        FormatError: As for `sog_levels.inspect`.
    """
    return _Level(path)


def files(path: Path) -> Sequence[Path]:
    """All files of a SOG model.

    Raises:
        FormatError: Its description cannot be read.
    """
    if path.name.lower().endswith(".sog"):
        return (path,)
    with opened(path) as (container, name):
        data = parse(container.read(name, MAX_META_BYTES), container.where(name))
        names = file_names(data, container.where(name))
    return (path, *(path.parent / each for each in dict.fromkeys(names)))


def level_files(path: Path) -> Sequence[Path]:
    """All files of the finest level of a `lod-meta.json`.

    Raises:
        FormatError: One of the descriptions cannot be read.
    """
    pieces = read_manifest(path).levels[0]
    return (path, *(file for piece in pieces for file in files(piece.path)))


class _Textures:
    """The textures of a model, of which some runs of rows, or all, are unpacked."""

    def __init__(self, path: Path, spans: Sequence[tuple[int, int]] | None = None) -> None:
        self._path = path
        with opened(path) as (container, name):
            self.model = model = Model(container, name)
            packed = {each: container.size(file) for each, file in model.meta.files.items()}
        self._spans = ((0, model.meta.count),) if spans is None else spans
        self.count = sum(count for _, count in self._spans)
        shapes = {each: model.shape(each) for each in model.meta.files}
        self.columns: Mapping[str, Column] = {
            each: Column("|u1", (rows if each == _PALETTE else self.count, channels))
            for each, (rows, channels) in shapes.items()
        }
        texels = {each: width * height for each, (width, height) in model.sizes.items()}
        self.memory = max(_TEXEL * texels[each] + 2 * packed[each] for each in texels)

    def unpack(self, _notes: list[str]) -> Iterator[Array]:
        """All columns; see `Packed`."""
        with opened(self._path) as (container, _):
            for name, column in self.columns.items():
                texels = texels_of(container, self.model.meta, name)
                spans = ((0, len(texels)),) if name == _PALETTE else self._spans
                for offset, count in spans:
                    for start in range(offset, offset + count, _ROWS):
                        stop = min(start + _ROWS, offset + count)
                        yield np.ascontiguousarray(texels[start:stop, : column.shape[1]])
                del texels  # before the next one is decoded

    def read(self, columns: ColumnReader, start: int, stop: int) -> Splats:
        """Some rows; see `Packed`."""

        def texture(name: str) -> U8:
            span = (0, self.columns[name].shape[0]) if name == _PALETTE else (start, stop)
            return columns(name, *span)

        return self.model.decoded(texture)


class _Level:
    """The models of a level, one after the other; what is kept of each is small."""

    def __init__(self, path: Path) -> None:
        manifest = read_manifest(path)
        self._pieces, self._notes = manifest.levels[0], manifest.notes
        self._ends, self.memory = [0], 0
        self._said: list[Sequence[str]] = []
        degrees: set[int] = set()
        modes: set[RenderMode] = set()
        self.columns: dict[str, Column] = {}
        for number, piece in enumerate(self._pieces):
            found = self._opened(piece)
            degrees.add(found.model.degree)
            modes.add(found.model.meta.render_mode)
            self._said.append(found.model.meta.notes)
            self._ends.append(self._ends[-1] + found.count)
            self.memory = max(self.memory, found.memory)
            self.columns |= {f"{number}:{name}": each for name, each in found.columns.items()}
        self._degree, self._mode = max(degrees), common_mode(modes)
        self._last: tuple[int, _Textures] | None = None

    @staticmethod
    def _opened(piece: Piece) -> _Textures:
        found = _Textures(piece.path, piece.spans)
        check_rows(piece, found.model.meta.count)
        return found

    def unpack(self, notes: list[str]) -> Iterator[Array]:
        """All columns of each model; see `Packed`."""
        for piece in self._pieces:
            yield from self._opened(piece).unpack(notes)

    def read(self, columns: ColumnReader, start: int, stop: int) -> Splats:
        """Some rows, whichever models they are in; see `Packed`."""
        n, coefficients = stop - start, (self._degree + 1) ** 2
        out = empty_arrays(n, self._degree)
        for number, (piece, (first, end)) in enumerate(
            zip(self._pieces, pairwise(self._ends), strict=True)
        ):
            low, high = max(start, first), min(stop, end)
            if low < high:

                def own(name: str, a: int, b: int, number: int = number) -> Array:
                    return columns(f"{number}:{name}", a, b)

                if self._last is None or self._last[0] != number:
                    self._last = number, self._opened(piece)
                part = self._last[1].read(own, low - first, high - first)
                for name, array in out.items():
                    column = padded(part.sh, coefficients) if name == "sh" else getattr(part, name)
                    array[low - start : high - start] = column
        return Splats(**out, render_mode=self._mode, notes=joined_notes(self._said, self._notes))
