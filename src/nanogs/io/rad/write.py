"""Writing `.rad` (Spark); `header` has the layout.

Each chunk has its own value ranges, so that no colour is clamped, and uses float16 where the steps
of a byte would be wide. Log-scales are float16, which is finer than a viewer's own encoding. The
axes of each splat are reordered so that its rotation is smallest, because bytes resolve small
rotations best.
"""

import json
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any, BinaryIO, NamedTuple, Protocol

import numpy as np

from nanogs import parallel
from nanogs._types import F32, F64, I64, Array
from nanogs.activations import SH_C0, alphas, base_colour, rounded_bytes
from nanogs.io import activated, limits, render_tag
from nanogs.io.rad.header import (
    BANDS,
    CHILD_COUNT,
    CHILD_START,
    CHUNK_MAGIC,
    CHUNK_ROWS,
    MAGIC,
    MAX_DEGREE,
    MAX_JSON,
    PAYLOAD,
    START,
    VERSION,
    padded,
)
from nanogs.io.rad.values import OCT88R8, by_byte, by_component, differences, encode_oct88r8
from nanogs.io.rotations import minimise_rotation
from nanogs.io.temporary import into_temporary, nameless_file
from nanogs.io.texts import as_utf8, one_line
from nanogs.slices import slices
from nanogs.source import Source, source_of
from nanogs.splats import RenderMode, Splats

SUFFIX = ".rad"
_DEFLATE_LEVEL = 10  # of libdeflate: as fast as the default of zlib, and 2 to 3 % smaller
# Limits up to which bytes are used. Range of base colours: bytes then have the steps of .spz.
_WIDEST_COLOURS = 1.9
_LARGEST_COEFFICIENT = 4.0  # of an SH coefficient: bytes then have half the steps of .spz
_LARGEST_HALF = 65504.0  # the largest finite float16
_USUAL = (0.5, 99.5)  # percentiles of values that the ranges of a viewer's textures cover
_LEAST_WIDTH = 1e-3  # least width of a range for a viewer


class Tree(Protocol):
    """A level-of-detail tree: the children of a row represent it in finer detail.

    Rows are in breadth-first order: the children of the first row follow the root, then come those
    of the next row that has any, and so on.
    """

    def children(self, start: int, stop: int) -> I64:
        """Return the number of children of rows `start` to `stop`, at most 65,535; 0 for leaves."""


@dataclass(slots=True)
class _Ranges:
    """Value ranges for the textures of a viewer, named as in `splatEncoding` of the file."""

    rgbMin: float = 0.0  # noqa: N815 - the format's own
    rgbMax: float = 1.0  # noqa: N815
    lnScaleMin: float = np.inf  # noqa: N815
    lnScaleMax: float = -np.inf  # noqa: N815
    sh1Max: float = 0.0  # noqa: N815
    sh2Max: float = 0.0  # noqa: N815
    sh3Max: float = 0.0  # noqa: N815
    lodOpacity: bool = False  # noqa: N815

    def add(self, chunk: Splats, degree: int) -> None:
        """Extend the ranges by a chunk as it is read back, so that its values give them again."""
        read = _as_read(chunk, degree)
        for rows in slices(len(read)):
            self._add_rows(read.span(rows.start, rows.stop), degree)

    def _add_rows(self, block: Splats, degree: int) -> None:
        low, high = np.percentile(_colours(block), _USUAL)
        self.rgbMin, self.rgbMax = min(self.rgbMin, low), max(self.rgbMax, high)
        logs = block.log_scales[np.isfinite(block.log_scales)]
        if len(logs):
            low, high = np.percentile(logs, _USUAL)
            self.lnScaleMin = min(self.lnScaleMin, low)
            self.lnScaleMax = max(self.lnScaleMax, high)
        for name, (first, last) in zip(BANDS, _bands(degree), strict=False):
            most = float(np.percentile(np.abs(block.sh[:, first:last]), _USUAL[1]))
            setattr(self, f"{name}Max", max(getattr(self, f"{name}Max"), most))

    def encoding(self, *, tree: bool) -> dict[str, Any]:
        """Return the ranges as JSON fields, each widened to a least width."""
        low, high = self.lnScaleMin, self.lnScaleMax
        low, high = (low, high) if low <= high else (-12.0, 9.0)  # all scales are zero
        found = asdict(self) | {"lnScaleMin": low, "lnScaleMax": max(high, low + _LEAST_WIDTH)}
        bands = {f"{name}Max": max(found[f"{name}Max"], _LEAST_WIDTH) for name in BANDS}
        rounded = {name: float(value) for name, value in (found | bands).items()}
        return rounded | {"lodOpacity": tree}


