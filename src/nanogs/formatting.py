"""Formatting of numbers for people, the same on terminal and pages, and of values for JSON."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, is_dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

NONE = "–"  # noqa: RUF001 - an en dash stands for "no value"
_VIEWS_IN_NOTES = 3  # number of views that are named


def number_text(value: float | None, digits: int = 2) -> str:
    """Format a rounded number with thousands separators; infinity as ∞, None and NaN as a dash."""
    if value is None or math.isnan(value):
        return NONE
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    return f"{round(value, digits) + 0.0:,.{digits}f}"  # no -0.00


def exact_text(value: float) -> str:
    """Format a number with the fewest digits that parse to the same value: "0.1", "-3"."""
    return repr(float(value)).removesuffix(".0")


def counted(count: int, one: str, more: str = "") -> str:
    """Format a number with its noun in singular or plural: "1 splat holds", "2,000 splats hold".

    Args:
        count: The number.
        one: Text after 1.
        more: Text after any other number; by default `one` and an s.
    """
    return f"{count:,} {one if count == 1 else more or f'{one}s'}"


def listed(items: Iterable[Any], word: str) -> str:
    """Format a list with a word before the last item: "2, 3 or 4"."""
    *first, last = map(str, items)
    return f"{', '.join(first)} {word} {last}" if first else last


def notes_on_views(names: Sequence[str], fact: str) -> list[str]:
    """Return a note with a fact for each view, or one for all if there are more than three."""
    if len(names) <= _VIEWS_IN_NOTES:
        return [f"{name}: {fact}" for name in names]
    first, more = names[:_VIEWS_IN_NOTES], counted(len(names) - _VIEWS_IN_NOTES, "more view")
    return [f"{', '.join(first)} and {more}: {fact}"]


def unseen_cause(*, given: bool) -> str:
    """Return why views, given by a user or else automatic, may show nothing of a model."""
    if given:
        return "the cameras may be in another frame than the model"
    return "its splats may be too small or too faint to be seen"


def undrawn(count: int) -> str:
    """Return the note that `count` splats cannot be drawn by the rasteriser and the viewer."""
    one = "splat with a NaN or infinite value was not drawn"
    return counted(count, one, one.replace("splat", "splats").replace("was", "were"))


def bytes_text(count: int | None) -> str:
    """Format a number of bytes in a fitting unit: 1,500,000 becomes 1.5 MB; None a dash."""
    if count is None:
        return NONE
    value = float(count)
    for unit in ("B", "kB", "MB"):
        if value < 999.95:  # so that none is rounded to 1000.0
            return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1000
    return f"{value:.1f} GB"


def sizes_text(before: int | None, after: int | None, arrow: str) -> str:
    """Format two sizes, with the unit once if it is the same: 76.0 → 1.2 MB."""
    first, second = bytes_text(before), bytes_text(after)
    value, _, unit = first.rpartition(" ")
    return f"{value if second.endswith(f' {unit}') else first} {arrow} {second}"


def time_text(seconds: float) -> str:
    """Format a duration roughly: 0.4 s, 6 s, 12 min, 1.5 h."""
    if seconds < 0.95:
        return f"{seconds:.1f} s"
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def utf8(text: str) -> bytes:
    r"""Encode a text for pages and tables; invalid bytes of file names are written as \udcff."""
    return text.encode("utf-8", "backslashreplace")


def plain(value: Any) -> Any:  # noqa: ANN401 - whatever a report holds
    """Convert a report for JSON; infinities and NaN, which JSON lacks, become text."""
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return str(value) if isinstance(value, Path | StrEnum) else value
