"""Choices made on a page, parsed from JSON and checked. This module does not import NumPy."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from nanogs.errors import OptionError, did_you_mean
from nanogs.pipeline.options.presets import FORESTS
from nanogs.pipeline.options.target import Goal

UPS = ("+x", "-x", "+y", "-y", "+z", "-z")
MODES = ("default", "mip")
_WISHES = {"splats": "count", "bytes": "size", "psnr": "psnr"}  # JSON name: field of `Goal`


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterChoice:
    """Filters that remove splats before the model is simplified.

    Attributes:
        box: x, y, z of the lowest corner and of the highest, scene units; None for no box.
        min_opacity: The lowest alpha that is kept, in [0, 1], or None.
        floaters: Whether floaters are removed.
    """

    box: tuple[float, ...] | None = None
    min_opacity: float | None = None
    floaters: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """A smaller model, as a page asks for it.

    Attributes:
        goal: Number of splats, bytes or PSNR.
        format: Suffix of the file, or of a layout of levels.
        preset: One of `FORESTS`.
        sh_degree: Highest degree of harmonics, or None for all.
        filters: Filters that remove splats first.
        render_mode: Render mode of the model, or None for the one that its file states.
        up: Up axis, one of `UPS`, or None to find it.
        levels: Ratios of levels of detail, or None for one model.
    """

    goal: Goal
    format: str = ".ply"
    preset: str = "default"
    sh_degree: int | None = None
    filters: FilterChoice = field(default_factory=FilterChoice)
    render_mode: str | None = None
    up: str | None = None
    levels: tuple[float, ...] | None = None


def choice_of(data: object) -> Choice:
    """Parse a choice from JSON data.

    Args:
        data: Result of `json.loads`: an object with the fields of `Choice`, `wish` for its goal.

    Raises:
        OptionError: Something is unknown, of another type, or out of range.
    """
    given = _entries(data, "choice", ("wish", *tuple(Choice.__dataclass_fields__)[1:]))
    return Choice(
        goal=_goal(given.get("wish")),
        format=_text(given, "format", None, ".ply"),
        preset=_text(given, "preset", FORESTS, "default"),
        sh_degree=_degree(given.get("sh_degree")),
        filters=_sifting(given.get("filters")),
        render_mode=_text(given, "render_mode", MODES, "") or None,
        up=_text(given, "up", UPS, "") or None,
        levels=_levels(given.get("levels")),
    )


def _entries(data: object, what: str, known: tuple[str, ...]) -> Mapping[str, Any]:
    """Check that data is a JSON object with known entries only, and return it.

    Raises:
        OptionError: It is not an object, or has an unknown entry.
    """
    if not isinstance(data, dict):
        raise OptionError(f"The {what} must be an object of names and values.")
    for name in data:
        if name not in known:
            raise OptionError(f"The {what} has no entry {name!r}{did_you_mean(str(name), known)}.")
    return data


def _goal(data: object) -> Goal:
    given = _entries(data, "wish", tuple(_WISHES))
    if len(given) != 1:
        raise OptionError("The wish is exactly one of splats, bytes and psnr.")
    [(name, value)] = given.items()
    number = _number(value, name)
    if name == "psnr":
        return Goal(psnr=number)
    if number != int(number):
        raise OptionError(f"The wish for {name} must be a whole number, not {value!r}.")
    return Goal(count=int(number)) if name == "splats" else Goal(size=int(number))


def _sifting(data: object) -> FilterChoice:
    given = _entries(data or {}, "filters", tuple(FilterChoice.__dataclass_fields__))
    box, alpha, floaters = (given.get(name) for name in ("box", "min_opacity", "floaters"))
    if box is not None and (not isinstance(box, list) or len(box) != 6):
        raise OptionError(
            "A box must be six numbers: x, y, z of its lowest corner and of its highest."
        )
    if not isinstance(floaters, bool | None):
        raise OptionError(f"Floaters are left out or not: true or false, not {floaters!r}.")
    corners = None if box is None else tuple(_number(value, "box") for value in box)
    if corners and any(corners[axis] > corners[axis + 3] for axis in range(3)):
        raise OptionError("The lowest corner of a box must not be above the highest.")
    lowest = None if alpha is None else _number(alpha, "min_opacity")
    if lowest is not None and not 0 <= lowest <= 1:
        raise OptionError(f"The lowest opacity must be from 0 to 1, not {lowest:g}.")
    return FilterChoice(box=corners, min_opacity=lowest, floaters=bool(floaters))


def _levels(data: object) -> tuple[float, ...] | None:
    if data is None:
        return None
    try:
        ratios = tuple(float(part) for part in str(data).split(","))
    except ValueError:
        ratios = ()
    if not isinstance(data, str) or not ratios or not all(0 < ratio <= 1 for ratio in ratios):
        raise OptionError(
            f"Levels must be ratios separated by commas, like 1,0.5,0.1, not {data!r}."
        )
    from nanogs.pipeline.levels import checked_ratios

    return checked_ratios(ratios)


def _degree(data: object) -> int | None:
    if data is None:
        return None
    if isinstance(data, bool) or not isinstance(data, int) or not 0 <= data <= 4:
        raise OptionError(f"The SH degree must be from 0 to 4, not {data!r}.")
    return data


def _text(given: Mapping[str, Any], name: str, known: tuple[str, ...] | None, usual: str) -> str:
    """Return a string entry of the choice, or the default `usual` if it is missing or null.

    Raises:
        OptionError: It is not a string, or not one of `known`.
    """
    value = given.get(name)
    if value is None:
        return usual
    if not isinstance(value, str) or (known is not None and value not in known):
        choices = f"one of {', '.join(known)}" if known else "a text"
        raise OptionError(f"The {name.replace('_', ' ')} must be {choices}, not {value!r}.")
    return value


def _number(value: object, name: str) -> float:
    """Check that a value is a finite number, and return it as a float.

    Raises:
        OptionError: It is not.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise OptionError(f"{name} must be a number, not {value!r}.")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise OptionError(f"{name} must be a finite number.")
    return number
