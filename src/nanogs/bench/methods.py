"""Methods by name: presets with or without changed parameters, and baselines.

A name is that of a baseline, that of a preset, or a preset and parameters: `paper:tau=0:k=8`.
"""

import dataclasses
from typing import Any

from nanogs.bench.baselines import BASELINES, Method, MethodContext
from nanogs.errors import OptionError
from nanogs.pipeline.api import simplify
from nanogs.pipeline.presets import PRESETS, parameters
from nanogs.splats import Splats

_SWITCHES = {"true": True, "false": False}

ABLATED = "paper"
ABLATIONS = (
    ABLATED,
    f"{ABLATED}:graph=random",
    f"{ABLATED}:tau=0",
    f"{ABLATED}:lambda_geo=0",
    f"{ABLATED}:lambda_app=0",
    "default",
    "default:hidden=1",
    "default:pixels=1e6",
    "default:growth=1",
    "default:rounds=0",
    "default:lambda_app=0",
    "default:k=16",
    "default:steps=0",
    "fast",
    "fast:balance=0",
    "fast:balance=1",
    "fast:rounds=3",
    "best",
)
"""The ablations: a method without each of its parts, one at a time."""


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
    defaults = dataclasses.asdict(PRESETS[preset])
    overrides = dict(_parse(assignment, defaults) for assignment in assignments)
    parameters(preset, overrides)

    def run(splats: Splats, count: int, context: MethodContext) -> Splats:
        views = context.cameras if context.trained else None
        small, _ = simplify(splats, count=count, preset=preset, cameras=views, **overrides)
        return small

    return run


def _parse(assignment: str, defaults: dict[str, Any]) -> tuple[str, Any]:
    """Name and value of `name=value`, the value in the type of the parameter's default."""
    name, _, text = assignment.partition("=")
    if name not in defaults:
        raise OptionError(f"There is no parameter {name!r}; choose from {', '.join(defaults)}.")
    kind = type(defaults[name])
    try:
        return name, _SWITCHES[text.lower()] if kind is bool else kind(text)
    except (KeyError, ValueError):
        wanted = "true or false" if kind is bool else "a number"
        raise OptionError(f"{name} takes {wanted}, not {text!r}.") from None
