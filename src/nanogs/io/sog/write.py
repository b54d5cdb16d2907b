"""Writing SOG, version 2: `.sog`, which is one zip, or `meta.json` in a folder of its files.

The layout is described in `meta`. As PlayCanvas' own tool does, splats go in Morton order, so
that texels side by side are alike, and the zip packs nothing twice.
Codes are rounded to the nearest. The same model gives the same bytes.
"""

import json
import math
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from nanogs import spread
from nanogs._types import F32, F64, I64, U8, U16
from nanogs._version import __version__
from nanogs.errors import UnstorableError
from nanogs.formatting import counted
from nanogs.io import limits
from nanogs.io.container import plain_entry
from nanogs.io.folder import atomic_folder
from nanogs.io.json_fields import is_plain
from nanogs.io.palette import palette
from nanogs.io.precision import Precision, visibility
from nanogs.io.rotations import least_turned, split_quats
from nanogs.io.sog import meta as sog_meta
from nanogs.io.sog.codebook import codebook, nearest
from nanogs.io.sog.meta import CODES, LAST_CODE
from nanogs.io.sog.texture import MAX_SIDE, encode
from nanogs.morton import interleaved_bits
from nanogs.progress import Parts, untold
from nanogs.slices import slices
from nanogs.splats import RenderMode, Splats

MAX_DEGREE = 3
USUAL_BITS = 7  # with which files look no worse than those of PlayCanvas' own tool
_BLOCK = 4  # sides of textures are multiples of it
_GENERATOR = "nanogs"
_MODELS = {mode: name for name, mode in sog_meta.MODELS.items()}
# Entries of the codebook of a palette; a palette that rounds already needs fewer.
_EXACT, _ROUNDED = 64, 32
_SMALL_PALETTE = 1024  # models of so few splats keep a value each
_FARTHEST = 1e18  # squares of colours that far apart are still float32

Submit = Callable[[str, U8], None]
"""Starts the encoding of a texture, by name."""


_USUAL_PRECISION = Precision(USUAL_BITS)


@dataclass(frozen=True, slots=True)
class Packing:
    """How much a file may round off.

    Attributes:
        palette_size: Most entries of the palette of the higher coefficients, 1 to 65,536; by
            default `usual_palette`.
        precision: Of all else.
    """

    palette_size: int | None = None
    precision: Precision = _USUAL_PRECISION


USUAL = Packing()


def write(
    splats: Splats,
    file: BinaryIO,
    tell: Parts = untold,
    *,
    palette_size: int | None = None,
    bits: int = USUAL_BITS,
    spare: int | None = None,
) -> None:
    """Write a `.sog` file.

    Args:
        splats: The model.
        file: To write to.
        tell: Told of the parts of what takes long.
        palette_size: Most entries of the palette of the higher coefficients, 1 to 65,536; by
            default `usual_palette`.
        bits: Of a part of a rotation, 4 to 8; all else follows, see `Precision`.
        spare: Bits that centres do without, 0 to 6; by default they are as fine as splats are
            small.

    Raises:
        OutputError: A value is NaN, infinite or beyond what a codebook holds, or there are more
            splats than a texture holds; nothing has been written then.
    """
    files = contents(splats, None, tell, Packing(palette_size, Precision(bits, spare)))
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as bundle:
        for name, data in files.items():
            bundle.writestr(plain_entry(name), data)


def write_folder(
    splats: Splats,
    path: Path,
    *,
    overwrite: bool = False,
    palette_size: int | None = None,
    bits: int = USUAL_BITS,
    spare: int | None = None,
) -> None:
    """Write `meta.json` and its textures to a folder, which appears whole or not at all.

    Args:
        splats: The model.
        path: The folder.
        overwrite: Replace a folder that nanogs wrote.
        palette_size: As for `write`.
        bits: As for `write`.
        spare: As for `write`.

    Raises:
        OutputError: As for `write`, or the folder exists and may not be replaced, or it cannot be
            made.
    """
    packing = Packing(palette_size, Precision(bits, spare))
    with atomic_folder(path, ours, overwrite=overwrite) as folder:
        for name, data in contents(splats, packing=packing).items():
            (folder / name).write_bytes(data)