def write(model: Splats | Source, file: BinaryIO, *, tree: Tree | None = None) -> None:
    """Write a model in its own order, holding at most one chunk in memory.

    Args:
        model: N splats; with a tree all its nodes, the root first and children after parents.
        file: Open for binary writing.
        tree: The level-of-detail tree of these nodes; by default there is none.

    Raises:
        OutputError: A value is NaN or infinite, the comments are too long, or one holds a line
            break; nothing has been written then.
        OutputError: A temporary file cannot be written.
        OSError: The system refuses to write.
    """
    source = source_of(model)
    degree = min(source.columns.sh_degree, MAX_DEGREE)
    ranges = _Ranges()
    for block in limits.storable(source, SUFFIX, CHUNK_ROWS):
        if block.finite().all():  # otherwise `storable` raises at the end
            ranges.add(block, degree)
    encoding = ranges.encoding(tree=tree is not None)
    lines = render_tag.tagged(source.columns.comments, RenderMode(source.columns.render_mode))
    chunks = list[dict[str, int]]()
    head = {
        "version": VERSION,
        "type": "gsplat",
        "count": source.count,
        "maxSh": degree,
        **({"lodTree": True} if tree else {}),
        "chunkSize": CHUNK_ROWS,
        "allChunkBytes": 0,
        "chunks": chunks,
        "splatEncoding": encoding,
        **({"comment": "\n".join(as_utf8(one_line(text)) for text in lines)} if lines else {}),
    }
    _described(MAGIC, head)  # refuses comments that are too long before anything is packed
    with nameless_file() as body:
        at = 0
        for chunk in _chunks(source, degree, tree, encoding):
            with into_temporary():
                body.write(chunk)
            chunks.append({"offset": at, "bytes": len(chunk)})
            at += len(chunk)
        file.write(_described(MAGIC, head | {"allChunkBytes": at}))
        with into_temporary():  # the last bytes are written now
            body.seek(0)
        shutil.copyfileobj(body, file, 1 << 20)


def losses(splats: Splats) -> tuple[str, ...]:
    """Name what the file leaves out or clamps, one sentence each."""
    out = limits.left_out(splats, SUFFIX, comments=False, max_degree=MAX_DEGREE)
    out += limits.rounded(splats, SUFFIX)
    logs = splats.log_scales
    out += limits.clamped(
        np.isfinite(logs) & (np.abs(logs) > _LARGEST_HALF),
        f"log-scales outside ±{_LARGEST_HALF:,.0f}, the range of {SUFFIX}",
    )
    return tuple(out)


def _described(magic: bytes, content: dict[str, Any]) -> bytes:
    """Encode the JSON header of a file or a chunk, padding included.

    Raises:
        OutputError: It is too long to be read back.
    """
    text = json.dumps(content, ensure_ascii=False, separators=(",", ":"), allow_nan=False).encode()
    limits.refuse_long_json(len(text), MAX_JSON)
    return (START.pack(magic, len(text)) + text).ljust(padded(START.size + len(text)), b"\0")


def _chunks(
    source: Source, degree: int, tree: Tree | None, ranges: dict[str, Any]
) -> Iterator[bytes]:
    below = 1  # the first child of the rows that follow
    for start in range(0, source.count, CHUNK_ROWS):
        block = source.read(start, min(start + CHUNK_ROWS, source.count))
        columns = list(_columns(block, degree))
        if tree is not None:
            counts = tree.children(start, start + len(block))
            columns += _links(counts, below)
            below += int(counts.sum())
        properties, payload, at = [], [], 0
        for (entry, _), data in zip(columns, _deflated([c for _, c in columns]), strict=True):
            properties.append({"offset": at, "bytes": len(data), **entry, "compression": "gz"})
            payload.append(data.ljust(padded(len(data)), b"\0"))
            at += len(payload[-1])
        head = {
            "version": VERSION,
            "base": start,
            "count": len(block),
            "payloadBytes": at,
            "maxSh": degree,
            **({"lodTree": True} if tree else {}),
            "splatEncoding": ranges,
            "properties": properties,
        }
        yield b"".join((_described(CHUNK_MAGIC, head), PAYLOAD.pack(at), *payload))


def _deflated(columns: list[bytes]) -> list[bytes]:
    """Compress the columns in parallel."""
    from deflate import deflate_compress  # imported here because few calls need it

    def deflate(number: int) -> bytes:
        return bytes(deflate_compress(columns[number], _DEFLATE_LEVEL))

    # The longest first, for the best balance between threads.
    order = sorted(range(len(columns)), key=lambda n: -len(columns[n]))
    done = dict(zip(order, parallel.map_ordered(order, deflate), strict=True))
    return [done[number] for number in range(len(columns))]


