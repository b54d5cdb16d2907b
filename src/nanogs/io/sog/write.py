"""Writing SOG, version 2: `.sog`, which is one zip, or `meta.json` in a folder of its files.

The layout is described in `meta`. As in PlayCanvas' own tool, splats are in Morton order, so that
neighbouring texels are similar, and the zip stores the WebP files without compressing them again.
Values are rounded to the nearest code. The same model gives the same bytes.
"""

import json
import math
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from nanogs import parallel
from nanogs._types import F32, F64, I64, U8, U16, Bool
from nanogs.activations import BYTE_LOGITS
from nanogs.errors import UnstorableError
from nanogs.formatting import counted
from nanogs.io import limits
from nanogs.io.container import plain_entry
from nanogs.io.folder import atomic_folder
from nanogs.io.format import Sharing
from nanogs.io.generator import GENERATOR, read_own
from nanogs.io.json_fields import is_plain
from nanogs.io.palette import palette
from nanogs.io.precision import Precision, visibility
from nanogs.io.rate_distortion import Quantisation
from nanogs.io.registry import META
from nanogs.io.rotations import Rounding, minimise_rotation, split_quats
from nanogs.io.sog import meta as sog_meta
from nanogs.io.sog.codebook import codebook, nearest
from nanogs.io.sog.meta import CODES, LAST_CODE
from nanogs.io.sog.texture import MAX_SIDE, encode
from nanogs.morton import interleaved_bits
from nanogs.progress import PartProgress, ignore_progress
from nanogs.slices import slices
from nanogs.splats import RenderMode, Splats

MAX_DEGREE = 3
USUAL_BITS = 7  # default; files then look no worse than those of PlayCanvas' own tool
_BLOCK = 4  # width and height of textures are multiples of it
_MODELS = {mode: name for name, mode in sog_meta.MODELS.items()}
# Bits of a code of the harmonics: of an exact palette, and of merged values, which need fewer.
_EXACT_BITS, MERGED_BITS = 6, 5
# By default a palette has two entries for three splats, and one each in small models. Files then
# look better than those of PlayCanvas' own tool. With a smaller palette, a file of the same size
# can hold more splats, which often looks better still.
USUAL_PALETTE = Sharing(1.5, sog_meta.PALETTE_MAX, 1024)
_LARGEST_LOGARITHM = math.log1p(float(np.finfo(np.float32).max))  # of a centre, log(1 + |x|)
_FARTHEST = 1e18  # largest magnitude of a value: squared differences must not overflow float32
_VALUES = f"colour coefficients or log-scales beyond ±{_FARTHEST:g}"

Submit = Callable[[str, U8], None]
"""Starts the encoding of a texture, by name."""


_USUAL_PRECISION = Precision(USUAL_BITS)


@dataclass(frozen=True, slots=True)
class SogOptions:
    """How the values of a file are quantised; see `write`.

    Attributes:
        palette_size: Largest number of entries of the palette of the higher coefficients, 1 to
            65,536; by default `USUAL_PALETTE`.
        precision: Precision of all other values.
        sh_bits: Bits of the codes of these coefficients, 2 to 8; by default 5, or 6 if the palette
            holds the very coefficients of the splats and not means of several.
    """

    palette_size: int | None = None
    precision: Precision = _USUAL_PRECISION
    sh_bits: int | None = None


USUAL_OPTIONS = SogOptions()


def write(
    splats: Splats,
    file: BinaryIO,
    on_progress: PartProgress = ignore_progress,
    *,
    palette_size: int | None = None,
    bits: int = USUAL_BITS,
    sh_bits: int | None = None,
    spare: int | None = None,
) -> None:
    """Write a `.sog` file.

    Args:
        splats: The model.
        file: The file to write to.
        on_progress: Progress callback for computing the palette.
        palette_size: Largest number of entries of the palette of the higher coefficients, 1 to
            65,536; by default `USUAL_PALETTE`.
        bits: Bits of a component of a rotation, 4 to 8; all else follows, see `Precision`.
        sh_bits: Bits of the codes of the higher coefficients, 2 to 8; see `SogOptions`.
        spare: Bits that are dropped from centres, 0 to 6; by default the smaller the splats, the
            fewer.

    Raises:
        OutputError: A value is NaN, infinite or too large for a codebook, or there are too many
            splats for a texture; nothing has been written then.
    """
    options = SogOptions(palette_size, Precision(bits, spare), sh_bits)
    files = contents(splats, on_progress, options)
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as bundle:
        for name, data in files.items():
            bundle.writestr(plain_entry(name), data)


