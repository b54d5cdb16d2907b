"""nanogs makes 3D Gaussian splatting models smaller, without training."""

from importlib import import_module
from typing import TYPE_CHECKING

from nanogs._version import __version__

if TYPE_CHECKING:
    from nanogs import filters
    from nanogs.compare.api import compare
    from nanogs.errors import NanogsError
    from nanogs.io import load, save
    from nanogs.lod.levels import levels
    from nanogs.model_info import info
    from nanogs.refit.api import refit
    from nanogs.refit.parameters import RefitParameters
    from nanogs.refit.report import RefitReport
    from nanogs.render.api import render
    from nanogs.render.camera import Camera
    from nanogs.report import SimplifyReport
    from nanogs.scale.api import simplify_blocks
    from nanogs.simplify.api import simplify
    from nanogs.simplify.presets import PRESETS as presets  # noqa: N811 - read like a module
    from nanogs.splats import RenderMode, Splats

__all__ = [
    "Camera",
    "NanogsError",
    "RefitParameters",
    "RefitReport",
    "RenderMode",
    "SimplifyReport",
    "Splats",
    "__version__",
    "compare",
    "filters",
    "info",
    "levels",
    "load",
    "presets",
    "refit",
    "render",
    "save",
    "simplify",
    "simplify_blocks",
]

# Where the names are from. They are imported when they are first asked for: the command runs this
# file too, and its `--help` needs neither NumPy nor any of these.
_HOMES = {
    "Camera": "render.camera",
    "NanogsError": "errors",
    "RefitParameters": "refit.parameters",
    "RefitReport": "refit.report",
    "RenderMode": "splats",
    "SimplifyReport": "report",
    "Splats": "splats",
    "compare": "compare.api",
    "info": "model_info",
    "levels": "lod.levels",
    "load": "io",
    "presets": "simplify.presets",
    "refit": "refit.api",
    "render": "render.api",
    "save": "io",
    "simplify": "simplify.api",
    "simplify_blocks": "scale.api",
}
_ATTRIBUTES = {"presets": "PRESETS"}  # what they are called there, if not the same
_MODULES = (
    "datasets", "errors", "filters", "formatting", "frames", "io", "lod", "progress", "report",
    "scale", "splats",
)  # fmt: skip

# Functions with the name of a package. The first import of a package, and no later one, binds it to
# its name here, so these, which hold next to nothing, are imported now and unbound.
_HIDDEN = {
    name: import_module(f"{__name__}.{name}") for name in ("compare", "refit", "render", "simplify")
}
for _name in _HIDDEN:
    del globals()[_name]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_MODULES})


if not TYPE_CHECKING:  # a type checker would take every name for one of ours

    def __getattr__(name: str) -> object:
        if name in _MODULES:
            return import_module(f"{__name__}.{name}")
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        home = import_module(f"{__name__}.{_HOMES[name]}")
        value = getattr(home, _ATTRIBUTES.get(name, name))
        if name in _HIDDEN:
            # `import nanogs.simplify.presets as p` takes `presets` from what `nanogs.simplify` is,
            # the function; so that has the attributes of the package, those to come too.
            value.__dict__ = _HIDDEN[name].__dict__
        globals()[name] = value
        return value
