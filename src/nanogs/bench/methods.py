"""Methods by name: presets with or without changed parameters, and baselines.

A name is that of a baseline, that of a preset, or a preset and parameters: `paper:tau=0:k=8`.
"""

import dataclasses
from typing import Any

from nanogs.bench.baselines import BASELINES, Method, MethodContext
from nanogs.errors import OptionError
from nanogs.simplify.api import simplify
from nanogs.simplify.presets import PRESETS, PaperParameters, parameters
from nanogs.splats import Splats

ABLATED = "paper"
ABLATIONS = (
    ABLATED,
    f"{ABLATED}:graph=random",
    f"{ABLATED}:tau=0",
    f"{ABLATED}:lambda_geo=0",
    f"{ABLATED}:lambda_app=0",
)
"""What the published method is worth without each of its parts, one at a time."""


def all_methods() -> tuple[str, ...]:
    """Every preset and every baseline."""
    return (*PRESETS, *BASELINES)


def find_method(name: str) -> Method:
    """The method of that name.

    Args:
        name: A baseline, a preset, or a preset and parameters as `preset:name=value:name=value`.

    Raises:
        OptionError: There is none, or a parameter is unknown or out of its range.
    """
    if name in BASELINES:
        return BASELINES[name]
    preset, *assignments = name.split(":")
    if preset not in PRESETS:
        raise OptionError(f"There is no method {preset!r}; choose from {', '.join(all_methods())}.")
    overrides = dict(_parse(assignment) for assignment in assignments)
    parameters(preset, overrides)

    def run(splats: Splats, count: int, _context: MethodContext) -> Splats:
        small, _report = simplify(splats, count=count, preset=preset, **overrides)
        return small

    return run


def _parse(assignment: str) -> tuple[str, Any]:
    """Name and value of `name=value`, the value in the type of the parameter's default."""
    name, _, text = assignment.partition("=")
    defaults = dataclasses.asdict(PaperParameters())
    if name not in defaults:
        raise OptionError(f"There is no parameter {name!r}; choose from {', '.join(defaults)}.")
    try:
        return name, type(defaults[name])(text)
    except ValueError:
        raise OptionError(f"{name} takes a number, not {text!r}.") from None