def write_folder(
    splats: Splats,
    path: Path,
    on_progress: PartProgress = ignore_progress,
    *,
    overwrite: bool = False,
    palette_size: int | None = None,
    bits: int = USUAL_BITS,
    sh_bits: int | None = None,
    spare: int | None = None,
) -> None:
    """Write `meta.json` and its textures to a folder, which appears whole or not at all.

    Args:
        splats: The model.
        path: The folder.
        on_progress: As for `write`.
        overwrite: Replace a folder that nanogs wrote.
        palette_size: As for `write`.
        bits: As for `write`.
        sh_bits: As for `write`.
        spare: As for `write`.

    Raises:
        OutputError: As for `write`, or the folder exists and may not be replaced, or it cannot be
            made.
    """
    options = SogOptions(palette_size, Precision(bits, spare), sh_bits)
    with atomic_folder(path, ours, overwrite=overwrite) as folder:
        for name, data in contents(splats, on_progress, options).items():
            (folder / name).write_bytes(data)


def contents(
    splats: Splats,
    on_progress: PartProgress = ignore_progress,
    options: SogOptions = USUAL_OPTIONS,
) -> dict[str, bytes]:
    """Encode a model; return the contents of `meta.json` and its textures by file name.

    Args:
        splats: N splats.
        on_progress: Progress callback for computing the palette.
        options: How values are quantised.

    Raises:
        OutputError: As for `write`.
    """
    with encoders() as pool:
        return start_encoding(pool, splats, None, on_progress, options)()


def encoders() -> ThreadPoolExecutor:
    """Make a thread pool for encoding textures, to be closed by the caller."""
    import numba

    return ThreadPoolExecutor(numba.get_num_threads())


def start_encoding(
    pool: ThreadPoolExecutor,
    splats: Splats,
    groups: I64 | None = None,
    on_progress: PartProgress = ignore_progress,
    options: SogOptions = USUAL_OPTIONS,
) -> Callable[[], dict[str, bytes]]:
    """Compute the textures and submit their WebP encoding to a thread pool.

    Args:
        pool: From `encoders`.
        splats: N splats.
        groups: (N,) group numbers from 0 on. Splats are sorted by group, and in Morton order within
            a group; by default all are one group.
        on_progress: As for `contents`.
        options: As for `contents`.

    Returns:
        A function that waits for the encoding and returns the same as `contents`.

    Raises:
        OutputError: As for `write`.
    """
    _refuse_unstorable(splats)
    encoding: dict[str, Callable[[], bytes]] = {}

    def submit(name: str, texels: U8) -> None:
        future = parallel.try_submit(pool, encode, texels)
        encoding[name] = future.result if future else partial(encode, texels)

    meta = _encode(splats, groups, options, submit, on_progress)
    text = json.dumps(meta, separators=(",", ":"), allow_nan=False).encode()
    return lambda: {name: made() for name, made in encoding.items()} | {META: text}


def losses(splats: Splats) -> tuple[str, ...]:
    """Name what a SOG file leaves out, or why it refuses the model, one sentence each."""
    refused = limits.refusal(int(_beyond(splats).sum()), ".sog", _VALUES)
    left_out = limits.left_out(splats, ".sog", max_degree=MAX_DEGREE)
    return (*refused, *left_out, *limits.rounded(splats, ".sog"))


def _refuse_unstorable(splats: Splats) -> None:
    """Refuse a model with values that the file cannot hold, or with too many splats."""
    limits.refuse_unstorable(splats, ".sog")
    if len(splats) > MAX_SIDE**2 // 2:
        raise UnstorableError(
            f"{len(splats):,} splats are too many for one .sog file; simplify the model."
        )
    if (wrong := _beyond(splats)).any():
        raise UnstorableError(
            f"{counted(int(wrong.sum()), 'splat holds', 'splats hold')} {_VALUES}, the first in row"
            f" {int(np.argmax(wrong))}, which .sog cannot hold together with ordinary ones; correct"
            " them, or write .ply."
        )


def _beyond(splats: Splats) -> Bool:
    """Return an (N,) bool mask of the splats that hold some of `_VALUES`."""
    beyond = np.zeros(len(splats), bool)

    def look(rows: slice) -> None:
        for values in (splats.sh[rows, : (MAX_DEGREE + 1) ** 2], splats.log_scales[rows]):
            with np.errstate(invalid="ignore"):  # signalling NaNs would warn
                large = (np.abs(values) > _FARTHEST) & np.isfinite(values)
            beyond[rows] |= large.reshape(len(values), -1).any(axis=1)

    parallel.for_each(slices(len(splats)), look)
    return beyond


