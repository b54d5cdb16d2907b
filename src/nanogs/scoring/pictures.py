"""Pictures of a comparison: the rendering, and where it differs from the reference."""

import base64
import io

import numpy as np

from nanogs._types import F32
from nanogs.raster.images import to_bytes

ERROR_FULL_SCALE = 0.25  # a mean absolute difference of this much is the map's brightest colour


def error_map(reference: F32, image: F32) -> F32:
    """(H, W, 3) float32: the mean absolute difference over the channels, as a heat map.

    Black is no difference; `ERROR_FULL_SCALE` and above is the brightest colour.
    """
    import matplotlib as mpl

    difference = np.abs(reference - image).mean(axis=2) / ERROR_FULL_SCALE
    colors: F32 = mpl.colormaps["inferno"](np.clip(difference, 0.0, 1.0))[..., :3]
    return colors.astype(np.float32)


def data_uri(image: F32, *, quality: int = 85) -> str:
    """The image as a WebP `data:` address, for pages that need no other file."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(to_bytes(image)).save(buffer, format="WEBP", quality=quality)
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