def contents(
    splats: Splats,
    groups: I64 | None = None,
    tell: Parts = untold,
    packing: Packing = USUAL,
) -> dict[str, bytes]:
    """The contents of `meta.json` and its textures by name.

    Args:
        splats: N splats.
        groups: (N,) numbers from 0 on. Splats go in their order, those of one group in Morton
            order; by default all are one group.
        tell: Told of the merges that the palette comes of.
        packing: How much may be rounded off.

    Raises:
        OutputError: As for `write`.
    """
    with encoders() as pool:
        return begun(pool, splats, groups, tell, packing)()


def encoders() -> ThreadPoolExecutor:
    """Threads that textures are encoded on, to be closed."""
    import numba

    return ThreadPoolExecutor(numba.get_num_threads())


def begun(
    pool: ThreadPoolExecutor,
    splats: Splats,
    groups: I64 | None = None,
    tell: Parts = untold,
    packing: Packing = USUAL,
) -> Callable[[], dict[str, bytes]]:
    """Compute the textures and leave their encoding to a pool.

    Args:
        pool: From `encoders`.
        splats: As for `contents`.
        groups: As for `contents`.
        tell: As for `contents`.
        packing: As for `contents`.

    Returns:
        What waits for the textures and gives the `contents`.

    Raises:
        OutputError: As for `write`.
    """
    _refuse_unstorable(splats)
    encoding: dict[str, Callable[[], bytes]] = {}

    def submit(name: str, texels: U8) -> None:
        future = spread.asked(pool, encode, texels)
        encoding[name] = future.result if future else partial(encode, texels)

    meta = _encode(splats, groups, packing, submit, tell)
    text = json.dumps(meta, separators=(",", ":"), allow_nan=False).encode()
    return lambda: {name: made() for name, made in encoding.items()} | {"meta.json": text}


def losses(splats: Splats) -> tuple[str, ...]:
    """Name what a SOG file cannot hold of a model, one sentence each."""
    left_out = limits.left_out(splats, ".sog", max_degree=MAX_DEGREE)
    return (*left_out, *limits.rounded(splats, ".sog"))


def _refuse_unstorable(splats: Splats) -> None:
    """Refuse a model that the file would hold in part, or with other values."""
    limits.refuse_unstorable(splats, ".sog")
    if len(splats) > MAX_SIDE**2 // 2:
        raise UnstorableError(
            f"{len(splats):,} splats are too many for one .sog file; simplify the model."
        )
    coefficients = splats.sh[:, : (MAX_DEGREE + 1) ** 2]
    scales = np.where(np.isneginf(splats.log_scales), 0, splats.log_scales)
    good = (np.abs(coefficients) <= _FARTHEST).all(axis=(1, 2))
    good &= (np.abs(scales) <= _FARTHEST).all(axis=1)
    if not good.all():
        raise UnstorableError(
            f"{counted(int((~good).sum()), 'splat holds', 'splats hold')} colour coefficients or"
            f" log-scales beyond ±{_FARTHEST:g}, the first in row {int(np.argmin(good))}, and"
            " .sog cannot hold them beside usual ones; correct them, or write .ply."
        )


def ours(folder: Path) -> frozenset[str] | None:
    """The names of a folder that nanogs wrote, or None for other folders."""
    try:
        data = json.loads((folder / "meta.json").read_text(encoding="utf-8"))
        if not str(data["asset"]["generator"]).startswith(_GENERATOR):
            return None
        named = [
            str(name)
            for own in data.values()
            if isinstance(own, dict)
            for name in own.get("files", [])
        ]
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return None
    # Plain names only: a description that someone changed must not lead out of its folder.
    return frozenset({"meta.json", *filter(is_plain, named)})


