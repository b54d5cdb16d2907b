"""Lossless WebP files as arrays of bytes: the textures of SOG.

Layout of the container: https://developers.google.com/speed/webp/docs/riff_container
Its first chunks state the size of the image, so that a bomb is refused before it is decoded.
"""

import io
import struct

import numpy as np

from nanogs._types import U8
from nanogs.io.container import damaged
from nanogs.io.texts import reason

MAX_SIDE = 16_383  # of WebP: 14 bits
HEAD_BYTES = 1 << 16  # enough for the chunks before the picture, profiles and the like aside
_QUALITY, _METHOD = 70, 4  # effort of the search, not fidelity; more takes long and gains little


def encode(texels: U8) -> bytes:
    """Encode (H, W, 3|4) bytes; the same texels give the same file.

    Args:
        texels: RGB or RGBA.
    """
    from PIL import Image  # here and below: 20 ms that `--help` does without

    file = io.BytesIO()
    # Without `exact`, RGB under alpha 0 is destroyed: for these files data, not a colour unseen.
    Image.fromarray(texels).save(
        file, "WEBP", lossless=True, exact=True, quality=_QUALITY, method=_METHOD
    )
    return file.getvalue()


def size(data: bytes, where: str) -> tuple[int, int]:
    """Width and height that a lossless WebP file states, from its first `HEAD_BYTES`.

    Args:
        data: The file's beginning, or all of it.
        where: Its name, for the message.

    Raises:
        FormatError: It is no WebP file, or a lossy or moving one.
    """
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP":
        raise damaged(where, "is no WebP file")
    at, canvas = 12, None
    while at + 13 <= len(data):
        name, length = struct.unpack_from("<4sI", data, at)
        if name == b"VP8L":
            if data[at + 8] != 0x2F:
                break
            (sides,) = struct.unpack_from("<I", data, at + 9)
            found = (sides & 0x3FFF) + 1, (sides >> 14 & 0x3FFF) + 1
            if canvas not in (None, found):  # which is what a decoder makes room for
                break
            return found
        if name == b"VP8X" and at + 18 <= len(data):
            canvas = tuple(
                int.from_bytes(data[at + place : at + place + 3], "little") + 1
                for place in (12, 15)
            )
        if name in (b"VP8 ", b"ALPH"):
            raise damaged(where, "is a lossy WebP file, which garbles the values")
        if name == b"ANIM":
            raise damaged(where, "is a moving picture")
        at += 8 + length + length % 2
    raise damaged(where, "is a damaged WebP file")


def decode(data: bytes, where: str) -> U8:
    """(P, 4) RGBA bytes of all texels, row by row, of a file whose `size` has been checked.

    Args:
        data: The whole file.
        where: Its name, for the message.

    Raises:
        FormatError: The file is damaged.
    """
    from PIL.Image import DecompressionBombError
    from PIL.WebPImagePlugin import WebPImageFile  # Image.open warns of fewer texels than we write

    width, height = size(data, where)
    try:
        with WebPImageFile(io.BytesIO(data)) as image:
            texels = np.asarray(image.convert("RGBA"))
    except (OSError, ValueError, SyntaxError, EOFError, DecompressionBombError) as error:
        raise damaged(where, f"cannot be decoded ({reason(error)})") from error
    if texels.shape != (height, width, 4):
        raise damaged(where, "is a damaged WebP file")
    return texels.reshape(-1, 4)
