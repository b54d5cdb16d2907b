"""Named sets of parameters."""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, TypeAlias

from nanogs.errors import OptionError, did_you_mean
from nanogs.fit.parameters import RefitParameters
from nanogs.formatting import listed
from nanogs.method.paper.parameters import PaperParameters
from nanogs.method.parameters import ForestParameters
from nanogs.ranges import known_parameters

Parameters: TypeAlias = PaperParameters | ForestParameters


PRESETS: Mapping[str, Parameters] = MappingProxyType(
    {
        "default": ForestParameters(),
        "fast": ForestParameters(rounds=1, guided=False, steps=0),
        # More views find hidden splats more reliably, so that these may weigh less.
        "best": ForestParameters(
            hidden=0.01,
            corrections=2,
            steps=224,
            views=24,
            further=204,
            halves=False,
            around=24,
            view_size=768,
        ),
        "paper": PaperParameters(),
    }
)
"""Parameters of each preset, by name; public as `nanogs.presets`."""
SUMMARIES: Mapping[str, str] = {
    "default": (
        "merge forest; the best-looking of several cuts, then a short optimisation against renders"
    ),
    "fast": "merge forest and one cut; renders nothing",
    "best": "as default, with a long fit on a new view for every step; takes about 4 times as long",
    "paper": "NanoGS as published",
}
DEFAULT_PRESET = "default"
# Arguments of `simplify` and its relatives, which a name that is no parameter may be a typo of.
_ARGUMENTS = (
    "ratio", "count", "size", "psnr", "draw_cost", "format", "format_options", "preset",
    "sh_degree", "frame", "cameras", "up", "nan", "device", "threads", "max_memory", "progress",
    "overwrite", "filters", "layout", "suffix", "measured", "environment", "environment_ratio",
    "render_mode", "block", "job", "scratch", "resume", "executor", "patience", "chunk",
    "chunk_min", "plain", "place", "source",
)  # fmt: skip
# The same that some of these functions do not take, with what to use there.
_ELSEWHERE = {
    "filters": " (nanogs.filters.apply filters a model first)",
    "overwrite": " (nanogs.save writes the result, and takes it)",
} | dict.fromkeys(
    ("block", "job", "scratch", "resume", "executor", "patience"),
    " (nanogs.simplify_blocks takes it)",
)
_SWITCHES = ("guided", "steps")  # parameters that decide which others have an effect
ROUND = 32  # steps in each round of the fit, about
SEARCHED_STEPS = 84  # least steps of the fit of a result whose packing is searched for
FORESTS: tuple[str, ...] = tuple(
    name
    for _, name in sorted(
        (own.steps, name) for name, own in PRESETS.items() if isinstance(own, ForestParameters)
    )
)
"""Presets that grow a merge forest, so that any count is made quickly; the shortest fit first."""


def parameters(preset: str, overrides: Mapping[str, Any]) -> Parameters:
    """Return the preset's parameters with some of them replaced.

    Args:
        preset: A name in `PRESETS`.
        overrides: Parameters by name; None leaves the preset's value.

    Raises:
        OptionError: No such preset or parameter, or a value out of its range.
    """
    if not isinstance(preset, str) or preset not in PRESETS:
        meant = did_you_mean(str(preset), PRESETS)
        raise OptionError(
            f"There is no preset {preset!r}{meant}; choose one of {', '.join(PRESETS)}."
        )
    given = {name: value for name, value in overrides.items() if value is not None}
    known = [entry.name for entry in dataclasses.fields(PRESETS[preset])]
    for name in given:
        if name not in known:
            others = [other for other in (*known, *_ARGUMENTS) if other != name]
            meant = _ELSEWHERE.get(name) or did_you_mean(name, others)
            raise OptionError(
                f"The preset {preset} has no parameter {name!r}{meant}; choose from"
                f" {', '.join(known)}."
            )
    return dataclasses.replace(PRESETS[preset], **given)


