"""Reading SOG: `.sog`, which is one zip, and `meta.json` with its files beside it.

The layout is described in `meta`. A texture cannot be decoded in part, so all textures are first
unpacked to bytes, one after another; values of rows are then looked up in tables by these bytes.
The tables are computed in float64 and rounded once. As in the other 8-bit formats, alpha 0 becomes
a logit of -inf and 255 one of +inf.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from nanogs._types import F32, U8, U16, Array
from nanogs.io.container import Bundle, Folder
from nanogs.io.files import check_expansion, input_size, reading, splat_bytes
from nanogs.io.info import FileInfo
from nanogs.io.json_fields import parse, refused
from nanogs.io.parts import Column, ColumnReader, Packed
from nanogs.io.registry import META
from nanogs.io.rotations import whole_quats
from nanogs.io.sog.meta import (
    CODES,
    MAX_META_BYTES,
    PALETTE_COLUMNS,
    PALETTE_MAX,
    Meta,
    is_manifest,
    read_meta,
)
from nanogs.io.sog.texture import HEAD_BYTES, decode, size
from nanogs.slices import BLOCK_ROWS
from nanogs.splats import Splats

_PALETTE = "shN_centroids"
_TEXEL = 25  # bytes of memory per texel while decoding, measured: Pillow's copies and ours
_ROWS = 1 << 16  # rows of a piece that `unpack` yields
_PROPERTIES = (
    ("means", "ushort"),
    ("quats", "uchar"),
    ("scales", "uchar"),
    ("sh0", "uchar"),
    ("opacity", "uchar"),
)
_CHANNELS = {
    "means_l": 3, "means_u": 3, "quats": 4, "scales": 3, "sh0": 4, "shN_labels": 2,
    "shN_centroids": 3,
}  # fmt: skip
_PALETTE_PROPERTY = (("shN_labels", "ushort"),)
_DEGREE_OF_WIDTH = {PALETTE_COLUMNS * ((d + 1) ** 2 - 1): d for d in (1, 2, 3)}


class SogSource(Packed):
    """A `.sog` file or a `meta.json`, all of it or some runs of its rows.

    Files are read on demand: first `meta.json`, then the heads of the textures, then the textures.

    Args:
        path: The file.
        spans: (offset, count) of the runs of rows; all rows by default.
        inside: If `path` is a zip with several models, the folder of this model in it, with a
            slash at its end.
    """

    def __init__(
        self, path: Path, spans: Sequence[tuple[int, int]] | None = None, inside: str = ""
    ) -> None:
        super().__init__(path)
        self._given, self._inside = spans, inside

    @cached_property
    def meta(self) -> Meta:
        """The checked `meta.json`."""
        with _opened(self.path, self._inside) as (container, name):
            where = container.where(name)
            if container.size(name) > MAX_META_BYTES:
                raise refused(where, "is too large for a description of textures")
            return read_meta(parse(container.read(name, MAX_META_BYTES), where), where)

    @cached_property
    def info(self) -> FileInfo:
        """The metadata of the whole file, its count checked against the sizes of the files."""
        meta = self.meta
        with _opened(self.path, self._inside) as (container, name):
            degree = _sh_degree(container, meta)
            file_bytes = container.bytes_on_disk({name, *meta.files.values()})
            check_expansion(container.where(name), meta.count * splat_bytes(degree), file_bytes)
        return FileInfo(
            path=self.path,
            format="sog",
            encoding="webp",
            file_bytes=file_bytes,
            splats=meta.count,
            sh_degree=degree,
            properties=_PROPERTIES + (_PALETTE_PROPERTY if degree else ()),
            render_mode=meta.render_mode,
            render_tag='"model" in its meta.json' if meta.tagged else "",
        )

    @property
    def files(self) -> Sequence[Path]:
        """The `meta.json` and its textures; see `FileSource`."""
        if self._inside or not is_manifest(self.path):
            return (self.path,)
        names = dict.fromkeys(self.meta.files.values())
        return (self.path, *(self.path.parent / each for each in names))

    @cached_property
    def _sizes(self) -> dict[str, tuple[int, int]]:
        """Width and height of each texture, read from its head without decoding."""
        degree = self.info.sh_degree
        with _opened(self.path, self._inside) as (container, _):
            return _checked_sizes(container, self.meta, degree)

    @property
    def _spans(self) -> Sequence[tuple[int, int]]:
        return ((0, self.meta.count),) if self._given is None else self._given

    @cached_property
    def stored(self) -> Mapping[str, Column]:
        """The columns, one for each texture; see `Packed`."""
        rows = dict.fromkeys(self._sizes, sum(count for _, count in self._spans))
        if _PALETTE in rows:
            width, height = self._sizes[_PALETTE]
            rows[_PALETTE] = width * height
        return {name: Column("|u1", (rows[name], _CHANNELS[name])) for name in rows}

    @cached_property
    def memory(self) -> int:
        """Bytes of memory for decoding the largest texture."""
        with _opened(self.path, self._inside) as (container, _):
            packed = {each: container.size(name) for each, name in self.meta.files.items()}
        texels = {each: width * height for each, (width, height) in self._sizes.items()}
        return max(_TEXEL * texels[each] + 2 * packed[each] for each in texels)

    def unpack(self, _notes: list[str]) -> Iterator[Array]:
        """Decode all textures, one after another; see `Packed.unpack`."""
        with _opened(self.path, self._inside) as (container, _):
            for each, column in self.stored.items():
                name = self.meta.files[each]
                texels = decode(container.read(name, container.size(name)), container.where(name))
                for offset, count in ((0, len(texels)),) if each == _PALETTE else self._spans:
                    for start in range(offset, offset + count, _ROWS):
                        stop = min(start + _ROWS, offset + count)
                        yield np.ascontiguousarray(texels[start:stop, : column.shape[1]])
                del texels  # free the memory before the next texture is decoded

    def decode(self, columns: ColumnReader, start: int, stop: int) -> Splats:
        """Decode rows `start` to `stop`; see `Packed.decode`."""

        def texture(name: str) -> U8:
            span = (0, self.stored[name].shape[0]) if name == _PALETTE else (start, stop)
            return columns(name, *span)

        meta, degree = self.meta, self.info.sh_degree
        centres = _words(texture("means_l"), texture("means_u"))
        out: dict[str, Any] = {
            "means": _lookup(_coordinates(meta), centres),
            "quats": _quats(texture("quats")),
            "log_scales": _lookup(meta.scales, texture("scales")),
        }
        colour = texture("sh0")
        out["opacity_logits"] = meta.logits[colour[:, 3]]
        out["sh"] = np.empty((len(colour), (degree + 1) ** 2, 3), np.float32)
        out["sh"][:, 0] = _lookup(meta.sh0, colour[:, :3])
        if degree:
            self._fill_rest(texture, out["sh"])
        return Splats(**out, render_mode=meta.render_mode, notes=meta.notes)

    def _fill_rest(self, texture: Callable[[str], U8], sh: Array) -> None:
        """Fill in the higher coefficients: the palette entry that each row's label refers to."""
        n, coefficients = len(sh), sh.shape[1] - 1
        palette = self.meta.palette or PALETTE_COLUMNS * self._sizes[_PALETTE][1]
        texels = texture("shN_labels")
        labels = _words(texels[:, 0], texels[:, 1])
        if labels.max(initial=0) >= palette:
            with _opened(self.path, self._inside) as (container, _):
                where = container.where(self.meta.files["shN_labels"])
            raise refused(where, f"names entries beyond the palette's {palette}")
        entries = texture(_PALETTE).reshape(-1, coefficients, 3)
        if n < len(entries):  # decode only the entries that are used, which are fewer than all
            sh[:, 1:] = self.meta.sh_rest[entries[labels]]
            return
        centroids = self.meta.sh_rest[entries]
        for start in range(0, n, BLOCK_ROWS):
            sh[start : start + BLOCK_ROWS, 1:] = centroids[labels[start : start + BLOCK_ROWS]]


