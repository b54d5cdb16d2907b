"""Conversion of renderings to images of integers."""

import numpy as np

from nanogs._types import F32, U8, Array
from nanogs.raster.rendering import Rendering, clipped

LARGEST_WEBP = 16_383  # pixels along a side of a WebP picture


def color_image(rendering: Rendering, transparent: bool) -> Array:
    """Return the (H, W, 3 or 4) uint8 image of a rendering: RGB, or RGBA with straight alpha.

    A transparent image needs a rendering over black, whose colours are premultiplied.
    """
    return to_bytes(straight(rendering) if transparent else rendering.color)


def straight(rendering: Rendering) -> F32:
    """Return (H, W, 4) float32 in [0, 1]: RGBA with straight alpha, of a rendering over black."""
    color, alpha = rendering.color, rendering.alpha[..., None]
    divided = np.divide(color, alpha, out=np.zeros_like(color), where=alpha > 0)
    return clipped(np.concatenate([divided, alpha], axis=2))


def depth_image(rendering: Rendering) -> Array:
    """Return the (H, W) uint16 depth image: near is bright, linear in depth; 0 for no splat."""
    depth = rendering.depth
    image = np.zeros(rendering.alpha.shape, dtype=np.uint16)
    if depth is None or not np.isfinite(depth).any():
        return image
    hit = np.isfinite(depth)
    near, far = float(depth[hit].min()), float(depth[hit].max())
    share = (far - depth[hit]) / (far - near) if far > near else np.ones(int(hit.sum()))
    image[hit] = np.round(1 + share * 65534).astype(np.uint16)
    return image


def to_bytes(values: F32) -> U8:
    """Clip values to [0, 1] and convert them to uint8, rounded to nearest."""
    return (clipped(values) * 255.0 + 0.5).astype(np.uint8)