def _encode(
    splats: Splats, groups: I64 | None, packing: Packing, submit: Submit, tell: Parts
) -> dict[str, Any]:
    """Submit every texture; the contents of `meta.json`."""
    codes, bounds = _codes(splats, packing.precision)
    rows = _morton_order(codes, groups)
    codes = codes[rows]
    submit("means_l.webp", _picture((codes & 255).astype(np.uint8)))
    submit("means_u.webp", _picture((codes >> 8).astype(np.uint8)))
    splats, fine = splats.take(rows), packing.precision
    quats, log_scales = least_turned(splats)
    submit("quats.webp", _picture(_quats(quats, fine.rotation_step)))
    scales, colours = _codebooks((log_scales, fine.scales), (splats.sh[:, 0], fine.colours))
    submit("scales.webp", _picture(nearest(log_scales, scales)))
    rgba = np.column_stack([nearest(splats.sh[:, 0], colours), _alphas(splats, fine.alphas)])
    submit("sh0.webp", _picture(rgba))
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": f"{_GENERATOR} {__version__}"},
        "count": len(rows),
        "model": _MODELS[splats.render_mode],
        "means": bounds | {"files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": _short(scales), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": _short(colours), "files": ["sh0.webp"]},
    }
    if splats.render_mode is RenderMode.DEFAULT:
        del meta["model"]  # as untagged as the files of older writers
    if splats.sh_degree:
        meta["shN"] = _higher(splats, packing, submit, tell)
    return meta


def _codebooks(*wanted: tuple[F32, int]) -> list[F32]:
    """A codebook of each of some values, of so many entries."""
    return spread.results(wanted, lambda values: codebook(*values))


def spare_bits(splats: Splats, bits: int = USUAL_BITS) -> int:
    """Bits that centres do without unless told otherwise, as `write` has it for so many bits."""
    return _spare(splats, Precision(bits), _bounds(_logarithms(splats))[2])


def _logarithms(splats: Splats) -> F64:
    """(N, 3) signed logarithms of 1 and the coordinates."""
    logarithms = np.empty((len(splats), 3))

    def take(rows: slice) -> None:
        some, means = logarithms[rows], splats.means[rows]
        np.copysign(np.log1p(np.abs(means, dtype=np.float64), out=some), means, out=some)

    spread.each(slices(len(splats)), take)
    return logarithms


def _bounds(logarithms: F64) -> tuple[F64, F64, F64]:
    """(3,) the least and the largest logarithms, and how far these are apart, 1 where they meet."""
    low, high = logarithms.min(axis=0), logarithms.max(axis=0)
    return low, high, np.where(high > low, high - low, 1)


def _spare(splats: Splats, precision: Precision, range_: F64) -> int:
    """Bits that centres do without, whose logarithms reach so far."""
    apart = range_ / LAST_CODE
    # A step of the logarithm of 1 + |x| is one of x times 1 + |x|.
    return precision.spare_bits([splats], lambda s: (1 + np.abs(s.means, dtype=np.float64)) * apart)


def _codes(splats: Splats, precision: Precision) -> tuple[U16, dict[str, list[float]]]:
    """(N, 3) codes of the coordinates' signed logarithms, and the bounds that they lie between."""
    logarithms = _logarithms(splats)
    low, high, range_ = _bounds(logarithms)
    step = 1 << _spare(splats, precision, range_)
    steps = LAST_CODE // step  # the last code that is used stands for the highest
    codes = np.empty((len(splats), 3), np.uint16)

    def encode_rows(rows: slice) -> None:
        codes[rows] = np.rint((logarithms[rows] - low) / range_ * steps) * step

    spread.each(slices(len(splats)), encode_rows)
    highest = low + range_ * (LAST_CODE / (steps * step))
    return codes, {"mins": low.tolist(), "maxs": np.where(high > low, highest, high).tolist()}


