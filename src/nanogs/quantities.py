"""Parsing of numbers with units, such as "20MB"."""

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING

from nanogs.errors import OptionError
from nanogs.ranges import is_number

if TYPE_CHECKING:
    from fractions import Fraction

MULTIPLES: Mapping[str, int] = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9}
_UNITS = {
    **MULTIPLES,
    "b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "kib": 2**10, "mib": 2**20, "gib": 2**30,
}  # fmt: skip


def parse_bytes(text: str) -> int:
    """Parse a number of bytes: `20MB`, `20M`, `1.5 GiB` or `4096`; k is 1000 and Ki is 1024.

    Raises:
        OptionError: The text is no such size.
    """
    value = multiple(text, _UNITS)
    if value is None:
        raise OptionError(
            f"The size must be like 20MB, with B, kB, MB, GB, KiB, MiB or GiB, not {text!r}."
        )
    return int(value)


def is_unit(text: str) -> bool:
    """Return whether a word is a unit without its number, such as MB, k or %."""
    return text == "%" or (bool(text) and text.lower() in _UNITS)


def as_bytes(size: int | str) -> int:
    """Convert a size, given as a number of bytes or as text, to bytes.

    Raises:
        OptionError: It is neither, or below 0.
    """
    if isinstance(size, str):
        return parse_bytes(size)
    try:
        whole = int(size)
    except (TypeError, ValueError, OverflowError):
        whole = -1
    if not is_number(size) or whole != size or whole < 0:
        raise OptionError(f'A size is a number of bytes or text like "20MB", not {size!r}.')
    return whole


def multiple(text: str, units: Mapping[str, int]) -> "Fraction | None":
    """Parse a number with a unit of `units`, and multiply them; None for other text."""
    from fractions import Fraction

    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([a-z]*)", text.strip().lower())
    if match is None or match[2] not in units:
        return None
    return Fraction(match[1]) * units[match[2]]
