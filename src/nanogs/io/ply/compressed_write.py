"""Writing PlayCanvas' `.compressed.ply`: 16 bytes per splat, in chunks of 256 with common bounds.

Layout: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/ply/; the rounding
and the order of the splats are those of https://github.com/playcanvas/splat-transform (MIT), so
that both write the same numbers. Rows are in Morton order (Morton 1966), for narrow bounds; but
those of a model that was read from such a file keep their order, so that the file does not change.
"""

from typing import BinaryIO

import numpy as np

from nanogs._types import F32, F64, I32, I64, U8, U32, Array
from nanogs.activations import SH_C0
from nanogs.findings import Finding
from nanogs.io import columns, limits, render_tag
from nanogs.io.activated import LEAST_COLOUR_RANGE, rounded_colours
from nanogs.io.in_order import in_order
from nanogs.io.ply.compressed_read import BOUNDS, CHUNK_ROWS, COLOUR_BOUNDS, PACKED, decoded
from nanogs.io.ply.write import header
from nanogs.io.rotations import Rounding, place_left_out, split_quats
from nanogs.morton import interleaved_bits
from nanogs.slices import BLOCK_ROWS
from nanogs.source import Source, source_of
from nanogs.splats import Splats

MAX_DEGREE = 3
_MOST_LOG_SCALE = 20.0  # log-scales are clamped to ±20: -inf would make its chunk's bounds useless
_SH_RANGE = 4.0  # largest magnitude of a higher SH coefficient; others are clamped
_CELLS = 1024  # grid cells per axis in one pass of the ordering
_ROWS = max(BLOCK_ROWS // CHUNK_ROWS, 1) * CHUNK_ROWS  # of a block of whole chunks
_CHUNK = np.dtype([(name, "<f4") for name in (*BOUNDS, *COLOUR_BOUNDS)])
_VERTEX = np.dtype([(name, "<u4") for name in PACKED])


def write(model: Splats | Source, file: BinaryIO) -> None:
    """Write a model; only the centres of a source are held in memory.

    Raises:
        OutputError: A splat holds a value that the format cannot, or a comment is too long.
        OSError: The system refuses to write.
    """
    source = source_of(model)
    order = _order(source)
    file.write(_header(source.read(0, 1), source.count))
    if order is None:
        _write_rows(source, file)
        return
    with in_order(source, order) as rows:
        del order  # large, and not needed any more
        _write_rows(rows, file)


def _order(source: Source) -> I64 | I32 | None:
    """Compute the order of the rows, and refuse a model that cannot be stored.

    Returns:
        The Morton order; None if the rows keep their order.
    """
    means = np.empty((source.count, 3), np.float32)
    at = 0
    for block in limits.storable(source, ".compressed.ply"):
        # A centre that overflows is refused by `storable` after the last block.
        with np.errstate(over="ignore", invalid="ignore"):
            means[at : at + len(block)] = block.means
        at += len(block)
    return None if all(map(_was_read, source.blocks(_ROWS))) else morton_order(means)


def _was_read(block: Splats) -> bool:
    """Return whether encoding the rows in their order changes nothing, so they were read so."""
    degree = block.sh_degree
    if degree > MAX_DEGREE:
        return False
    chunks = _bounds(block)
    rows = {"chunk": chunks, "vertex": _packed(block, chunks)}
    if degree:
        sh = np.dtype([(name, "u1") for name in columns.rest_names(degree)])
        rows["sh"] = _sh_bytes(block.sh).reshape(len(block), -1).view(sh)[:, 0]
    read = decoded(rows, degree, 0)
    return all(np.array_equal(getattr(block, name), column) for name, column in read.items())


def _write_rows(rows: Source, file: BinaryIO) -> None:
    """Write splats in their order, in blocks of whole chunks."""
    chunks = np.concatenate([_bounds(block) for block in rows.blocks(_ROWS)])
    file.write(chunks.data)
    at = 0
    for block in rows.blocks(_ROWS):
        file.write(_packed(block, chunks[at : at + _chunks(len(block))]).data)
        at += _chunks(len(block))
    if rows.columns.sh_degree:
        for block in rows.blocks(_ROWS):
            file.write(_sh_bytes(block.sh).data)


def file_bytes(splats: Splats, count: int) -> int:
    """Compute the file size in bytes of a model of `count` splats that is otherwise like this one.

    Args:
        splats: The model that the SH degree and the comments are taken from.
        count: Number of splats, 1 or more.

    Raises:
        OutputError: A comment is not allowed in a header.
    """
    row = _VERTEX.itemsize + len(columns.rest_names(_degree(splats)))
    return len(_header(splats, count)) + _chunks(count) * _CHUNK.itemsize + count * row


def losses(splats: Splats) -> tuple[str, ...]:
    """Return a sentence for each thing that the file leaves out or clamps."""
    found = limits.left_out(splats, ".compressed.ply", comments=False, max_degree=MAX_DEGREE)
    found += limits.rounded(splats, ".compressed.ply")
    if count := int((np.abs(splats.log_scales) > _MOST_LOG_SCALE).any(axis=1).sum()):
        found.append(
            Finding("{:splat has|splats have} a log-scale beyond ±20, which is clamped.", count)
        )
    rest = splats.sh[:, 1 : (_degree(splats) + 1) ** 2]
    if count := int((np.abs(rest) > _SH_RANGE).sum()):
        text = "{:SH coefficient is|SH coefficients are} beyond ±4, which .compressed.ply clamps."
        found.append(Finding(text, count))
    return tuple(found)


def morton_order(means: F32) -> I64 | I32:
    """Compute the Morton order of points, refined recursively in cells with more than a chunk.

    Args:
        means: (N, 3) float32, finite.

    Returns:
        (N,) row numbers, int32, or int64 for more than 2 billion points.
    """
    order: I64 | I32
    if len(means) > np.iinfo(np.int32).max:
        order = np.arange(len(means))
    else:
        order = np.arange(len(means), dtype=np.int32)
    spans = [(0, len(means))]
    while spans:  # ends, because each pass splits a span that has two distinct points or more
        start, stop = spans.pop()
        codes = _codes(means, order[start:stop])
        rank = np.argsort(codes, kind="stable")
        codes = codes[rank]
        order[start:stop] = order[start:stop][rank]
        del rank  # large for a large model
        if codes[0] != codes[-1]:
            crowded = np.unique(codes[CHUNK_ROWS:][codes[CHUNK_ROWS:] == codes[:-CHUNK_ROWS]])
            edges = (start + np.searchsorted(codes, crowded, side) for side in ("left", "right"))
            spans += zip(*(each.tolist() for each in edges), strict=True)
    return order


def _codes(means: F32, rows: I64 | I32) -> U32:
    """Compute Morton codes, (R,) uint32, on a grid of the rows' own bounding box, x lowest."""
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
    """Return the quantised values: centres, clamped log-scales and colours, (R, 3) float32 each."""
    colours = splats.sh[:, 0].astype(np.float64) * SH_C0 + 0.5
    scales = np.clip(splats.log_scales, -_MOST_LOG_SCALE, _MOST_LOG_SCALE)
    return splats.means.astype(np.float32), scales, colours.astype(np.float32)


def _bounds(splats: Splats) -> Array:
    """Compute the chunk rows, (C,): the lowest and highest value in every 256 rows.

    The bounds of colours are rounded so that the colours that are read give them again.
    """
    chunks = np.empty(_chunks(len(splats)), _CHUNK)
    starts = np.arange(0, len(splats), CHUNK_ROWS)
    for values, names in zip(_values(splats), _NAMES, strict=True):
        low, high = (edge.reduceat(values, starts) for edge in (np.minimum, np.maximum))
        for axis in range(3):
            chunks[names[axis]], chunks[names[axis + 3]] = low[:, axis], high[:, axis]
    for start, end in zip(COLOUR_BOUNDS[:3], COLOUR_BOUNDS[3:], strict=True):
        low, high = (rounded_colours(chunks[name].astype(np.float64)) for name in (start, end))
        chunks[start] = low
        chunks[end] = np.maximum(high, rounded_colours(low + LEAST_COLOUR_RANGE))
    return chunks


_NAMES = (BOUNDS[:6], BOUNDS[6:], COLOUR_BOUNDS)


def _packed(splats: Splats, chunks: Array) -> Array:
    """Encode the vertex rows, (R,), which begin with the first of these chunks."""
    chunk = chunks[np.arange(len(splats)) // CHUNK_ROWS]
    units = [
        _unit(values, chunk, names) for values, names in zip(_values(splats), _NAMES, strict=True)
    ]
    vertex = np.empty(len(splats), _VERTEX)
    rgba = np.column_stack([units[2], splats.opacities()])
    vertex["packed_position"] = _words(units[0], (11, 10, 11))
    vertex["packed_rotation"] = _rotations(splats.quats.astype(np.float64))
    vertex["packed_scale"] = _words(units[1], (11, 10, 11))
    vertex["packed_color"] = _words(rgba, (8, 8, 8, 8))
    return vertex


def _unit(values: F32, chunk: Array, names: list[str]) -> F64:
    """Scale values to 0 at the chunk's lower bound and 1 at the upper one, (R, 3)."""
    low, high = (
        np.stack([chunk[name] for name in part], axis=1).astype(np.float64)
        for part in (names[:3], names[3:])
    )
    wide = high - low
    return np.divide(values - low, wide, out=np.zeros(values.shape), where=wide > 0)


def _words(units: F64, bits: tuple[int, ...]) -> U32:
    """Round values from 0 to 1 to `bits` bits each, packed in (R,) uint32, the first uppermost."""
    words = np.zeros(len(units), np.uint32)
    for unit, width in zip(units.T, bits, strict=True):
        top = (1 << width) - 1
        words = words << np.uint32(width) | np.floor(unit * top + 0.5).astype(np.uint32)
    return words


def _rotations(quats: F64) -> U32:
    """Encode quaternions, (R,) uint32: index of the largest component in 2 bits, others in 10."""
    norms = np.sqrt((quats * quats).sum(axis=1, keepdims=True))  # no overflow: values are float32
    quats = np.where(norms > 0, quats * (1 / np.where(norms > 0, norms, 1)), (1, 0, 0, 0))
    largest, small = split_quats(quats, place_left_out(quats, _ROUNDING))
    words: U32 = largest.astype(np.uint32) << np.uint32(30) | _words(_units(small), (10, 10, 10))
    return words


def _units(small: F64) -> F64:
    """Scale components from -√½ to √½ to 0 to 1."""
    units: F64 = np.clip(small * np.sqrt(0.5) + 0.5, 0, 1)
    return units


_ROUNDING = Rounding(
    lambda small: (np.floor(_units(small) * 1023 + 0.5) / 1023 - 0.5) * np.sqrt(2),
    np.sqrt(0.5) / 1023,
)


def _sh_bytes(sh: F32) -> U8:
    """Encode the higher coefficients as a byte each, red first: 256 steps over [-4, 4]."""
    kept = min(sh.shape[1], (MAX_DEGREE + 1) ** 2)
    rest = sh[:, 1:kept].astype(np.float64).transpose(0, 2, 1)
    steps = np.clip((rest / (2 * _SH_RANGE) + 0.5) * 256, 0, 255)
    return np.ascontiguousarray(steps.astype(np.uint8))