@contextmanager
def _opened(path: Path, inside: str) -> Iterator[tuple[Folder, str]]:
    """Open the container of a model's files; yield it and the name of the model's `meta.json`."""
    input_size(path)
    if not inside and is_manifest(path):
        yield Folder(path.parent), path.name
        return
    with reading(path) as file:
        yield Bundle(path, file, inside), META


def _sh_degree(container: Folder, meta: Meta) -> int:
    """Return the SH degree, from the width of the palette's texture if `meta.json` lacks it."""
    if meta.degree is not None:
        return meta.degree
    name = meta.files[_PALETTE]
    width, _ = size(container.read(name, HEAD_BYTES), container.where(name))
    if width not in _DEGREE_OF_WIDTH:
        raise refused(container.where(name), f"is {width} texels wide, not 192, 512 or 960")
    return _DEGREE_OF_WIDTH[width]


def _checked_sizes(container: Folder, meta: Meta, degree: int) -> dict[str, tuple[int, int]]:
    """Return the sizes that the textures state, checked against the count before decoding."""
    sizes = {}
    for texture, name in meta.files.items():
        where = container.where(name)
        width, height = sizes[texture] = size(container.read(name, HEAD_BYTES), where)
        if texture == _PALETTE:
            expected = PALETTE_COLUMNS * ((degree + 1) ** 2 - 1)
            needed = -(-(meta.palette or 1) // PALETTE_COLUMNS)
            most = PALETTE_MAX // PALETTE_COLUMNS
            fits = width == expected and needed <= height <= most
        else:
            # Writers pad textures to whole blocks, and some to powers of two.
            fits = meta.count <= width * height <= 4 * meta.count + HEAD_BYTES
        if not fits:
            raise refused(where, f"has {width} x {height} texels, which do not fit the model")
        if container.size(name) > 5 * width * height + HEAD_BYTES:
            raise refused(where, "is larger than its texels can be")
    return sizes


@lru_cache(maxsize=1)  # the slowest step of decoding a block of rows
def _coordinates(meta: Meta) -> F32:
    return meta.coordinates()


def _words(low: U8, high: U8) -> U16:
    """Combine low and high bytes to 16-bit numbers of the same shape."""
    words: U16 = np.stack([low, high], axis=-1).view("<u2")[..., 0]
    return words


def _lookup(values: Array, codes: Array) -> Array:
    """Look up (N, C) codes in a table for each channel; returns (N, C) values."""
    columns = [values[codes[:, channel], channel] for channel in range(codes.shape[1])]
    return np.stack(columns, axis=1)


def _quats(texels: U8) -> F32:
    """Decode quaternions, (N, 4) wxyz; A is 252 + the index of the left-out component.

    They have unit length by construction; other values of A give the identity.
    """
    part = (np.arange(CODES) / 255 * 2 - 1) / np.sqrt(2)
    out = np.empty((len(texels), 4), np.float32)
    for start in range(0, len(texels), BLOCK_ROWS):
        block = texels[start : start + BLOCK_ROWS]
        quats = whole_quats(part[block[:, :3]], block[:, 3].astype(np.int64) - 252)
        quats[block[:, 3] < 252] = 1, 0, 0, 0
        out[start : start + BLOCK_ROWS] = quats
    return out