def ours(folder: Path) -> frozenset[str] | None:
    """Return the names of the files in a folder that nanogs wrote, or None for other folders."""
    data = read_own(folder / META, "asset", "generator")
    if data is None:
        return None
    lists = [own.get("files") for own in data.values() if isinstance(own, dict)]
    named = [str(name) for each in lists if isinstance(each, list) for name in each]
    # Plain names only: a manipulated meta.json must not name files outside its folder.
    return frozenset({META, *filter(is_plain, named)})


def _encode(
    splats: Splats,
    groups: I64 | None,
    options: SogOptions,
    submit: Submit,
    on_progress: PartProgress,
) -> dict[str, Any]:
    """Compute and submit every texture, and return the contents of `meta.json`."""
    precision = options.precision
    scales, colours = _codebooks(splats, precision)
    codes, bounds = _codes(splats, scales, precision)
    rows = _morton_order(codes, groups)
    codes = codes[rows]
    submit("means_l.webp", _picture((codes & 255).astype(np.uint8)))
    submit("means_u.webp", _picture((codes >> 8).astype(np.uint8)))
    splats = splats.take(rows)
    flat = splats.render_mode is RenderMode.SURFEL
    rounding = _rounding(precision.rotation_step)
    quats, log_scales = minimise_rotation(splats, rounding, third_stays=flat)
    submit("quats.webp", _picture(_quats(quats, precision.rotation_step, without_w=flat)))
    submit("scales.webp", _picture(nearest(log_scales, scales)))
    alphas = _alphas(splats, precision.alpha_steps)
    submit("sh0.webp", _picture(np.column_stack([nearest(splats.sh[:, 0], colours), alphas])))
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": GENERATOR},
        "count": len(rows),
        "model": _MODELS[splats.render_mode],
        "means": bounds | {"files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": _short(scales), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": _short(colours), "files": ["sh0.webp"]},
    }
    if splats.render_mode is RenderMode.DEFAULT:
        del meta["model"]  # older writers do not tag the default either
    if splats.sh_degree:
        meta["shN"] = _higher(splats, options, submit, on_progress)
    return meta


def _codebooks(splats: Splats, precision: Precision) -> tuple[F32, F32]:
    """Compute the codebooks of the log-scales and of the base colours, in parallel."""
    wanted = (splats.log_scales, precision.scale_codes), (splats.sh[:, 0], precision.colour_codes)
    scales, colours = parallel.map_ordered(wanted, lambda values: codebook(*values))
    return scales, colours


def spare_bits(splats: Splats, bits: int = USUAL_BITS) -> int:
    """Compute the default of `spare` that `write` uses for a model and `bits`."""
    precision = Precision(bits)
    return _grid(splats, codebook(splats.log_scales, precision.scale_codes), precision).spare


def quantisation(splats: Splats, bits: int = USUAL_BITS, spare: int | None = None) -> Quantisation:
    """Return the values that `write` can give a model with `bits` and `spare`."""
    precision = Precision(bits, spare)
    scales, colours = _codebooks(splats, precision)
    grid = _grid(splats, scales, precision)
    levels = np.arange(precision.alpha_steps + 1) / precision.alpha_steps
    codes = np.arange(0, CODES, precision.rotation_step)
    return Quantisation(
        centres=(_centres(splats, grid, 1), _centres(splats, grid, 2)),
        log_scales=np.unique(scales),
        logits=BYTE_LOGITS[_alpha_codes(levels, precision.alpha_steps)],
        colours=np.unique(colours),
        # A surfel keeps its third axis, so that w need not be the largest component.
        rotations=None if splats.render_mode is RenderMode.SURFEL else _restored(codes),
    )


def _sizes_as_decoded(splats: Splats, scales: F32, precision: Precision) -> Splats:
    """Return the model with the scales and opacities that reading it again gives.

    Bits are spared by these, so that a model that was read is written with as many as before.

    Args:
        splats: N splats.
        scales: (256,) codebook of the log-scales.
        precision: Precision of the alphas.
    """
    return replace(
        splats,
        log_scales=scales[nearest(splats.log_scales, scales)],
        opacity_logits=BYTE_LOGITS[_alphas(splats, precision.alpha_steps)],
    )


def _logarithms(splats: Splats) -> F64:
    """Compute the signed logarithms of the coordinates, sign(x) log(1 + |x|), (N, 3)."""
    logarithms = np.empty((len(splats), 3))

    def take(rows: slice) -> None:
        some, means = logarithms[rows], splats.means[rows].astype(np.float32)  # as they are read
        np.copysign(np.log1p(np.abs(means, dtype=np.float64), out=some), means, out=some)

    parallel.for_each(slices(len(splats)), take)
    return logarithms


