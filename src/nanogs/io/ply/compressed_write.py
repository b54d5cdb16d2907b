"""Writing PlayCanvas' `.compressed.ply`: 16 bytes a splat, in chunks of 256 with common bounds.

Layout: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/ply/; the rounding
and the order of the splats are those of https://github.com/playcanvas/splat-transform (MIT), so
that both write the same numbers. Rows come in Morton order (Morton 1966), for narrow bounds.
"""

from typing import BinaryIO

import numpy as np

from nanogs._types import F32, F64, I32, I64, U32, Array
from nanogs.findings import Finding
from nanogs.io import columns, limits, render_tag
from nanogs.io.files import BLOCK_ROWS
from nanogs.io.in_order import in_order
from nanogs.io.ply.compressed_read import BOUNDS, CHUNK_ROWS, COLOUR_BOUNDS, PACKED
from nanogs.io.ply.write import header
from nanogs.io.rotations import split_quats
from nanogs.morton import interleaved_bits
from nanogs.source import Source, source_of
from nanogs.splats import Splats
from nanogs.stored import SH_C0

MAX_DEGREE = 3
_LOG_SCALES = 20.0  # a log-scale beyond ±20 is clamped: one of -inf would void its chunk's bounds
_SH_RANGE = 4.0
_CELLS = 1024  # on each axis, in one pass of the ordering
_CHUNK = np.dtype([(name, "<f4") for name in (*BOUNDS, *COLOUR_BOUNDS)])
_VERTEX = np.dtype([(name, "<u4") for name in PACKED])


def write(model: Splats | Source, file: BinaryIO) -> None:
    """Write a model; its rows come out in Morton order. Of a source only the centres are held.

    Raises:
        OutputError: A splat holds a value that the format cannot, or a comment is too long.
        OSError: The system refuses to write.
    """
    source = source_of(model)
    order = _order(source)
    file.write(_header(source.read(0, 1), source.count))
    with in_order(source, order) as rows:
        del order  # which is not needed any more, and large
        _write_rows(rows, file)


def _order(source: Source) -> I64 | I32:
    """The rows in Morton order, once it is known that all can be stored."""
    means = np.empty((source.count, 3), np.float32)
    at = 0
    for block in limits.storable(source, ".compressed.ply"):
        # What overflows is refused when all have been looked at.
        with np.errstate(over="ignore", invalid="ignore"):
            means[at : at + len(block)] = block.means
        at += len(block)
    return morton_order(means)


