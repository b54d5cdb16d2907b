"""Pictures for the page of a comparison: error maps, and images as `data:` URLs."""

import base64
import io

import numpy as np

from nanogs._types import F32
from nanogs.raster.images import LARGEST_WEBP, to_bytes

_QUALITY = 85
ERROR_FULL_SCALE = 0.25  # mean absolute difference shown in the map's brightest colour
# Every 15th colour of "inferno", by Nathaniel Smith and Stéfan van der Walt (CC0).
_INFERNO = (
    "000004 0a0722 1e0c45 380962 510e6c 69166e 801f6c 982766 b0315b"
    " c63d4d d94d3d e9612b f47918 fa9407 fcb014 f8cd37 f2ea69 fcffa4"
)
_HEAT = np.array([list(bytes.fromhex(colour)) for colour in _INFERNO.split()]) / 255


def error_map(reference: F32, image: F32) -> F32:
    """Draw the mean absolute difference over channels as a heat map, (H, W, 3) float32.

    Black is no difference; `ERROR_FULL_SCALE` and above is the brightest colour.
    """
    difference = np.abs(reference - image).mean(axis=2) / ERROR_FULL_SCALE
    shares = np.linspace(0, 1, len(_HEAT))
    channels = [np.interp(difference, shares, _HEAT[:, channel]) for channel in range(3)]
    return np.stack(channels, axis=2).astype(np.float32)


def data_uri(image: F32) -> str:
    """Encode the image as a `data:` URL, for self-contained pages: WebP, or JPEG if too large."""
    from PIL import Image

    buffer, kind = io.BytesIO(), "webp" if max(image.shape) <= LARGEST_WEBP else "jpeg"
    Image.fromarray(to_bytes(image)).save(buffer, format=kind, quality=_QUALITY)
    return f"data:image/{kind};base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
