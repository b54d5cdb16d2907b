"""Files damaged on purpose, and what reading one must come to."""

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
    """Change, delete, repeat, or overwrite with a number, a few bytes; flip a bit, or insert text.

    Args:
        rng: Draws places and kinds.
        data: The bytes.
        header: Length of what is hit more often, all by default.
        anywhere: Share of the hits that may be beyond it.
        text: What to insert in place of flipping bits.
    """
    out = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        limit = len(out)
        if header is not None and rng.random() >= anywhere:
            limit = min(limit, header)
        if limit == 0:
            break
        at, size = int(rng.integers(limit)), int(rng.integers(1, 12))
        kind = rng.integers(20)
        if kind < 7:
            out[at] = rng.integers(256)
        elif kind < 9:
            del out[at : at + size]
        elif kind < 11:
            out[at:at] = out[at : at + size]
        elif kind == 11:
            del out[at:]
        elif kind < 15:
            number = _number(rng)[: len(out) - at]
            out[at : at + len(number)] = number
        elif text:
            out[at:at] = text[rng.integers(len(text))]
        else:
            out[at] ^= 1 << rng.integers(8)
    return bytes(out)


def _number(rng):
    """A number at the edge of its type, little-endian."""
    if rng.random() < 0.3:
        return struct.pack("<f", FLOATS[rng.integers(len(FLOATS))])
    width = int(rng.choice([2, 4, 4, 8]))
    value = NUMBERS[rng.integers(len(NUMBERS))] % (1 << 8 * width)
    return value.to_bytes(width, "little")


def change_json(rng, value):
    """A copy of parsed JSON with one to three of its values replaced, repeated or taken out."""
    out = [copy.deepcopy(value)]
    for _ in range(rng.integers(1, 4)):
        places = list(_places(out))
        holder, key = places[rng.integers(len(places))]
        if rng.random() < 0.15 and holder is not out:
            del holder[key]
        elif rng.random() < 0.1 and isinstance(holder, list):
            holder += holder[:]
        else:
            holder[key] = _value(rng, holder[key])
    return out[0]


def _places(holder):
    """Every (list or dictionary, key) below a value."""
    for key in list(holder) if isinstance(holder, dict) else range(len(holder)):
        yield holder, key
        if isinstance(holder[key], dict | list):
            yield from _places(holder[key])


def _value(rng, old):
    """Something else, often of the same kind."""
    number = isinstance(old, int | float) and not isinstance(old, bool)
    if number and rng.random() < 0.5:
        return old + type(old)(rng.integers(-2, 3))
    return copy.deepcopy(VALUES[rng.integers(len(VALUES))])


def outcome(path):
    """`model` or `refused`, for what is read or refused with a sentence; all else is a failure."""
    try:
        model = io.load(path)
        assert isinstance(model, Splats)
        assert io.inspect(path).splats == len(model)
    except FormatError as error:
        str(error).encode()  # printable on any terminal
        return "refused"
    return "model"
