"""Reading SOG: `.sog`, which is one zip, and `meta.json` with its files beside it.

The layout is described in `meta`. A texture cannot be decoded in part, so the bytes of all are
unpacked, one after the other; rows of them are then looked up in tables of what codes stand
for. These come from float64 and are rounded once. As in the other 8-bit formats, alpha 0 and 255
become logits of ∓inf.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from nanogs._types import F32, U8, U16, Array
from nanogs.io.container import Bundle, Folder, damaged
from nanogs.io.files import BLOCK_ROWS, check_expansion, input_size, reading, splat_bytes
from nanogs.io.info import FileInfo
from nanogs.io.json_fields import parse
from nanogs.io.parts import Column, ColumnReader, Packed
from nanogs.io.rotations import whole_quats
from nanogs.io.sog.meta import CODES, MAX_META_BYTES, PALETTE_COLUMNS, PALETTE_MAX, Meta, read_meta
from nanogs.io.sog.texture import HEAD_BYTES, decode, size
from nanogs.splats import Splats

META = "meta.json"
_PALETTE = "shN_centroids"
_TEXEL = 25  # bytes that decoding holds for each, measured: copies of Pillow and ours
_ROWS = 1 << 16  # of a piece
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
    """A `.sog` file or a `meta.json`, of which some runs of rows, or all, are unpacked.

    Only what is asked for is read: first the description, then the beginnings of the textures.

    Args:
        path: The file.
        spans: (offset, count) of the runs of rows; all by default.
        inside: Folder of its files in a zip, which the file is, with a slash at its end.
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
                raise damaged(where, "is too large for a description of textures")
            return read_meta(parse(container.read(name, MAX_META_BYTES), where), where)

    @cached_property
    def info(self) -> FileInfo:
        """The description of all rows, the count checked against the sizes of the files."""
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
        """The description and its textures; see `FileSource`."""
        if self._inside or self.path.name.lower().endswith(".sog"):
            return (self.path,)
        names = dict.fromkeys(self.meta.files.values())
        return (self.path, *(self.path.parent / each for each in names))

    @cached_property
    def _sizes(self) -> dict[str, tuple[int, int]]:
        """Width and height that each texture states, none of them decoded."""
        degree = self.info.sh_degree
        with _opened(self.path, self._inside) as (container, _):
            return _checked_sizes(container, self.meta, degree)

    @property
    def _spans(self) -> Sequence[tuple[int, int]]:
        return ((0, self.meta.count),) if self._given is None else self._given

    @cached_property
    def stored(self) -> Mapping[str, Column]:
        """The textures; see `Packed`."""
        rows = dict.fromkeys(self._sizes, sum(count for _, count in self._spans))
        if _PALETTE in rows:
            width, height = self._sizes[_PALETTE]
            rows[_PALETTE] = width * height
        return {name: Column("|u1", (rows[name], _CHANNELS[name])) for name in rows}

    @cached_property
    def memory(self) -> int:
        """Bytes that decoding the largest texture takes."""
        with _opened(self.path, self._inside) as (container, _):
            packed = {each: container.size(name) for each, name in self.meta.files.items()}
        texels = {each: width * height for each, (width, height) in self._sizes.items()}
        return max(_TEXEL * texels[each] + 2 * packed[each] for each in texels)

    def unpack(self, _notes: list[str]) -> Iterator[Array]:
        """All columns; see `Packed`."""
        with _opened(self.path, self._inside) as (container, _):
            for each, column in self.stored.items():
                name = self.meta.files[each]
                texels = decode(container.read(name, container.size(name)), container.where(name))
                for offset, count in ((0, len(texels)),) if each == _PALETTE else self._spans:
                    for start in range(offset, offset + count, _ROWS):
                        stop = min(start + _ROWS, offset + count)
                        yield np.ascontiguousarray(texels[start:stop, : column.shape[1]])
                del texels  # before the next one is decoded

    def decode(self, columns: ColumnReader, start: int, stop: int) -> Splats:
        """Some rows; see `Packed`."""

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
        """Write the higher coefficients of the palette's entries that the labels name."""
        n, coefficients = len(sh), sh.shape[1] - 1
        palette = self.meta.palette or PALETTE_COLUMNS * self._sizes[_PALETTE][1]
        texels = texture("shN_labels")
        labels = _words(texels[:, 0], texels[:, 1])
        if labels.max(initial=0) >= palette:
            with _opened(self.path, self._inside) as (container, _):
                where = container.where(self.meta.files["shN_labels"])
            raise damaged(where, f"names entries beyond the palette's {palette}")
        entries = texture(_PALETTE).reshape(-1, coefficients, 3)
        if n < len(entries):  # those named are fewer than all
            sh[:, 1:] = self.meta.sh_rest[entries[labels]]
            return
        centroids = self.meta.sh_rest[entries]
        for start in range(0, n, BLOCK_ROWS):
            sh[start : start + BLOCK_ROWS, 1:] = centroids[labels[start : start + BLOCK_ROWS]]


@contextmanager
def _opened(path: Path, inside: str) -> Iterator[tuple[Folder, str]]:
    """The files of a model, and the name of its `meta.json` among them."""
    input_size(path)
    if not inside and not path.name.lower().endswith(".sog"):
        yield Folder(path.parent), path.name
        return
    with reading(path) as file:
        yield Bundle(path, file, inside), META


def _sh_degree(container: Folder, meta: Meta) -> int:
    """The SH degree, from the palette's width where `meta.json` does not tell."""
    if meta.degree is not None:
        return meta.degree
    name = meta.files[_PALETTE]
    width, _ = size(container.read(name, HEAD_BYTES), container.where(name))
    if width not in _DEGREE_OF_WIDTH:
        raise damaged(container.where(name), f"is {width} texels wide, not 192, 512 or 960")
    return _DEGREE_OF_WIDTH[width]


def _checked_sizes(container: Folder, meta: Meta, degree: int) -> dict[str, tuple[int, int]]:
    """Compare the sizes that the textures state with the count, before any is decoded."""
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
            # Files are padded to whole blocks or, by some, to powers of two.
            fits = meta.count <= width * height <= 4 * meta.count + HEAD_BYTES
        if not fits:
            raise damaged(where, f"has {width} x {height} texels, which do not fit the model")
        if container.size(name) > 5 * width * height + HEAD_BYTES:
            raise damaged(where, "is larger than its texels can be")
    return sizes


@lru_cache(maxsize=1)  # which takes longer than all else here
def _coordinates(meta: Meta) -> F32:
    return meta.coordinates()


def _words(low: U8, high: U8) -> U16:
    """16-bit numbers of their bytes, in the same shape."""
    words: U16 = np.stack([low, high], axis=-1).view("<u2")[..., 0]
    return words


def _lookup(values: Array, codes: Array) -> Array:
    """(N, C) values of (N, C) codes, by a table for each channel."""
    columns = [values[codes[:, channel], channel] for channel in range(codes.shape[1])]
    return np.stack(columns, axis=1)


def _quats(texels: U8) -> F32:
    """(N, 4) wxyz: A says which part was the largest and is left out; unit by construction."""
    part = (np.arange(CODES) / 255 * 2 - 1) / np.sqrt(2)
    out = np.empty((len(texels), 4), np.float32)
    for start in range(0, len(texels), BLOCK_ROWS):
        block = texels[start : start + BLOCK_ROWS]
        quats = whole_quats(part[block[:, :3]], block[:, 3].astype(np.int64) - 252)
        quats[block[:, 3] < 252] = 1, 0, 0, 0
        out[start : start + BLOCK_ROWS] = quats
    return out
