"""Methods by name: presets with or without changed parameters, and baselines.

A name is that of a baseline, that of a preset, or a preset with parameters: `paper:tau=0:k=8`.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nanogs.bench.baselines import BASELINES, Method, MethodContext
from nanogs.errors import OptionError
from nanogs.pipeline.api import simplify
from nanogs.pipeline.checks import refuse_searches
from nanogs.pipeline.options.presets import PRESETS, parameters, renders
from nanogs.pipeline.options.target import Goal
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
"""Methods of the ablation study: each differs from its preset in one parameter, or is a preset."""


def all_methods() -> tuple[str, ...]:
    """Return the names of all presets and baselines."""
    return (*PRESETS, *BASELINES)


def find_method(name: str) -> Method:
    """Return the method of a name.

    Args:
        name: A baseline, a preset, or a preset with parameters as `preset:name=value:name=value`.

    Raises:
        OptionError: There is none, or a parameter is unknown or out of its range.
    """
    if name in BASELINES:
        return BASELINES[name]
    find_preset(name)  # refused before it runs

    def run(splats: Splats, count: int, context: MethodContext) -> Splats:
        small, _ = simplify(splats, count=count, **preset_arguments(name, context))
        return small

    return run


def preset_arguments(name: str, context: MethodContext) -> dict[str, Any]:
    """Return the preset of a method, its views and its parameters, as `simplify` takes them.

    The views are those of training photographs, if there are any and the preset renders; the seed
    is the context's, if the preset takes one and the name states none.

    Raises:
        OptionError: As for `find_method`.
    """
    preset, overrides = find_preset(name)
    if hasattr(PRESETS[preset], "seed"):
        overrides.setdefault("seed", context.seed)
    looks = context.trained and renders(parameters(preset, overrides))
    return {"preset": preset, "cameras": context.cameras if looks else None, **overrides}


def find_preset(name: str) -> tuple[str, dict[str, Any]]:
    """Split a method's name into a preset and the parameters that the name overrides.

    Raises:
        OptionError: As for `find_method`.
    """
    preset, *assignments = name.split(":")
    if preset in BASELINES:
        raise OptionError(f"{name}: only presets take parameters; name {preset} without any.")
    if preset not in PRESETS:
        raise OptionError(f"There is no method {preset!r}; choose from {', '.join(all_methods())}.")
    defaults = dataclasses.asdict(PRESETS[preset])
    overrides = dict(_parse(assignment, defaults) for assignment in assignments)
    parameters(preset, overrides)
    return preset, overrides


def sized_methods(formats: Sequence[str]) -> tuple[str, ...]:
    """Return the presets that can meet a file size in all of the formats, given as suffixes."""
    return tuple(preset for preset in PRESETS if not _refused(preset, formats))


def _refused(preset: str, formats: Sequence[str]) -> bool:
    try:
        for suffix in formats:
            refuse_unsized(preset, suffix)
    except OptionError:
        return True
    return False


def refuse_unsized(name: str, suffix: str) -> None:
    """Refuse a method that cannot search for the count that meets a file size.

    Raises:
        OptionError: It is a baseline, or a preset without a search; or as for `find_method`.
    """
    if name in BASELINES:
        known = ", ".join(sized_methods([suffix]))
        raise OptionError(f"{name} cannot make a file of a given size; choose from {known}.")
    preset, _ = find_preset(name)
    refuse_searches(Goal(size=1), preset, Path(f"model{suffix}"))


def _parse(assignment: str, defaults: dict[str, Any]) -> tuple[str, Any]:
    """Parse `name=value`; the value has the type of the parameter's default."""
    name, _, text = assignment.partition("=")
    if name not in defaults:
        raise OptionError(f"There is no parameter {name!r}; choose from {', '.join(defaults)}.")
    kind = type(defaults[name])
    try:
        return name, _SWITCHES[text.lower()] if kind is bool else kind(text)
    except (KeyError, ValueError):
        wanted = {bool: "true or false", int: "a whole number"}.get(kind, "a number")
        raise OptionError(f"{name} takes {wanted}, not {text!r}.") from None
