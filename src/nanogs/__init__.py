"""nanogs makes 3D Gaussian splatting models smaller, without training."""

from typing import TYPE_CHECKING, Any

from nanogs._version import __version__
from nanogs.errors import NanogsError
from nanogs.splats import RenderMode, Splats

if TYPE_CHECKING:
    from nanogs.io import load, save
    from nanogs.report import SimplifyReport
    from nanogs.simplify import simplify

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

# Imported on first use: `nanogs --help` and `nanogs info` must not pay for Numba.
_LAZY = {
    "SimplifyReport": "nanogs.report",
    "load": "nanogs.io",
    "save": "nanogs.io",
    "simplify": "nanogs.simplify",
}


def __getattr__(name: str) -> Any:  # noqa: ANN401 - PEP 562
    if name not in _LAZY:
        raise AttributeError(f"module 'nanogs' has no attribute {name!r}")
    from importlib import import_module

    value = getattr(import_module(_LAZY[name]), name)
    globals()[name] = value
    return value