def _bounds(logarithms: F64) -> tuple[F64, F64, F64]:
    """Return the minimum, the maximum and the range of each axis, (3,); a range of zero is 1."""
    low, high = logarithms.min(axis=0), logarithms.max(axis=0)
    return low, high, np.where(high > low, high - low, 1)


def _spare(splats: Splats, scales: F32, precision: Precision, low: F64, range_: F64) -> int:
    """Compute the bits to drop from centres; signed logarithms begin at `low` and span `range_`.

    Args:
        splats: N splats.
        scales: (256,) codebook of the log-scales.
        precision: Precision of the file; if it states the bits, nothing is decoded.
        low: (3,) least signed logarithm of each axis.
        range_: (3,) range of these.

    Raises:
        UnstorableError: The bits that were asked for do not leave a file that can be read.
    """
    apart = range_ / LAST_CODE

    def steps(block: Splats) -> F64:
        """Return the steps of x, (R, 3): a step d of log(1 + |x|) is a step (1 + |x|) d of x."""
        return (1 + np.abs(block.means, dtype=np.float64)) * apart

    stated = precision.spare is not None
    decoded = [] if stated else [_sizes_as_decoded(splats, scales, precision)]
    found = precision.spare_bits(decoded, steps)
    if not found or (low + _stretched(range_, 1 << found)).max() <= _LARGEST_LOGARITHM:
        return found
    if not stated:
        return 0
    raise UnstorableError(
        f"Centres are so near to the end of single precision that `spare_bits={found}` leaves no"
        " room for them in .sog; give 0, or scale the model down."
    )


