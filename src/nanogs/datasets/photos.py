"""Photographs on disk: finding the file of a name, and reading sizes and pixels."""

import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np
from PIL import Image
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.WebPImagePlugin import WebPImageFile

from nanogs._types import F32, F
from nanogs.errors import FormatError, OptionError
from nanogs.io.files import HEAD_BYTES, refuse_stand_in
from nanogs.paths import is_file

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".PNG", ".JPG", ".JPEG")
# Pillow's decoders raise these, and not only OSError, for damaged files.
_DAMAGED = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    IndexError,
    struct.error,
    zlib.error,
)
_PLUGINS: dict[bytes, Callable[[BinaryIO], ImageFile]] = {
    b"\x89PNG": PngImageFile,
    b"\xff\xd8\xff": JpegImageFile,
    b"RIFF": WebPImageFile,
}
_WIDE = ("I", "F")  # modes of grey of more than 8 bits, which Pillow would clip to 255


def find_photo(folder: Path, name: str) -> Path | None:
    """Return the path of the photograph that a camera file names, or None if there is none.

    Tried in order: the name itself, the name with an image suffix appended (NeRF-Synthetic omits
    it), and with its suffix replaced (downscaled copies are often stored in another format).
    """
    exact = folder / name
    if is_file(exact):
        return exact
    stems = [name]
    if exact.suffix.lower() in SUFFIXES:
        stems.append(name[: -len(exact.suffix)])
    candidates = (folder / (stem + suffix) for stem in stems for suffix in SUFFIXES)
    return next((path for path in candidates if is_file(path)), None)


def photo_size(path: Path) -> tuple[int, int]:
    """Return a photograph's width and height in pixels, as stored; pixels are not decoded.

    The orientation in its metadata is ignored, because camera files refer to the stored rows.

    Raises:
        FormatError: The file is missing or not a readable image.
    """
    with _opened(path) as image:
        return image.size


def is_transparent(path: Path) -> bool:
    """Return whether a photograph has alpha or a transparent colour; pixels are not decoded.

    Raises:
        FormatError: The file is missing or not a readable image.
    """
    with _opened(path) as image:
        return image.has_transparency_data


def read_photo(path: Path, size: tuple[int, int], background: Sequence[float] | F) -> F32:
    """Decode a photograph, and composite it over a background colour.

    Args:
        path: The image file; its alpha, if any, is not premultiplied.
        size: Width and height in pixels that the camera expects.
        background: Three numbers in [0, 1], RGB.

    Returns:
        (height, width, 3) float32 in [0, 1], RGB as stored (no colour management), row 0 on top.

    Raises:
        FormatError: It cannot be decoded, has another size, or is grey with more than 8 bits per
            pixel; of colours of 16 bits per channel, the upper 8 are used.
        OptionError: The background is not three numbers in [0, 1].
    """
    colour = _checked_background(background)
    with _opened(path) as image:
        _check_decodable(path, image, size)
        straight = image.has_transparency_data
        pixels = np.asarray(image.convert("RGBA" if straight else "RGB"), dtype=np.float32)
    pixels = pixels / np.float32(255)
    if not straight:
        return pixels
    alpha = pixels[..., 3:]
    composite: F32 = pixels[..., :3] * alpha + colour * (1 - alpha)
    return composite


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """Open an image in a context manager; pixels are decoded lazily within it.

    Raises:
        FormatError: It is missing, damaged or a placeholder such as a Git LFS pointer; also for
            errors of decoding within the block.
    """
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
            refuse_stand_in(path, head, "photograph")
            file.seek(0)
            with _identified(file, head) as image:
                yield image
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise FormatError(f"{path}: has too many pixels; use smaller photographs.") from error
    except _DAMAGED as error:
        reason = getattr(error, "strerror", None) or type(error).__name__
        raise FormatError(
            f"{path}: is not a readable photograph ({reason}); restore the image file."
        ) from error


def _identified(file: BinaryIO, head: bytes) -> ImageFile:
    """Open an image by the plugin of its format.

    Pillow itself warns on stderr of more than 89 megapixels and refuses twice as many, although
    memory is planned for photographs of any size; a filter of warnings would affect other threads.
    """
    for signature, plugin in _PLUGINS.items():
        if head.startswith(signature):
            return plugin(file)
    return Image.open(file)


def _check_decodable(path: Path, image: Image.Image, size: tuple[int, int]) -> None:
    if image.size != size:
        raise FormatError(
            f"{path}: is {image.size[0]}x{image.size[1]} pixels, but its camera is"
            f" {size[0]}x{size[1]}; use the photographs that the cameras were made for."
        )
    if image.mode.split(";")[0] in _WIDE:
        raise FormatError(
            f"{path}: has pixels of type {image.mode}; convert it to 8 bits a channel."
        )


def _checked_background(background: Sequence[float] | F) -> F32:
    try:
        colour = np.asarray(background, dtype=np.float32)
    except (TypeError, ValueError) as error:
        raise OptionError(f"background {background!r}: give three numbers from 0 to 1.") from error
    if colour.shape != (3,) or not np.all((colour >= 0) & (colour <= 1)):
        raise OptionError(f"background {background!r}: give three numbers from 0 to 1.")
    return colour
