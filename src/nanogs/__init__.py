"""nanogs makes 3D Gaussian splatting models smaller, without training."""

from nanogs import filters
from nanogs._version import __version__
from nanogs.errors import NanogsError
from nanogs.io import load, save
from nanogs.lod.levels import levels

# These functions take the names of their packages here, so they must be bound now: a later, lazy
# import of any module in them would bind the package instead. They import Numba when called.
from nanogs.refit.api import refit
from nanogs.refit.parameters import RefitParameters
from nanogs.refit.report import RefitReport
from nanogs.report import SimplifyReport
from nanogs.scale.api import simplify_blocks
from nanogs.simplify.api import simplify
from nanogs.splats import RenderMode, Splats

__all__ = [
    "NanogsError",
    "RefitParameters",
    "RefitReport",
    "RenderMode",
    "SimplifyReport",
    "Splats",
    "__version__",
    "filters",
    "levels",
    "load",
    "refit",
    "save",
    "simplify",
    "simplify_blocks",
]
