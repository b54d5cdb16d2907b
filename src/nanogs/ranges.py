"""Parameters as dataclass fields with a default, a range, and a help text for the command."""

import math
import sys
from collections.abc import Hashable, Iterable
from dataclasses import dataclass, field, fields
from decimal import Decimal
from numbers import Integral, Real
from os import PathLike
from typing import Any

from nanogs.errors import OptionError, RangeError

MOST = 1_000_000  # of anything that is counted: more views or steps are a slip of the keyboard


@dataclass(frozen=True, slots=True)
class Parameter:
    """Range, unit and help text of a parameter: the metadata of its dataclass field.

    Attributes:
        low: The least value.
        high: The largest value; infinity itself is always refused.
        above: Whether `low` itself is refused.
        unit: Text after the range in messages, such as " pixels".
        help: Help of the command's option; empty if there is no option.
        option: Name of the option, if it differs from that of the parameter.
        views: Whether the parameter is about views.
        whole: Whether it must be a whole number, as its default is.
    """

    low: float
    high: float
    above: bool
    unit: str
    help: str
    option: str
    views: bool
    whole: bool

    def expected(self, value: Any) -> str:  # noqa: ANN401 - whatever a caller gives
        """Return the words after "must be" for a value that is refused; empty if it is valid."""
        if not is_number(value, whole=self.whole):
            return "a whole number" if self.whole else "a number"
        if not -math.inf < value < math.inf:
            return "a finite number"
        enough = value > self.low if self.above else value >= self.low
        if enough and value <= self.high:
            return ""
        if self.high in (MOST, math.inf):
            if enough:
                return f"at most {MOST:,}"
            return f"above {self.low:g}" if self.above else f"{self.low:g} or more"
        if self.above:
            return f"above {self.low:g}, at most {self.high:g}"
        return f"from {self.low:g} to {self.high:g}{self.unit}"


def parameter(
    default: float,
    low: float = 0,
    high: float | None = None,
    *,
    above: bool = False,
    unit: str = "",
    help: str = "",  # noqa: A002 - as the option has it
    option: str = "",
    views: bool = False,
) -> Any:  # noqa: ANN401 - as `dataclasses.field` has it
    """Make a dataclass field with a range, by default up to `MOST` if whole; see `Parameter`."""
    if high is None:
        high = MOST if isinstance(default, int) else math.inf
    known = Parameter(low, high, above, unit, help, option, views, isinstance(default, int))
    return field(default=default, metadata={"parameter": known})


def known_parameters(kind: Any) -> dict[str, Parameter]:  # noqa: ANN401 - any dataclass
    """Return the `Parameter` of each field that has one, by name, of a dataclass or an instance."""
    found = {each.name: each.metadata.get("parameter") for each in fields(kind)}
    return {name: known for name, known in found.items() if known}


def check_ranges(chosen: Any) -> None:  # noqa: ANN401 - any dataclass
    """Refuse values out of range, and convert NumPy numbers to Python's, which JSON needs.

    Fields whose default is True or False must be boolean.

    Args:
        chosen: A new instance of a dataclass whose fields are made by `parameter`.

    Raises:
        RangeError: A value is out of range; the message has its name, the range, and the value.
        OptionError: A value that must be boolean is not.
    """
    for name, known in known_parameters(chosen).items():
        value = getattr(chosen, name)
        if expected := known.expected(value):
            wrong = f"must be {expected}, not {value_text(value)}"
            raise RangeError(name, known.option or name, wrong)
        if type(value) not in (int, float):
            object.__setattr__(chosen, name, int(value) if known.whole else float(value))
    for each in fields(chosen):
        if isinstance(each.default, bool):
            object.__setattr__(chosen, each.name, as_switch(each.name, getattr(chosen, each.name)))


def as_switch(name: str, value: object) -> bool:
    """Convert a boolean of Python or NumPy, or 1 or 0, to bool; text, such as "no", is refused.

    Args:
        name: Name of the value, for the message.
        value: The value.

    Raises:
        OptionError: It is none of these.
    """
    if not isinstance(value, Hashable) or value not in (True, False):
        raise OptionError(f"{name} must be True or False, not {value_text(value)}.")
    return bool(value)


def one_or_several(given: Any) -> list[Any]:  # noqa: ANN401 - whatever a caller gives
    """Return an argument that may be one value or several as a list; a text or a path is one."""
    one = isinstance(given, str | bytes | PathLike) or not isinstance(given, Iterable)
    return [given] if one else list(given)


def value_text(value: Any) -> str:  # noqa: ANN401 - whatever a caller gives
    """Format a value for a message; a number too large for a float in few digits."""
    if not is_number(value):
        return repr(value)
    beyond = isinstance(value, Integral) and abs(int(value)) > sys.float_info.max
    return f"{Decimal(int(value)):.6g}" if beyond else str(value).removesuffix(".0")


def is_number(value: object, *, whole: bool = False) -> bool:
    """Return whether a value is a real (or whole) number of Python or NumPy, and not a bool."""
    return not isinstance(value, bool) and isinstance(value, Integral if whole else Real)
