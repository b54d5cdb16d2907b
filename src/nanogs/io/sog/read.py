"""Reading SOG: `.sog`, which is one zip, and `meta.json` with its files beside it.

The layout is described in `meta`. Each value is looked up in a table of what its byte or code
stands for; the tables come from float64 and are rounded once. As in the other 8-bit formats, alpha
0 and 255 become logits of ∓inf.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from nanogs._types import F32, U8, U16, Array
from nanogs.errors import FormatError
from nanogs.io.container import Bundle, Container, Folder
from nanogs.io.files import BLOCK_ROWS, check_expansion, input_size, splat_bytes, unreadable
from nanogs.io.info import FileInfo
from nanogs.io.json_fields import parse
from nanogs.io.sog.meta import MAX_META_BYTES, PALETTE_COLUMNS, PALETTE_MAX, Meta, read_meta
from nanogs.io.sog.texture import HEAD_BYTES, decode, size
from nanogs.splats import Splats

META = "meta.json"
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


def inspect(path: Path) -> FileInfo:
    """Describe a model from its `meta.json` and the sizes of its files.

    Raises:
        FormatError: A file is missing or damaged, or has another size than it should.
    """
    with opened(path) as (container, name):
        meta = load_meta(container, name)
        degree = sh_degree(container, meta)
        return describe(path, meta, degree, _checked_bytes(container, name, meta, degree))


@contextmanager
def opened(path: Path) -> Iterator[tuple[Container, str]]:
    """The files of a model, and the name of its `meta.json` among them.

    Raises:
        FormatError: The file is missing, or a bundle is no zip.
    """
    input_size(path)
    if not path.name.lower().endswith(".sog"):
        yield Folder(path.parent), path.name
        return
    try:
        file = path.open("rb")
    except OSError as error:
        raise unreadable(path, error) from error
    with file:
        yield Bundle(path, file), META


def load_meta(container: Container, name: str) -> Meta:
    """Read and check a `meta.json`.

    Raises:
        FormatError: As for `inspect`.
    """
    where = container.where(name)
    if container.size(name) > MAX_META_BYTES:
        raise _error(where, "is too large for a description of textures")
    return read_meta(parse(container.read(name, MAX_META_BYTES), where), where)


def _checked_bytes(container: Container, name: str, meta: Meta, degree: int) -> int:
    """Bytes of a `meta.json` and of the files it names, its count checked against them."""
    file_bytes = container.bytes_on_disk({name, *meta.files.values()})
    check_expansion(container.where(name), meta.count * splat_bytes(degree), file_bytes)
    return file_bytes


def sh_degree(container: Container, meta: Meta) -> int:
    """The SH degree, from the palette's width where `meta.json` does not tell.

    Raises:
        FormatError: The palette is no lossless WebP file, or as wide as no degree's.
    """
    if meta.degree is not None:
        return meta.degree
    name = meta.files["shN_centroids"]
    width, _ = size(container.read(name, HEAD_BYTES), container.where(name))
    if width not in _DEGREE_OF_WIDTH:
        raise _error(container.where(name), f"is {width} texels wide, not 192, 512 or 960")
    return _DEGREE_OF_WIDTH[width]


def describe(path: Path, meta: Meta, degree: int, file_bytes: int) -> FileInfo:
    """The description of a model of which only the metadata is known."""
    return FileInfo(
        path=path,
        format="sog",
        encoding="webp",
        file_bytes=file_bytes,
        splats=meta.count,
        sh_degree=degree,
        properties=_PROPERTIES + (_PALETTE_PROPERTY if degree else ()),
        render_mode=meta.render_mode,
    )


class Model:
    """A model whose description and textures have been checked, but none of them decoded.

    Attributes:
        meta: Its description.
        degree: SH degree.
        sizes: Width and height of each texture.
    """

    def __init__(self, container: Container, name: str) -> None:
        self.meta = load_meta(container, name)
        self.degree = sh_degree(container, self.meta)
        _checked_bytes(container, name, self.meta, self.degree)
        self.sizes = _check_sizes(container, self.meta, self.degree)
        self._where = container.where(self.meta.files.get("shN_labels", name))
        self._table: F32 | None = None

    def _coordinates(self) -> F32:
        if self._table is None:  # which takes longer than all else here
            self._table = self.meta.coordinates()
        return self._table

    def shape(self, texture: str) -> tuple[int, int]:
        """How many texels of a texture, and how many bytes of each, hold something."""
        width, height = self.sizes[texture]
        rows = width * height if texture == "shN_centroids" else self.meta.count
        return rows, _CHANNELS[texture]

    def decoded(self, texture: Callable[[str], U8]) -> Splats:
        """The splats of some rows.

        Args:
            texture: These rows of a texture, or all of the palette; called once for each.

        Raises:
            FormatError: A row names an entry that the palette has not.
        """
        meta = self.meta
        out: dict[str, Any] = {
            "means": _lookup(self._coordinates(), _words(texture("means_l"), texture("means_u"))),
            "quats": _quats(texture("quats")),
            "log_scales": _lookup(meta.scales, texture("scales")),
        }
        colour = texture("sh0")
        out["opacity_logits"] = meta.logits[colour[:, 3]]
        out["sh"] = np.empty((len(colour), (self.degree + 1) ** 2, 3), np.float32)
        out["sh"][:, 0] = _lookup(meta.sh0, colour[:, :3])
        if self.degree:
            self._fill_rest(texture, out["sh"])
        return Splats(**out, render_mode=meta.render_mode, notes=meta.notes)

    def _fill_rest(self, texture: Callable[[str], U8], sh: Array) -> None:
        """Write the higher coefficients of the palette's entries that the labels name."""
        n, coefficients = len(sh), sh.shape[1] - 1
        palette = self.meta.palette or PALETTE_COLUMNS * self.sizes["shN_centroids"][1]
        texels = texture("shN_labels")
        labels = _words(texels[:, 0], texels[:, 1])
        if labels.max(initial=0) >= palette:
            raise _error(self._where, f"names entries beyond the palette's {palette}")
        entries = texture("shN_centroids").reshape(-1, coefficients, 3)
        if n < len(entries):  # those named are fewer than all
            sh[:, 1:] = self.meta.sh_rest[entries[labels]]
            return
        centroids = self.meta.sh_rest[entries]
        for start in range(0, n, BLOCK_ROWS):
            sh[start : start + BLOCK_ROWS, 1:] = centroids[labels[start : start + BLOCK_ROWS]]