def _morton_order(codes: U16, groups: I64 | None) -> I64:
    """Rows by their group, then by the interleaved bits of their codes; ties as they come."""
    key = np.zeros(len(codes), np.uint64)
    for axis in range(3):
        key |= interleaved_bits(codes[:, axis].astype(np.uint64), axis)
    return np.argsort(key, kind="stable") if groups is None else np.lexsort((key, groups))


def _quats(quats: F64, step: int) -> U8:
    """(N, 4): the three smaller parts of wxyz, the sign such that the largest is positive."""
    out = np.empty((len(quats), 4), np.uint8)

    def pack(rows: slice) -> None:
        largest, small = split_quats(quats[rows])
        codes = 255 * np.clip(small / math.sqrt(2) + 0.5, 0, 1)
        out[rows, :3] = np.minimum(np.rint(codes / step), 255 // step) * step
        out[rows, 3] = 252 + largest

    spread.each(slices(len(quats)), pack)
    return out


def _alphas(splats: Splats, steps: int) -> U8:
    """(N,) the nearest of so many steps from 0 to 255, both of them too."""
    alphas: U8 = np.rint(np.rint(splats.opacities() * steps) * (255 / steps)).astype(np.uint8)
    return alphas


def _higher(splats: Splats, packing: Packing, submit: Submit, tell: Parts) -> dict[str, Any]:
    """Submit the palette of the higher coefficients and the labels; their part of `meta.json`."""
    degree = min(splats.sh_degree, MAX_DEGREE)
    coefficients = (degree + 1) ** 2 - 1
    points = splats.sh[:, 1 : coefficients + 1].reshape(len(splats), -1)
    size = packing.palette_size or usual_palette(len(splats))
    found = palette(points, size, visibility(splats), tell)
    kept = found.exact and (len(found.entries) == len(splats) or _few_values(found.entries))
    book = codebook(found.entries, _EXACT if kept else _ROUNDED)
    count = len(found.entries)
    height = -(-count // sog_meta.PALETTE_COLUMNS)
    texels = np.zeros((height * sog_meta.PALETTE_COLUMNS, coefficients, 3), np.uint8)
    texels[:count] = nearest(found.entries, book).reshape(count, coefficients, 3)
    submit("shN_centroids.webp", texels.reshape(height, -1, 3))
    labels = found.labels.astype(np.uint16)
    nothing = np.zeros(len(labels), np.uint8)
    submit(
        "shN_labels.webp",
        _picture(np.column_stack([labels & 255, labels >> 8, nothing]).astype(np.uint8)),
    )
    return {
        "count": count,
        "bands": degree,
        "codebook": _short(book),
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }


def _few_values(entries: F32) -> bool:
    """Whether entries are of a codebook already, and not the means of splats that share them."""
    return len(np.unique(entries)) <= CODES


def usual_palette(count: int) -> int:
    """Entries for so many splats: two for three, but one each in small models.

    With as many, files look better than those of PlayCanvas' own tool. With fewer, a file of the
    same bytes can hold more splats, which often looks better still.
    """
    return min(max(count * 2 // 3, _SMALL_PALETTE), sog_meta.PALETTE_MAX)


def _picture(texels: U8) -> U8:
    """(N, C) bytes as an almost square picture, filled up with zeros."""
    count, channels = texels.shape
    width = _BLOCK * math.ceil(math.sqrt(count) / _BLOCK)
    height = _BLOCK * math.ceil(count / width / _BLOCK)
    out = np.zeros((height * width, channels), np.uint8)
    out[:count] = texels
    return out.reshape(height, width, channels)


def _short(values: F32) -> list[float]:
    """Numbers with no more digits than single precision needs; unused entries, which repeat, are 0.

    Small files have thousands of bytes of them otherwise.
    """
    used = np.diff(values, prepend=np.float32(np.nan)) != 0
    return [float(str(v)) if own else 0 for v, own in zip(values, used, strict=True)]