def _write_rows(rows: Source, file: BinaryIO) -> None:
    """Write splats in their order; blocks begin where chunks do."""
    size = max(BLOCK_ROWS // CHUNK_ROWS, 1) * CHUNK_ROWS
    chunks = np.concatenate([_bounds(block) for block in rows.blocks(size)])
    file.write(chunks.data)
    at = 0
    for block in rows.blocks(size):
        file.write(_packed(block, chunks[np.arange(at, at + len(block)) // CHUNK_ROWS]))
        at += len(block)
    if rows.columns.sh_degree:
        for block in rows.blocks(size):
            file.write(_sh_bytes(block.sh))


def file_bytes(splats: Splats, count: int) -> int:
    """Bytes of the file of a model of `count` splats that is like this one in all else.

    Args:
        splats: What the degree and the comments are taken from.
        count: Splats, 1 or more.

    Raises:
        OutputError: A comment cannot stand in a header.
    """
    row = _VERTEX.itemsize + len(columns.rest_names(_degree(splats)))
    return len(_header(splats, count)) + _chunks(count) * _CHUNK.itemsize + count * row


def losses(splats: Splats) -> tuple[str, ...]:
    """Name what the file leaves out or clamps, one sentence each."""
    found = limits.left_out(splats, ".compressed.ply", comments=False, max_degree=MAX_DEGREE)
    found += limits.rounded(splats, ".compressed.ply")
    if count := int((np.abs(splats.log_scales) > _LOG_SCALES).any(axis=1).sum()):
        found.append(
            Finding("{:splat has|splats have} a log-scale beyond ±20, which is clamped.", count)
        )
    rest = splats.sh[:, 1 : (_degree(splats) + 1) ** 2]
    if count := int((np.abs(rest) > _SH_RANGE).sum()):
        text = "{:SH coefficient is|SH coefficients are} beyond ±4, which .compressed.ply clamps."
        found.append(Finding(text, count))
    return tuple(found)


def morton_order(means: F32) -> I64 | I32:
    """Rows in Morton order, refined where more than a chunk of them share a cell.

    Args:
        means: (N, 3) float32, finite.

    Returns:
        (N,) int32, or int64 for more than 2 billion.
    """
    order: I64 | I32
    if len(means) > np.iinfo(np.int32).max:
        order = np.arange(len(means))
    else:
        order = np.arange(len(means), dtype=np.int32)
    spans = [(0, len(means))]
    while spans:  # each pass splits a span of at least two places, so this ends
        start, stop = spans.pop()
        codes = _codes(means, order[start:stop])
        rank = np.argsort(codes, kind="stable")
        codes = codes[rank]
        order[start:stop] = order[start:stop][rank]
        del rank  # of a large model large too
        if codes[0] != codes[-1]:
            crowded = np.unique(codes[CHUNK_ROWS:][codes[CHUNK_ROWS:] == codes[:-CHUNK_ROWS]])
            edges = (start + np.searchsorted(codes, crowded, side) for side in ("left", "right"))
            spans += zip(*(each.tolist() for each in edges), strict=True)
    return order


def _codes(means: F32, rows: I64 | I32) -> U32:
    """(R,) uint32: interleaved bits of the cells of the rows' own bounding box, x lowest."""
    blocks = [rows[at : at + BLOCK_ROWS] for at in range(0, len(rows), BLOCK_ROWS)]
    low, high = (
        np.array([edge(means[block], axis=0) for block in blocks], np.float64)
        for edge in (np.min, np.max)
    )
    corner = low.min(axis=0)
    extent = high.max(axis=0) - corner
    scale = np.divide(_CELLS, extent, out=np.zeros(3), where=extent > 0)
    codes = np.empty(len(rows), np.uint32)
    for number, block in enumerate(blocks):
        points = means[block].astype(np.float64)
        cells = np.minimum((points - corner) * scale, _CELLS - 1).astype(np.uint64)
        bits = [interleaved_bits(cells[:, axis].copy(), axis) for axis in range(3)]
        codes[number * BLOCK_ROWS :][: len(block)] = np.bitwise_or.reduce(bits)
    return codes


def _degree(splats: Splats) -> int:
    return min(splats.sh_degree, MAX_DEGREE)


def _chunks(count: int) -> int:
    return -(-count // CHUNK_ROWS)


def _header(splats: Splats, count: int) -> bytes:
    elements = [
        ("chunk", _chunks(count), [(name, "float") for name in _CHUNK.names or ()]),
        ("vertex", count, [(name, "uint") for name in PACKED]),
    ]
    if rest := columns.rest_names(_degree(splats)):
        elements.append(("sh", count, [(name, "uchar") for name in rest]))
    return header(render_tag.tagged(splats.comments, splats.render_mode), elements)


def _values(splats: Splats) -> tuple[F32, F32, F32]:
    """Centres, clamped log-scales and base colours, (R, 3) float32 each, as the bounds see them."""
    colours = splats.sh[:, 0].astype(np.float64) * SH_C0 + 0.5
    scales = np.clip(splats.log_scales, -_LOG_SCALES, _LOG_SCALES)
    return splats.means.astype(np.float32), scales, colours.astype(np.float32)


def _bounds(splats: Splats) -> Array:
    """(C,) of the chunk's type: the lowest and highest value in every 256 rows."""
    chunks = np.empty(_chunks(len(splats)), _CHUNK)
    starts = np.arange(0, len(splats), CHUNK_ROWS)
    for values, names in zip(_values(splats), _NAMES, strict=True):
        low, high = (edge.reduceat(values, starts) for edge in (np.minimum, np.maximum))
        for axis in range(3):
            chunks[names[axis]], chunks[names[axis + 3]] = low[:, axis], high[:, axis]
    return chunks


_NAMES = (BOUNDS[:6], BOUNDS[6:], COLOUR_BOUNDS)


def _packed(splats: Splats, chunk: Array) -> memoryview:
    """The vertex rows; `chunk` holds the bounds of each."""
    units = [
        _unit(values, chunk, names) for values, names in zip(_values(splats), _NAMES, strict=True)
    ]
    vertex = np.empty(len(splats), _VERTEX)
    rgba = np.column_stack([units[2], splats.opacities()])
    vertex["packed_position"] = _words(units[0], (11, 10, 11))
    vertex["packed_rotation"] = _rotations(splats.quats.astype(np.float64))
    vertex["packed_scale"] = _words(units[1], (11, 10, 11))
    vertex["packed_color"] = _words(rgba, (8, 8, 8, 8))
    return vertex.data


def _unit(values: F32, chunk: Array, names: list[str]) -> F64:
    """(R, 3): values from 0 at the chunk's lower bound to 1 at the upper one."""
    low, high = (
        np.stack([chunk[name] for name in part], axis=1).astype(np.float64)
        for part in (names[:3], names[3:])
    )
    wide = high - low
    return np.divide(values - low, wide, out=np.zeros(values.shape), where=wide > 0)


def _words(units: F64, bits: tuple[int, ...]) -> U32:
    """(R,) uint32: values from 0 to 1 rounded to so many bits each, the first uppermost."""
    words = np.zeros(len(units), np.uint32)
    for unit, width in zip(units.T, bits, strict=True):
        top = (1 << width) - 1
        words = words << np.uint32(width) | np.floor(unit * top + 0.5).astype(np.uint32)
    return words


def _rotations(quats: F64) -> U32:
    """(R,) uint32: the place of the largest part in 2 bits, the other three in 10 each."""
    norms = np.sqrt((quats * quats).sum(axis=1, keepdims=True))  # of float32, so none overflows
    quats = np.where(norms > 0, quats * (1 / np.where(norms > 0, norms, 1)), (1, 0, 0, 0))
    largest, small = split_quats(quats)
    units = np.clip(small * np.sqrt(0.5) + 0.5, 0, 1)
    words: U32 = largest.astype(np.uint32) << np.uint32(30) | _words(units, (10, 10, 10))
    return words


def _sh_bytes(sh: F32) -> memoryview:
    """A byte a coefficient, all of red first: 256 steps over [-4, 4]."""
    kept = min(sh.shape[1], (MAX_DEGREE + 1) ** 2)
    rest = sh[:, 1:kept].astype(np.float64).transpose(0, 2, 1)
    steps = np.clip((rest / (2 * _SH_RANGE) + 0.5) * 256, 0, 255)
    return np.ascontiguousarray(steps.astype(np.uint8)).data
