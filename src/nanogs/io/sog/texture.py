"""Encoding and decoding the textures of SOG: arrays of bytes as lossless WebP files.

Layout of the container: https://developers.google.com/speed/webp/docs/riff_container
Its first chunks state the image size, so that a decompression bomb is refused before decoding.
"""

import io
import math
import struct
from collections.abc import Callable

import numpy as np

from nanogs._types import U8
from nanogs.io.json_fields import refused
from nanogs.io.texts import reason

MAX_SIDE = 16_383  # largest width and height of WebP, 14 bits
HEAD_BYTES = 1 << 16  # enough for the chunks before the image data, unless there are profiles
# Compression effort, not fidelity. Higher methods take 2 to 4 times as long for files that differ
# by -0.2 to 0.7 %; see `docs/performance.md`.
_QUALITY, _METHOD = 70, 2
_BLOCK = 4  # width and height of textures are multiples of it

Submit = Callable[[str, U8], None]
"""Starts the encoding of a texture, by name."""


def as_texture(texels: U8) -> U8:
    """Arrange (N, C) bytes as an almost square texture, (H, W, C), padded with zeros."""
    count, channels = texels.shape
    width = _BLOCK * math.ceil(math.sqrt(count) / _BLOCK)
    height = _BLOCK * math.ceil(count / width / _BLOCK)
    out = np.zeros((height * width, channels), np.uint8)
    out[:count] = texels
    return out.reshape(height, width, channels)


def encode(texels: U8) -> bytes:
    """Encode (H, W, 3|4) bytes; the same texels give the same file.

    Args:
        texels: RGB or RGBA.
    """
    from PIL import Image  # imported here and below, because it takes 20 ms of `--help`

    file = io.BytesIO()
    # Without `exact`, RGB values under alpha 0 are lost; here they are data, not invisible colours.
    Image.fromarray(texels).save(
        file, "WEBP", lossless=True, exact=True, quality=_QUALITY, method=_METHOD
    )
    return file.getvalue()


def size(data: bytes, where: str) -> tuple[int, int]:
    """Read the width and height of a lossless WebP file from its first `HEAD_BYTES`.

    Args:
        data: The first bytes of the file, or all of it.
        where: Its name, for the message.

    Raises:
        FormatError: It is no WebP file, or a lossy or animated one.
    """
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP":
        raise refused(where, "is no WebP file")
    at, canvas = 12, None
    while at + 13 <= len(data):
        name, length = struct.unpack_from("<4sI", data, at)
        if name == b"VP8L":
            if data[at + 8] != 0x2F:
                break
            (sides,) = struct.unpack_from("<I", data, at + 9)
            found = (sides & 0x3FFF) + 1, (sides >> 14 & 0x3FFF) + 1
            if canvas not in (None, found):  # a decoder would allocate the size of the canvas
                break
            return found
        if name == b"VP8X" and at + 18 <= len(data):
            canvas = tuple(
                int.from_bytes(data[at + place : at + place + 3], "little") + 1
                for place in (12, 15)
            )
        if name in (b"VP8 ", b"ALPH"):
            raise refused(where, "is a lossy WebP file, which changes the values")
        if name == b"ANIM":
            raise refused(where, "is an animation")
        at += 8 + length + length % 2
    raise refused(where, "is a damaged WebP file")


def decode(data: bytes, where: str) -> U8:
    """Decode a file whose `size` has been checked to (P, 4) RGBA bytes of all texels, row by row.

    Args:
        data: The whole file.
        where: Its name, for the message.

    Raises:
        FormatError: The file is damaged.
    """
    from PIL.Image import DecompressionBombError
    from PIL.WebPImagePlugin import WebPImageFile  # Image.open warns at sizes that we write

    width, height = size(data, where)
    try:
        with WebPImageFile(io.BytesIO(data)) as image:
            texels = np.asarray(image.convert("RGBA"))
    except (OSError, ValueError, SyntaxError, EOFError, DecompressionBombError) as error:
        raise refused(where, f"cannot be decoded ({reason(error)})") from error
    if texels.shape != (height, width, 4):
        raise refused(where, "is a damaged WebP file")
    return texels.reshape(-1, 4)
