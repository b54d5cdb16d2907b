"""Build `.rad` files by hand, in every encoding, and take them apart again."""

import json
import struct
import zlib

import numpy as np


def padded(data):
    return data + b"\0" * (-len(data) % 8)


def json_block(magic, content):
    text = content if isinstance(content, bytes) else json.dumps(content).encode()
    return magic + struct.pack("<I", len(text)) + padded(text)


def deflated(data):
    packer = zlib.compressobj(6, zlib.DEFLATED, -15)
    return packer.compress(data) + packer.flush()


def inflated(data):
    return zlib.decompress(data, -15)


def column(name, encoding, data, **more):
    """Return the description of a property, and its bytes before compression."""
    return {"property": name, "encoding": encoding, "compression": "gz"} | more, data


def chunk(columns, /, count, base=0, **more):
    """Return the bytes of a chunk of columns; `more` replaces entries of its description."""
    entries, payload = [], b""
    for entry, uncompressed in columns:
        data = deflated(uncompressed) if entry.get("compression") == "gz" else uncompressed
        present = {key: value for key, value in entry.items() if value is not None}
        entries.append({"offset": len(payload), "bytes": len(data)} | present)
        payload += padded(data)
    content = {"version": 1, "base": base, "count": count, "payloadBytes": len(payload)}
    content |= {"properties": entries} | more
    return json_block(b"RADC", content) + struct.pack("<Q", len(payload)) + payload


def rad(chunks, count, /, **more):
    """Return the bytes of a file of chunks; `more` replaces entries of its description."""
    entries, offset = [], 0
    for data in chunks:
        entries.append({"offset": offset, "bytes": len(data)})
        offset += len(data)
    content = {"version": 1, "type": "gsplat", "count": count, "maxSh": 0, "chunkSize": 65_536,
               "allChunkBytes": offset, "chunks": entries} | more  # fmt: skip
    return json_block(b"RAD0", content) + b"".join(chunks)


def by_component(values, kind="<f4"):
    return np.asarray(values).astype(kind).T.tobytes()


def typical_columns(count, seed=0):
    """Return the columns of a random model without harmonics, and its values by name."""
    rng = np.random.default_rng(seed)
    values = {
        "center": rng.normal(size=(count, 3)).astype(np.float32),
        "alpha": rng.random((count, 1)).astype(np.float32),
        "rgb": rng.random((count, 3)).astype(np.float32),
        "scales": np.exp(rng.normal(-3, 1, (count, 3))).astype(np.float32),
        "orientation": rng.uniform(-0.5, 0.5, (count, 3)).astype(np.float32),
    }
    return [column(name, "f32", by_component(value)) for name, value in values.items()], values


def tree_columns(counts, starts):
    return [
        column("child_count", "u16", by_component(counts, "<u2")),
        column("child_start", "u32", by_component(starts, "<u4")),
    ]


def small_tree(seed=0):
    """Make a tree in two chunks: a root with two nodes and a leaf, and two leaves for each node.

    Returns:
        The chunks, the values of all nodes by name, and the rows of the leaves.
    """
    counts, starts = [3, 2, 2, 0, 0, 0, 0, 0], [1, 4, 6, 0, 0, 0, 0, 0]
    _, values = typical_columns(8, seed)
    parts = []
    for first, last in ((0, 5), (5, 8)):
        rows = slice(first, last)
        node_columns = [column(n, "f32", by_component(v[rows])) for n, v in values.items()]
        parts.append(
            chunk(node_columns + tree_columns(counts[rows], starts[rows]), last - first, first)
        )
    return parts, values, np.flatnonzero(np.array(counts) == 0)


def with_palette(count=6, entries=4, seed=0):
    """Make a file of degree 2 with a palette of harmonics; return it, its labels and palette."""
    rng = np.random.default_rng(seed)
    bands = [rng.normal(size=(entries, 3 * n)).astype(np.float32) for n in (3, 5)]
    labels = rng.integers(0, entries, count)
    codes = [column(f"sh{i + 1}_code", "f32", by_component(b)) for i, b in enumerate(bands)]
    columns = [
        *typical_columns(count, seed)[0],
        *codes,
        column("sh_label", "u16", by_component(labels, "<u2")),
    ]
    data = rad([chunk(columns, count)], count, maxSh=2, shCodeCount=entries)
    return data, labels, np.concatenate(bands, axis=1).reshape(entries, 8, 3)


def parse_rad(data):
    """Return the description of a file, and for each chunk its description and packed payload."""
    (length,) = struct.unpack_from("<I", data, 4)
    head, end = json.loads(data[8 : 8 + length]), 8 + length + -length % 8
    chunks = []
    for entry in head["chunks"]:
        chunk_start = end + entry["offset"]
        (size,) = struct.unpack_from("<I", data, chunk_start + 4)
        start = chunk_start + 8 + size + -size % 8
        payload = data[start + 8 : chunk_start + entry["bytes"]]
        chunks.append((json.loads(data[chunk_start + 8 : chunk_start + 8 + size]), payload))
    return head, chunks