def _stretched(range_: F64, step: int) -> F64:
    """Return the range of all codes, of which the last that is used is mapped to the maximum."""
    return range_ * (LAST_CODE / (LAST_CODE // step * step))


class _Grid(NamedTuple):
    """The codes of centres: signed logarithms in equal steps.

    Attributes:
        places: (N, 3) float64, places of the centres in steps from the lowest.
        low: (3,) least signed logarithm of each axis.
        high: (3,) greatest one.
        range: (3,) their range, or 1 where it is zero.
        spare: Number of last bits that all codes leave out.
    """

    places: F64
    low: F64
    high: F64
    range: F64
    spare: int

    @property
    def steps(self) -> int:
        """The highest place, of the greatest signed logarithm."""
        return LAST_CODE >> self.spare


def _grid(splats: Splats, scales: F32, precision: Precision) -> _Grid:
    """Place the centres on the grid of a file; `scales` is the codebook of the log-scales."""
    places = _logarithms(splats)
    low, high, range_ = _bounds(places)
    spare = _spare(splats, scales, precision, low, range_)
    grid = _Grid(places, low, high, range_, spare)

    def place(rows: slice) -> None:
        places[rows] = (places[rows] - low) / range_ * grid.steps

    parallel.for_each(slices(len(splats)), place)
    return grid


def _centres(splats: Splats, grid: _Grid, step: int) -> F32:
    """Return the centres, (N, 3), rounded to places that are multiples of the step.

    Those at both ends of an axis stay, since the grid spans them.
    """
    ends = (grid.places <= 0) | (grid.places >= grid.steps)
    places = np.minimum(np.rint(grid.places / step), grid.steps // step) * step
    logarithms = grid.low + places / grid.steps * grid.range
    rounded = np.copysign(np.expm1(np.abs(logarithms)), logarithms)
    return np.where(ends, splats.means, rounded).astype(np.float32)


def _codes(splats: Splats, scales: F32, precision: Precision) -> tuple[U16, dict[str, list[float]]]:
    """Quantise the coordinates' signed logarithms to (N, 3) codes; return these and the bounds."""
    grid = _grid(splats, scales, precision)
    codes = np.empty((len(splats), 3), np.uint16)

    def encode_rows(rows: slice) -> None:
        codes[rows] = np.rint(grid.places[rows]) * (1 << grid.spare)

    parallel.for_each(slices(len(splats)), encode_rows)
    highest = grid.low + _stretched(grid.range, 1 << grid.spare)
    highest = np.where(grid.high > grid.low, highest, grid.high)
    return codes, {"mins": grid.low.tolist(), "maxs": highest.tolist()}


def _morton_order(codes: U16, groups: I64 | None) -> I64:
    """Sort rows by group, then by Morton code of their codes; the order of ties is kept."""
    key = np.zeros(len(codes), np.uint64)
    for axis in range(3):
        key |= interleaved_bits(codes[:, axis].astype(np.uint64), axis)
    return np.argsort(key, kind="stable") if groups is None else np.lexsort((key, groups))


def _quats(quats: F64, step: int, *, without_w: bool) -> U8:
    """Encode wxyz quaternions, (N, 4): three smaller components, and 252 + index of the largest.

    A quaternion is negated where its largest component is negative.

    Args:
        quats: (N, 4) unit quaternions.
        step: Codes of components are multiples of it.
        without_w: Whether w is left out in any case, also where rounding made another one larger.
    """
    out = np.empty((len(quats), 4), np.uint8)

    def pack(rows: slice) -> None:
        left_out = np.zeros(len(quats[rows]), np.int64) if without_w else None
        largest, small = split_quats(quats[rows], left_out)
        out[rows, :3] = _components(small, step)
        out[rows, 3] = 252 + largest

    parallel.for_each(slices(len(quats)), pack)
    return out


def _components(small: F64, step: int) -> F64:
    """Return the codes, multiples of the step, of components from -√½ to √½."""
    codes = 255 * np.clip(small / math.sqrt(2) + 0.5, 0, 1)
    whole: F64 = np.minimum(np.rint(codes / step), 255 // step) * step
    return whole


def _restored(codes: F64 | I64) -> F64:
    """Return the components of rotations that codes stand for."""
    restored: F64 = (codes / 255 - 0.5) * math.sqrt(2)
    return restored


def _rounding(step: int) -> Rounding:
    """Return how components of rotations are rounded to codes that are multiples of the step."""
    return Rounding(
        lambda small: _restored(_components(small, step)),
        step / 255 * math.sqrt(0.5),
    )


def _alphas(splats: Splats, steps: int) -> U8:
    """Round alphas to the nearest of `steps` + 1 levels from 0 to 255, both included, (N,)."""
    return _alpha_codes(splats.opacities(), steps)


def _alpha_codes(alphas: F64, steps: int) -> U8:
    codes: U8 = np.rint(np.rint(alphas * steps) * (255 / steps)).astype(np.uint8)
    return codes


def _higher(
    splats: Splats, options: SogOptions, submit: Submit, on_progress: PartProgress
) -> dict[str, Any]:
    """Submit the palette of the higher coefficients and its labels; return `shN` of `meta.json`."""
    degree = min(splats.sh_degree, MAX_DEGREE)
    coefficients = (degree + 1) ** 2 - 1
    points = splats.sh[:, 1 : coefficients + 1].reshape(len(splats), -1)
    size = options.palette_size or USUAL_PALETTE.entries(len(splats))
    found = palette(points, size, visibility(splats), on_progress)
    entries = len(found.entries)
    # A full palette may hold harmonics that were merged before, even if it is exact now.
    full = size <= entries < len(splats)
    unmerged = found.exact and (not full or _few_values(found.entries))
    sh_bits = options.sh_bits or (_EXACT_BITS if unmerged else MERGED_BITS)
    book = codebook(found.entries, 1 << sh_bits)
    codes = nearest(found.entries, book)
    distinct = palette(codes.astype(np.float32), len(codes))  # each is written once
    count = len(distinct.entries)
    height = -(-count // sog_meta.PALETTE_COLUMNS)
    texels = np.zeros((height * sog_meta.PALETTE_COLUMNS, coefficients, 3), np.uint8)
    texels[:count] = distinct.entries.reshape(count, coefficients, 3)
    submit("shN_centroids.webp", texels.reshape(height, -1, 3))
    labels = distinct.labels[found.labels].astype(np.uint16)
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
    """Whether the values of the entries come from a codebook already and are not means."""
    return len(np.unique(entries)) <= CODES


def _picture(texels: U8) -> U8:
    """Arrange (N, C) bytes as an almost square texture, padded with zeros."""
    count, channels = texels.shape
    width = _BLOCK * math.ceil(math.sqrt(count) / _BLOCK)
    height = _BLOCK * math.ceil(count / width / _BLOCK)
    out = np.zeros((height * width, channels), np.uint8)
    out[:count] = texels
    return out.reshape(height, width, channels)


def _short(values: F32) -> list[float]:
    """Convert to numbers with only the digits of float32; repeated, unused entries become 0.

    This saves thousands of bytes of JSON, which matters for small files.
    """
    used = np.diff(values, prepend=np.float32(np.nan)) != 0
    return [float(str(v)) if own else 0 for v, own in zip(values, used, strict=True)]
