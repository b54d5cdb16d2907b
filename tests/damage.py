"""Random damage to files, and the check that a damaged file is read or refused."""

import copy
import struct

from nanogs import io
from nanogs.errors import FormatError
from nanogs.splats import Splats

NUMBERS = (0, 1, -1, 1 << 7, 1 << 15, (1 << 16) - 1, 1 << 31, (1 << 32) - 1, 1 << 62, (1 << 63) - 1)
FLOATS = (float("nan"), float("inf"), -1e30, 1e-45, -0.0)
VALUES = (
    None, True, -1, 0, 1, 3, 255, 4096, 65_537, 1 << 31, 1 << 40, 1 << 70, 0.5, 1e39, -1e308, 1e400,
    float("nan"), "", "a", "../a", "/dev/zero", "a.webp\0", "\ud800", [], {}, [[]], [0] * 300,
)  # fmt: skip
TEXT = (b"\n", b" ", b"-", b"9", b"\r", b"list ", b"\xff", b"\0")


def mutate(rng, data, *, header=None, anywhere=1.0, text=()):
    """Return a copy of some bytes with one to three random changes.

    A change replaces a byte, deletes or repeats a few, cuts off the end, overwrites some with a
    number, flips a bit or inserts text.

    Args:
        rng: Random generator.
        data: The bytes.
        header: Length of the start that is changed more often; all by default.
        anywhere: Fraction of the changes that may be beyond the header too.
        text: Texts of which one is inserted where otherwise a bit would be flipped.
    """
    out = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        limit = len(out)
        if header is not None and rng.random() >= anywhere:
            limit = min(limit, header)
        if limit == 0:
            break
        offset, size = int(rng.integers(limit)), int(rng.integers(1, 12))
        kind = rng.integers(20)
        if kind < 7:
            out[offset] = rng.integers(256)
        elif kind < 9:
            del out[offset : offset + size]
        elif kind < 11:
            out[offset:offset] = out[offset : offset + size]
        elif kind == 11:
            del out[offset:]
        elif kind < 15:
            number = _number(rng)[: len(out) - offset]
            out[offset : offset + len(number)] = number
        elif text:
            out[offset:offset] = text[rng.integers(len(text))]
        else:
            out[offset] ^= 1 << rng.integers(8)
    return bytes(out)


def _number(rng):
    """Return the bytes of a number at the limits of its type, little-endian."""
    if rng.random() < 0.3:
        return struct.pack("<f", FLOATS[rng.integers(len(FLOATS))])
    width = int(rng.choice([2, 4, 4, 8]))
    value = NUMBERS[rng.integers(len(NUMBERS))] % (1 << 8 * width)
    return value.to_bytes(width, "little")


def change_json(rng, value):
    """Return a copy of parsed JSON with one to three values replaced, repeated or removed."""
    out = [copy.deepcopy(value)]
    for _ in range(rng.integers(1, 4)):
        entries = list(_places(out))
        holder, key = entries[rng.integers(len(entries))]
        if rng.random() < 0.15 and holder is not out:
            del holder[key]
        elif rng.random() < 0.1 and isinstance(holder, list):
            holder += holder[:]
        else:
            holder[key] = _value(rng, holder[key])
    return out[0]


def _places(holder):
    """Yield (list or dictionary, key) of every value inside another."""
    for key in list(holder) if isinstance(holder, dict) else range(len(holder)):
        yield holder, key
        if isinstance(holder[key], dict | list):
            yield from _places(holder[key])


def _value(rng, old):
    """Return another value: for numbers, often a nearby number of the same type."""
    number = isinstance(old, int | float) and not isinstance(old, bool)
    if number and rng.random() < 0.5:
        return old + type(old)(rng.integers(-2, 3))
    return copy.deepcopy(VALUES[rng.integers(len(VALUES))])


def outcome(path):
    """Read a file; return "model", or "refused" on a FormatError. Other errors fail the test."""
    try:
        model = io.load(path)
        assert isinstance(model, Splats)
        assert io.inspect(path).splats == len(model)
    except FormatError as error:
        str(error).encode()  # printable on any terminal
        return "refused"
    return "model"
