"""A tiny encoder of `.spz` that shares no code with the library."""

import gzip
import math
import struct

import zstandard


def fixed24(value, bits):
    return (round(value * 2**bits) & 0xFFFFFF).to_bytes(3, "little")


def smallest_three(xyzw):
    largest = max(range(4), key=lambda i: abs(xyzw[i]))
    sign = -1 if xyzw[largest] < 0 else 1
    word = largest
    for i in range(4):
        if i != largest:
            part = sign * xyzw[i]
            word = word << 10 | (part < 0) << 9 | int(511 * abs(part) / math.sqrt(0.5) + 0.5)
    return struct.pack("<I", word)


def encode_columns(rows, version, bits):
    """Encode rows of (mean, alpha byte, colour bytes, scale bytes, unit xyzw, SH bytes)."""
    columns = [b""] * 6
    for mean, alpha, colour, scale, xyzw, sh in rows:
        if version == 1:
            columns[0] += struct.pack("<3e", *mean)
        else:
            columns[0] += b"".join(fixed24(value, bits) for value in mean)
        columns[1] += bytes([alpha])
        columns[2] += bytes(colour)
        columns[3] += bytes(scale)
        if version <= 2:
            columns[4] += bytes(round(127.5 * part + 127.5) for part in xyzw[:3])
        else:
            columns[4] += smallest_three(xyzw)
        columns[5] += bytes(sh)
    return [column for column in columns if column]


def encode(rows, version, *, degree=0, bits=12, flags=0, records=b"", **changes):
    """Encode a whole file; `changes` put wrong values into the header."""
    columns = encode_columns(rows, version, bits)
    header = {"magic": b"NGSP", "version": version, "count": len(rows), "degree": degree}
    header |= {"bits": bits, "flags": flags} | changes
    header["version"] = header.pop("stated", version)
    keys = ("magic", "version", "count", "degree", "bits", "flags")
    start = struct.pack("<4sIIBBB", *(header[key] for key in keys))
    if version < 4:
        return gzip.compress(start + b"\0" + b"".join(columns) + records, mtime=0)
    streams = [zstandard.compress(column) for column in columns]
    toc = header.get("toc", 32 + len(records))
    out = start + struct.pack("<BI12x", header.get("streams", len(streams)), toc) + records
    for column, stream in zip(columns, streams, strict=True):
        out += struct.pack("<QQ", len(stream), len(column) + header.get("promise", 0))
    return out + b"".join(streams)


def row(mean=(1.5, -2.25, 0.0625), xyzw=(0.5, -0.5, 0.5, 0.5), sh=(), alpha=51):
    return mean, alpha, (255, 0, 128), (0, 160, 255), xyzw, sh