def with_longer_fit(preset: str, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Lengthen a short fit, for a result whose packing is searched for.

    The search makes and measures several results anyway, so the steps add little to its time. Each
    gets a view of its own.

    Args:
        preset: A name in `PRESETS`; any other is left to `parameters`.
        overrides: Parameters by name. If the steps or views of the fit are among them, they stay.
    """
    own = _forest_of(preset)
    given = {name for name, value in overrides.items() if value is not None}
    if own is None or not 0 < own.steps < SEARCHED_STEPS or given & {"steps", "further"}:
        return dict(overrides)
    further = own.further + SEARCHED_STEPS - own.steps
    return {**overrides, "steps": SEARCHED_STEPS, "further": further}


def with_usual_pixels(preset: str, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Fit levels to pictures as large as the views: people see them from afar.

    The arguments are those of `with_longer_fit`.
    """
    own, given = _forest_of(preset), overrides.get("steps")
    if own is None or overrides.get("finer") is not None:
        return dict(overrides)
    steps = own.steps if given is None else given  # without steps a note would call it idle
    return {**overrides, "finer": 1.0} if steps else dict(overrides)


def _forest_of(preset: str) -> ForestParameters | None:
    """Return a preset's parameters; None if it grows no forest, or is no preset."""
    own = PRESETS.get(preset) if isinstance(preset, str) else None
    return own if isinstance(own, ForestParameters) else None


def fit_parameters(parameters: ForestParameters) -> RefitParameters:
    """Return the parameters of the fit of a chosen result: its steps divided into rounds."""
    rounds = max(1, round(parameters.steps / ROUND))
    return RefitParameters(
        views=parameters.views,
        size=parameters.view_size,
        rounds=rounds,
        steps=max(-(-parameters.steps // rounds), 1),  # at least 1, also for planning without a fit
        halves=parameters.halves,
    )


def refuse_search(preset: str, target: str) -> None:
    """Refuse a search for a preset without a merge forest, since each try would be a full run.

    Args:
        preset: Its name.
        target: Name of the target that needs a search, for the message.

    Raises:
        OptionError: The preset grows none.
    """
    if not isinstance(PRESETS[preset], ForestParameters):
        raise OptionError(
            f"The preset {preset} cannot search for {target}, because each count tried would be a"
            " complete run; choose another preset."
        )


def effective(chosen: Parameters) -> dict[str, Any]:
    """Return the parameters that have an effect, by name: without views, none about views.

    If several balances are tried, the value is the text "0.5 or 1".
    """
    unused: set[str] = set()
    values = dataclasses.asdict(chosen)
    if isinstance(chosen, ForestParameters):
        values["balance"] = " or ".join(f"{balance:g}" for balance in chosen.balances)
        if not chosen.guided:
            unused |= {"hidden", "corrections"}
        if not chosen.steps:
            unused |= {"further", "finer", "halves"}
        if not chosen.guided and not chosen.steps:
            views = {name for name, known in known_parameters(chosen).items() if known.views}
            unused |= {"steps"} | views
    return {name: value for name, value in values.items() if name not in unused}


def idle_notes(preset: str, chosen: Parameters) -> tuple[str, ...]:
    """Return a note on the parameters that differ from the preset's but have no effect.

    They are not refused, because callers vary one preset or another by the same parameters.
    """
    used = {*effective(chosen), *_SWITCHES}
    usual = dataclasses.asdict(PRESETS[preset])
    differing = [name for name, value in dataclasses.asdict(chosen).items() if value != usual[name]]
    idle = [f"`{name}`" for name in differing if name not in used]
    if not idle:
        return ()
    cause = "nothing is rendered"
    if isinstance(chosen, ForestParameters) and renders(chosen):
        cause = "nothing guides the cut" if chosen.steps else "nothing is fitted"
    has, it = ("has", "it") if len(idle) == 1 else ("have", "them")
    names = listed(idle, "and")
    remedy = f"leave {it} out or choose another preset"
    return (f"{names} {has} no effect, because {cause} with the preset {preset} here; {remedy}.",)


def renders(chosen: Parameters) -> bool:
    """Whether a method renders views of the original."""
    return isinstance(chosen, ForestParameters) and (chosen.guided or chosen.steps > 0)