def _columns(block: Splats, degree: int) -> Iterator[tuple[dict[str, Any], bytes]]:
    """Yield the entry of each column of a chunk, and its bytes before they are compressed."""
    yield _entry("center", "f32_lebytes"), by_byte(block.means.astype(np.float32))
    opacities = rounded_bytes(alphas(block.opacity_logits) * 255)[:, None]
    yield _entry("alpha", "r8", 0.0, 1.0), by_component(opacities)
    colours = _coloured(_colours(block))
    yield colours.entry, by_component(colours.stored)
    flat = block.render_mode is RenderMode.SURFEL
    quats, logs = minimise_rotation(block, OCT88R8, third_stays=flat)
    yield _entry("scales", "ln_f16"), by_component(_halves(logs))
    yield _entry("orientation", "oct88r8"), encode_oct88r8(quats).tobytes()
    for name, (first, last) in zip(BANDS, _bands(degree), strict=False):
        band = _band(name, block.sh[:, first:last])
        yield band.entry, by_component(band.stored)


def _links(counts: I64, below: int) -> Iterator[tuple[dict[str, Any], bytes]]:
    """Yield the entries and bytes of the columns with the links from parents to children.

    Args:
        counts: Number of children of each row.
        below: Row of the first child of all.
    """
    starts = np.where(counts > 0, np.cumsum(counts) - counts + below, 0)
    yield _entry(CHILD_COUNT, "u16"), counts.astype("<u2").tobytes()
    yield _entry(CHILD_START, "u32"), starts.astype("<u4").tobytes()


def _entry(
    name: str, encoding: str, low: float | None = None, high: float | None = None
) -> dict[str, Any]:
    ranged = {} if low is None else {"min": low, "max": high}
    return {"property": name, "encoding": encoding, **ranged}


class _Coded(NamedTuple):
    """A column: its entry, the (R, C) stored numbers, and the float64 values they are read as."""

    entry: dict[str, Any]
    stored: Array
    values: F64


def _as_read(chunk: Splats, degree: int) -> Splats:
    """Return a chunk with the log-scales and SH coefficients that reading it again gives."""
    sh = np.empty((len(chunk), (degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = base_colour(_coloured(_colours(chunk)).values)
    for name, (first, last) in zip(BANDS, _bands(degree), strict=False):
        band = _band(name, chunk.sh[:, first:last])
        sh[:, first:last] = band.values.reshape(len(chunk), -1, 3)
    return replace(chunk, log_scales=_halves(chunk.log_scales), sh=sh)


def _colours(block: Splats) -> F64:
    """Return (R, 3) base colours: 0.5 plus the contribution of the SH coefficient of degree 0."""
    colours: F64 = block.sh[:, 0] * np.float64(SH_C0) + 0.5
    return colours


def _halves(logs: F32) -> Array:
    """Return log-scales as float16, clamped; -inf, a scale of zero, stays."""
    finite = np.clip(logs, -_LARGEST_HALF, _LARGEST_HALF)
    return np.where(np.isneginf(logs), logs, finite).astype("<f2")


def _half(value: float) -> float:
    """Round to float16, so that a choice by this value is the same for values read from float16."""
    return float(np.float16(np.clip(value, -_LARGEST_HALF, _LARGEST_HALF)))


def _coloured(colours: F64) -> _Coded:
    """Encode base colours; their range is rounded so that the values read back give it again."""
    ends = activated.rounded_colours(np.array([colours.min(), colours.max()]))
    low, high = ends.tolist()
    if _half(high) - _half(low) > _WIDEST_COLOURS:
        return _floats("rgb", colours)
    width = max(high - low, activated.LEAST_COLOUR_RANGE)
    steps = rounded_bytes((colours - low) / width * 255)
    entry = _entry("rgb", "r8_delta", low, low + width)
    return _Coded(entry, differences(steps), steps / 255 * width + low)


def _band(name: str, coefficients: F32) -> _Coded:
    values = coefficients.reshape(len(coefficients), -1)
    most = float(np.abs(values).max()) or 1.0
    if _half(most) > _LARGEST_COEFFICIENT:
        return _floats(name, values)
    # In double precision, because 127 / most may be beyond single precision.
    steps = np.rint(values * np.float64(127 / most)).astype(np.int8)
    return _Coded(_entry(name, "s8", -most, most), steps, steps / 127.0 * most)


def _floats(name: str, values: Array) -> _Coded:
    """Encode values as float16, or as float32 if they are too large for it."""
    wide = np.abs(values).max() > _LARGEST_HALF
    stored = values.astype("<f4" if wide else "<f2")
    return _Coded(_entry(name, "f32" if wide else "f16"), stored, stored.astype(np.float64))


def _bands(degree: int) -> Iterable[tuple[int, int]]:
    """Return the start and end coefficient of each band from degree 1 on."""
    return pairwise((band + 1) ** 2 for band in range(degree + 1))
