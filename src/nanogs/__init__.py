"""nanogs makes 3D Gaussian splatting models smaller, without training."""

from nanogs._version import __version__
from nanogs.errors import NanogsError
from nanogs.io import load, save
from nanogs.report import SimplifyReport

# The function takes the name of its package here, so it must be bound now: a later, lazy import of
# any module in that package would bind the package instead. It imports Numba on its first call.
from nanogs.simplify.api import simplify
from nanogs.splats import RenderMode, Splats

__all__ = [
    "NanogsError",
    "RenderMode",
    "SimplifyReport",
    "Splats",
    "__version__",
    "load",
    "save",
    "simplify",
]
