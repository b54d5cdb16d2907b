"""A tiny writer of `.lcc` models that shares no code with the library."""

import json
import math
import struct

SCALES, ENV_SCALES = ((0.001, 0.002, 0.003), (2.0, 1.0, 3.0)), ((0.1, 0.1, 0.1), (9.0, 8.0, 7.0))
SH, ENV_SH = ((-1.0, -0.5, -2.0), (1.0, 0.75, 1.5)), ((-0.25,) * 3, (0.5,) * 3)


def rotation(xyzw):
    """Pack a unit quaternion: the index of its largest component, the others in 10 bits each."""
    largest = max(range(4), key=lambda i: abs(xyzw[i]))
    sign = -1 if xyzw[largest] < 0 else 1
    parts = [sign * part for i, part in enumerate(xyzw) if i != largest]
    word = largest << 30
    for index, part in enumerate(parts):
        word |= round((part + math.sqrt(0.5)) / math.sqrt(2) * 1023) << 10 * index
    return word


def row(mean=(1.5, -2.25, 0.0625), rgba=(255, 0, 128, 51), scale=(0, 65535, 777),
        xyzw=(0.5, -0.5, 0.5, 0.5), normal=(0, 0, 0)):  # fmt: skip
    return struct.pack("<3f4B3HI3H", *mean, *rgba, *scale, rotation(xyzw), *normal)


def harmonics(codes):
    """Pack 15 coefficients, each as three codes of 11, 10 and 11 bits."""
    words = [r | g << 11 | b << 21 for r, g, b in codes]
    return struct.pack("<16I", *words, 0)


def random_rows(rng, count):
    """Make the rows and the harmonics of random splats."""
    rows, coefficients = [], []
    for _ in range(count):
        quat = rng.normal(size=4)
        rows.append(row(
            rng.normal(size=3) * 9, rng.integers(256, size=4), rng.integers(65536, size=3),
            (quat / math.sqrt(quat @ quat)).tolist(),
        ))  # fmt: skip
        codes = rng.integers((2048, 1024, 2048), size=(15, 3)).tolist()
        coefficients.append(harmonics(codes))
    return rows, coefficients


def model(cells, *, depth, quality=False, environment=(), changes=None, name="scene.lcc"):
    """Return the files of a model by name.

    Args:
        cells: (x, y, list of (rows, harmonics) by level) of each cell.
        depth: Number of levels.
        quality: Whether there are harmonics.
        environment: (rows, harmonics) of the sky, or nothing.
        changes: Entries of the description to replace; None removes an entry.
        name: File name of the description.
    """
    data, coefficients, index = b"", b"", b""
    counts = [0] * depth
    for x, y, levels in cells:
        index += struct.pack("<hh", x, y)
        for level, (rows, sh) in enumerate(levels):
            index += struct.pack("<iqi", len(rows), len(data), 32 * len(rows))
            data += b"".join(rows)
            coefficients += b"".join(sh)
            counts[level] += len(rows)

    def attribute(attribute_name, bounds):
        return {"name": attribute_name, "min": list(bounds[0]), "max": list(bounds[1])}

    description = {
        "version": "4.0", "totalSplats": sum(counts), "totalLevel": depth, "splats": counts,
        "fileType": "Quality" if quality else "Portable",
        "attributes": [
            attribute("scale", SCALES), attribute("shcoef", SH),
            attribute("envscale", ENV_SCALES), attribute("envshcoef", ENV_SH),
        ],
    } | (changes or {})  # fmt: skip
    description = {key: value for key, value in description.items() if value is not None}
    files = {name: json.dumps(description).encode(), "index.bin": index, "data.bin": data}
    if quality:
        files["shcoef.bin"] = coefficients
    if environment:
        rows, sh = environment
        pairs = zip(rows, sh, strict=True)
        files["environment.bin"] = b"".join(a + b if quality else a for a, b in pairs)
    return files


def typical_model(rng, *, quality=False, environment=0):
    """Return the files of a model of three cells and two levels; one cell lacks the finer level."""
    cells = [
        (0, 0, [random_rows(rng, 20), random_rows(rng, 6)]),
        (1, 0, [([], []), random_rows(rng, 3)]),
        (-1, 2, [random_rows(rng, 9), random_rows(rng, 2)]),
    ]
    sky = random_rows(rng, environment) if environment else ()
    return model(cells, depth=2, quality=quality, environment=sky)