def _check_sizes(container: Container, meta: Meta, degree: int) -> dict[str, tuple[int, int]]:
    """Compare the sizes that the textures state with the count, before any is decoded."""
    sizes = {}
    for texture, name in meta.files.items():
        where = container.where(name)
        width, height = sizes[texture] = size(container.read(name, HEAD_BYTES), where)
        if texture == "shN_centroids":
            expected = PALETTE_COLUMNS * ((degree + 1) ** 2 - 1)
            needed = -(-(meta.palette or 1) // PALETTE_COLUMNS)
            most = PALETTE_MAX // PALETTE_COLUMNS
            fits = width == expected and needed <= height <= most
        else:
            # Files are padded to whole blocks or, by some, to powers of two.
            fits = meta.count <= width * height <= 4 * meta.count + HEAD_BYTES
        if not fits:
            raise _error(where, f"has {width} x {height} texels, which do not fit the model")
        if container.size(name) > 5 * width * height + HEAD_BYTES:
            raise _error(where, "is larger than its texels can be")
    return sizes


def texels_of(container: Container, meta: Meta, texture: str) -> U8:
    """(P, 4) bytes of a texture whose size has been checked.

    Raises:
        FormatError: It cannot be read or decoded.
    """
    name = meta.files[texture]
    return decode(container.read(name, container.size(name)), container.where(name))


def _words(low: U8, high: U8) -> U16:
    """16-bit numbers of their bytes, in the same shape."""
    words: U16 = np.stack([low, high], axis=-1).view("<u2")[..., 0]
    return words


def _lookup(values: Array, codes: Array) -> Array:
    """(N, C) values of (N, C) codes, by a table for each channel."""
    columns = [values[codes[:, channel], channel] for channel in range(codes.shape[1])]
    return np.stack(columns, axis=1)


def _quats(texels: U8) -> Array:
    """(N, 4) wxyz: A says which part was the largest and is left out; unit by construction."""
    part = (np.arange(256) / 255 * 2 - 1) / np.sqrt(2)
    out = np.empty((len(texels), 4), np.float32)
    for start in range(0, len(texels), BLOCK_ROWS):
        block = texels[start : start + BLOCK_ROWS]
        small = part[block[:, :3]]
        left_out = np.sqrt(np.maximum(0, 1 - (small**2).sum(axis=1)))
        quats = np.tile([1.0, 0.0, 0.0, 0.0], (len(block), 1))
        for index in range(4):
            rows = block[:, 3] == 252 + index
            quats[rows] = np.insert(small[rows], index, left_out[rows], axis=1)
        out[start : start + BLOCK_ROWS] = quats
    return out


def _error(where: str, what: str) -> FormatError:
    return FormatError(f"{where} {what}; export or download the model again.")
