"""Reading SOG: `.sog`, which is one zip, and `meta.json` with its files beside it.

The layout is described in `sog_meta`. Each value is looked up in a table of what its byte or code
stands for; the tables come from float64 and are rounded once. As in the other 8-bit formats, alpha
0 and 255 become logits of ∓inf.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from nanogs._types import U8, U16, Array
from nanogs.errors import FormatError
from nanogs.io.container import Bundle, Container, Folder
from nanogs.io.files import BLOCK_ROWS, check_expansion, input_size, splat_bytes, unreadable
from nanogs.io.info import FileInfo
from nanogs.io.json_fields import parse
from nanogs.io.sog_meta import MAX_META_BYTES, PALETTE_COLUMNS, PALETTE_MAX, Meta, read_meta
from nanogs.io.texture import HEAD_BYTES, decode, size
from nanogs.splats import Splats

META = "meta.json"
_PROPERTIES = (
    ("means", "ushort"),
    ("quats", "uchar"),
    ("scales", "uchar"),
    ("sh0", "uchar"),
    ("opacity", "uchar"),
)
_PALETTE_PROPERTY = (("shN_labels", "ushort"),)
_DEGREE_OF_WIDTH = {PALETTE_COLUMNS * ((d + 1) ** 2 - 1): d for d in (1, 2, 3)}


def read(path: Path) -> Splats:
    """Read a `.sog` file or the folder that a `meta.json` describes.

    Raises:
        FormatError: A file is missing or damaged, or has another size than it should.
    """
    with opened(path) as (container, name):
        return read_model(container, name)


def inspect(path: Path) -> FileInfo:
    """Describe a model from its `meta.json` and the sizes of its files.

    Raises:
        FormatError: As for `read`, except for what only the textures show.
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
        FormatError: As for `read`, except for what only the textures show.
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
        double_means=False,
        properties=_PROPERTIES + (_PALETTE_PROPERTY if degree else ()),
        extras=(),
        elements=(),
        render_mode=meta.render_mode,
        comments=(),
    )


def read_model(container: Container, name: str) -> Splats:
    """Read the model that a `meta.json` describes.

    Raises:
        FormatError: As for `read`.
    """
    meta = load_meta(container, name)
    degree = sh_degree(container, meta)
    _checked_bytes(container, name, meta, degree)
    sizes = _check_sizes(container, meta, degree)
    n = meta.count
    out: dict[str, Any] = {
        "means": _means(container, meta),
        "quats": _quats(_texture(container, meta, "quats")[:n]),
        "log_scales": _lookup(meta.scales, _texture(container, meta, "scales")[:n, :3]),
    }
    colour = _texture(container, meta, "sh0")[:n]
    out["opacity_logits"] = meta.logits[colour[:, 3]]
    out["sh"] = np.empty((n, (degree + 1) ** 2, 3), np.float32)
    out["sh"][:, 0] = _lookup(meta.sh0, colour[:, :3])
    if degree:
        slots = PALETTE_COLUMNS * sizes["shN_centroids"][1]
        _fill_rest(container, meta, out["sh"], meta.palette or slots)
    return Splats(**out, render_mode=meta.render_mode, notes=meta.notes)


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


def _texture(container: Container, meta: Meta, texture: str) -> U8:
    """(P, 4) bytes of a texture whose size has been checked."""
    name = meta.files[texture]
    return decode(container.read(name, container.size(name)), container.where(name))


def _means(container: Container, meta: Meta) -> Array:
    """(N, 3): what the codes made of a low and a high byte stand for, axis by axis."""
    low, high = (
        _texture(container, meta, name)[: meta.count, :3] for name in ("means_l", "means_u")
    )
    return _lookup(meta.coordinates, _words(low, high))


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


def _fill_rest(container: Container, meta: Meta, sh: Array, palette: int) -> None:
    """Write the higher coefficients of the palette's entries that the labels name."""
    n, coefficients = len(sh), sh.shape[1] - 1
    texels = _texture(container, meta, "shN_labels")[:n]
    labels = _words(texels[:, 0], texels[:, 1])
    if labels.max() >= palette:
        name = meta.files["shN_labels"]
        raise _error(container.where(name), f"names entries beyond the palette's {palette}")
    palette_texels = _texture(container, meta, "shN_centroids")[:, :3]
    centroids = meta.sh_rest[palette_texels].reshape(-1, coefficients, 3)
    for start in range(0, n, BLOCK_ROWS):
        sh[start : start + BLOCK_ROWS, 1:] = centroids[labels[start : start + BLOCK_ROWS]]


def _error(where: str, what: str) -> FormatError:
    return FormatError(f"{where} {what}; export or download the model again.")
