"""Files damaged on purpose, and what reading one must come to."""

from nanogs import io
from nanogs.errors import FormatError
from nanogs.splats import Splats

TEXT = (b"\n", b" ", b"-", b"9", b"\r", b"list ", b"\xff", b"\0")


def mutate(rng, data, *, header=None, anywhere=1.0, text=()):
    """Change, delete, repeat, and flip a bit of or insert text into, a few bytes.

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
        at, size = int(rng.integers(limit)), int(rng.integers(1, 12))
        kind = rng.integers(4)
        if kind == 0:
            out[at] = rng.integers(256)
        elif kind == 1:
            del out[at : at + size]
        elif kind == 2:
            out[at:at] = out[at : at + size]
        elif text:
            out[at:at] = text[rng.integers(len(text))]
        else:
            out[at] ^= 1 << rng.integers(8)
    return bytes(out)


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
