"""nanogs makes 3D Gaussian splatting models smaller, without training."""

from importlib import import_module
from typing import TYPE_CHECKING

from nanogs._version import __version__

if TYPE_CHECKING:
    from nanogs import filters
    from nanogs.errors import NanogsError
    from nanogs.io import load, save
    from nanogs.lod.levels import levels
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

# Where the names are from. They are imported when they are first asked for: the command runs this
# file too, and its `--help` needs neither NumPy nor any of these.
_HOMES = {
    "NanogsError": "errors",
    "RefitParameters": "refit.parameters",
    "RefitReport": "refit.report",
    "RenderMode": "splats",
    "SimplifyReport": "report",
    "Splats": "splats",
    "levels": "lod.levels",
    "load": "io",
    "refit": "refit.api",
    "save": "io",
    "simplify": "simplify.api",
    "simplify_blocks": "scale.api",
}
_MODULES = (
    "datasets", "errors", "filters", "formatting", "frames", "io", "lod", "report", "scale",
    "splats",
)  # fmt: skip

# The first import of a package, and no later one, binds it to its name here. These two names are
# functions, so their packages, which hold next to nothing, are imported now and unbound.
for _name in ("refit", "simplify"):
    import_module(f"{__name__}.{_name}")
    del globals()[_name]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_MODULES})


if not TYPE_CHECKING:  # a type checker would take every name for one of ours

    def __getattr__(name: str) -> object:
        if name in _MODULES:
            return import_module(f"{__name__}.{name}")
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
        globals()[name] = value
        return value
