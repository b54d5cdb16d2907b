"""PLY files built by hand, without the code under test."""

import numpy as np

BASE = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
BASE += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
ENCODINGS = ("ascii", "binary_little_endian", "binary_big_endian")
CODES = {"float": "f4", "double": "f8", "int": "i4", "uint": "u4", "uchar": "u1", "short": "i2"}


def vertex(n=3, names=BASE, kinds=None):
    """Make (name, PLY type, values) of each column; the values are small, distinct and exact."""
    kinds = kinds or {}
    return [
        (name, kinds.get(name, "float"), (np.arange(n) + 1) * (1 + i % 40))
        for i, name in enumerate(names)
    ]


def ply(*elements, encoding="binary_little_endian", comments=(), eol="\n"):
    """Return the bytes of a file of (name, columns) elements."""
    lines = ["ply", f"format {encoding} 1.0", *(f"comment {text}" for text in comments)]
    body = b""
    for name, columns in elements:
        count = len(columns[0][2])
        lines.append(f"element {name} {count}")
        lines += [f"property {kind} {column}" for column, kind, _ in columns]
        body += rows(columns, count, encoding)
    return (eol.join([*lines, "end_header"]) + eol).encode() + body


def rows(columns, count, encoding):
    if encoding == "ascii":
        values = [v.astype(CODES[kind]) for _, kind, v in columns]
        return b"".join(" ".join(str(v[i]) for v in values).encode() + b"\n" for i in range(count))
    order = ">" if encoding == "binary_big_endian" else "<"
    table = np.empty(count, [(name, order + CODES[kind]) for name, kind, _ in columns])
    for name, _, values in columns:
        table[name] = values
    return table.tobytes()
