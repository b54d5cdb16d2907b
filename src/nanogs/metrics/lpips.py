"""LPIPS, a learned perceptual distance; needs the package `lpips` and weights it fetches."""

from functools import cache
from typing import Any

from nanogs._types import F64, Array
from nanogs.errors import OptionError
from nanogs.metrics._images import colour_pair


def lpips(a: Array, b: Array, net: str = "vgg") -> float:
    """Learned perceptual distance, as the literature on Gaussian splatting reports it (VGG).

    Source: Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric",
    2018. The weights of the backbone are fetched by the package on first use.

    Args:
        a: (H, W, 3) RGB, floating point, clipped to [0, 1].
        b: The same shape.
        net: Backbone: "vgg", "alex" or "squeeze".

    Returns:
        0 for equal images; larger is worse.

    Raises:
        OptionError: lpips is not installed, the backbone is unknown, or the images are not RGB of
            one shape.
        ModelError: A pixel is not finite.
    """
    if net not in ("vgg", "alex", "squeeze"):
        raise OptionError(f"net must be vgg, alex or squeeze, not {net!r}.")
    first, second = colour_pair(a, b)
    try:
        import torch
    except ImportError as error:
        raise OptionError("LPIPS needs packages: pip install 'nanogs[lpips]'.") from error

    def tensor(image: F64) -> Any:  # noqa: ANN401 - torch is optional, so are its types
        return torch.from_numpy(image.transpose(2, 0, 1)[None] * 2 - 1).float()

    with torch.no_grad():
        return float(_network(net)(tensor(first), tensor(second)))


@cache
def _network(net: str) -> Any:  # noqa: ANN401 - torch is optional, so are its types
    try:
        from lpips import LPIPS
    except ImportError as error:
        raise OptionError("LPIPS needs packages: pip install 'nanogs[lpips]'.") from error
    return LPIPS(net=net, verbose=False).eval()
