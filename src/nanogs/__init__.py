"""nanogs makes 3D Gaussian splatting models smaller, without training."""

from importlib import import_module
from typing import TYPE_CHECKING

from nanogs._version import __version__

if TYPE_CHECKING:
    from nanogs import filters
    from nanogs.conversion import ConvertReport, convert
    from nanogs.costs import DrawCost
    from nanogs.errors import NanogsError
    from nanogs.fit.api import refit
    from nanogs.fit.parameters import RefitParameters
    from nanogs.fit.report import RefitReport
    from nanogs.io import load, open, save  # noqa: A004 - what it is called everywhere
    from nanogs.levels_of_detail import write_levels
    from nanogs.model_info import info
    from nanogs.pipeline.api import simplify
    from nanogs.pipeline.files import simplify_blocks
    from nanogs.pipeline.grown import Grown, Measured, grow
    from nanogs.pipeline.levels import levels
    from nanogs.pipeline.options.presets import PRESETS as presets  # noqa: N811 - read like a module
    from nanogs.place import Place
    from nanogs.raster.camera import Camera
    from nanogs.report import SimplifyReport
    from nanogs.scoring.api import compare
    from nanogs.scoring.mixed import MixedComparison, compare_mixed
    from nanogs.scoring.modes import ModeEvidence, mode_evidence
    from nanogs.scoring.packing_cost import packing_cost
    from nanogs.source import Source
    from nanogs.splats import RenderMode, Splats
    from nanogs.views.api import render
    from nanogs.views.costing import draw_cost

__all__ = [
    "Camera",
    "ConvertReport",
    "DrawCost",
    "Grown",
    "Measured",
    "MixedComparison",
    "ModeEvidence",
    "NanogsError",
    "Place",
    "RefitParameters",
    "RefitReport",
    "RenderMode",
    "SimplifyReport",
    "Source",
    "Splats",
    "__version__",
    "compare",
    "compare_mixed",
    "convert",
    "draw_cost",
    "filters",
    "grow",
    "info",
    "levels",
    "load",
    "mode_evidence",
    "open",
    "packing_cost",
    "presets",
    "refit",
    "render",
    "save",
    "simplify",
    "simplify_blocks",
    "write_levels",
]

# Module of each public name. Names are imported lazily, at first access: the command runs this
# file too, and its `--help` needs neither NumPy nor any of these.
_HOMES = {
    "Camera": "raster.camera",
    "ConvertReport": "conversion",
    "DrawCost": "costs",
    "Grown": "pipeline.grown",
    "Measured": "pipeline.grown",
    "MixedComparison": "scoring.mixed",
    "ModeEvidence": "scoring.modes",
    "NanogsError": "errors",
    "Place": "place",
    "RefitParameters": "fit.parameters",
    "RefitReport": "fit.report",
    "RenderMode": "splats",
    "SimplifyReport": "report",
    "Source": "source",
    "Splats": "splats",
    "compare": "scoring.api",
    "compare_mixed": "scoring.mixed",
    "convert": "conversion",
    "draw_cost": "views.costing",
    "grow": "pipeline.grown",
    "info": "model_info",
    "levels": "pipeline.levels",
    "load": "io",
    "mode_evidence": "scoring.modes",
    "open": "io",
    "packing_cost": "scoring.packing_cost",
    "presets": "pipeline.options.presets",
    "refit": "fit.api",
    "render": "views.api",
    "save": "io",
    "simplify": "pipeline.api",
    "simplify_blocks": "pipeline.files",
    "write_levels": "levels_of_detail",
}
_ATTRIBUTES = {"presets": "PRESETS"}  # names that differ from the attribute of the module
_MODULES = (
    "datasets", "errors", "filters", "formatting", "frames", "io", "lod", "progress", "report",
    "source", "splats",
)  # fmt: skip


def __dir__() -> list[str]:
    own = (name for name in globals() if name.startswith("__"))  # not what this file imports
    return sorted({*own, *__all__, *_MODULES})


if not TYPE_CHECKING:  # a type checker would accept any attribute name

    def __getattr__(name: str) -> object:
        if name in _MODULES:
            return import_module(f"{__name__}.{name}")
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        home = import_module(f"{__name__}.{_HOMES[name]}")
        value = getattr(home, _ATTRIBUTES.get(name, name))
        globals()[name] = value
        return value
