"""Parameters as fields of dataclasses: their default, range, and what the command says of them."""

import math
from collections.abc import Hashable
from dataclasses import dataclass, field, fields
from numbers import Integral, Real
from typing import Any

from nanogs.errors import OptionError


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter's range, unit and help: what its field holds beside name, type and default.

    Attributes:
        low: The least value.
        high: The largest; infinity itself is refused in any case.
        above: Whether `low` itself is refused.
        unit: What follows the range, such as " pixels".
        help: Of the command's option; empty where it has none.
        option: The option's name, where it is not the parameter's.
        views: Whether it is about views.
        whole: Whether it is a whole number, as its default is.
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
        """The words that follow "must be" where a value is refused; empty where it is not."""
        if not is_number(value, whole=self.whole):
            return "a whole number" if self.whole else "a number"
        if not math.isfinite(value):
            return "a finite number"
        enough = value > self.low if self.above else value >= self.low
        if enough and value <= self.high:
            return ""
        if math.isinf(self.high):
            return f"above {self.low:g}" if self.above else f"{self.low:g} or more"
        if self.above:
            return f"above {self.low:g}, at most {self.high:g}"
        return f"from {self.low:g} to {self.high:g}{self.unit}"


def parameter(
    default: float,
    low: float = 0,
    high: float = math.inf,
    *,
    above: bool = False,
    unit: str = "",
    help: str = "",  # noqa: A002 - as the option has it
    option: str = "",
    views: bool = False,
) -> Any:  # noqa: ANN401 - as `dataclasses.field` has it
    """A field of a dataclass with a range; see `Parameter`."""
    known = Parameter(low, high, above, unit, help, option, views, isinstance(default, int))
    return field(default=default, metadata={"parameter": known})


def known_parameters(kind: Any) -> dict[str, Parameter]:  # noqa: ANN401 - any dataclass
    """The `Parameter` of each field that has one, by name; of a dataclass or an instance."""
    found = {each.name: each.metadata.get("parameter") for each in fields(kind)}
    return {name: known for name, known in found.items() if known}


def check_ranges(chosen: Any) -> None:  # noqa: ANN401 - any dataclass
    """Refuse values out of their range, and take those of NumPy for Python's: JSON has no others.

    Fields that are True or False by default are switches.

    Args:
        chosen: Parameters, whose fields are made by `parameter`; a new instance.

    Raises:
        OptionError: One is; the sentence says its name, what is expected, and the value.
    """
    for name, known in known_parameters(chosen).items():
        value = getattr(chosen, name)
        if expected := known.expected(value):
            shown = f"{value:g}" if is_number(value) else repr(value)
            raise OptionError(f"{name} must be {expected}, not {shown}.")
        if type(value) not in (int, float):
            object.__setattr__(chosen, name, int(value) if known.whole else float(value))
    for each in fields(chosen):
        if isinstance(each.default, bool):
            object.__setattr__(chosen, each.name, as_switch(each.name, getattr(chosen, each.name)))


def as_switch(name: str, value: object) -> bool:
    """True or False, of Python, NumPy or as 1 and 0; any text would count as true, "no" as well.

    Args:
        name: What it is called, for the message.
        value: The value.

    Raises:
        OptionError: It is neither.
    """
    if not isinstance(value, Hashable) or value not in (True, False):
        raise OptionError(f"{name} must be True or False, not {value_text(value)}.")
    return bool(value)


def value_text(value: Any) -> str:  # noqa: ANN401 - whatever a caller gives
    """A value for a message: a number in few digits, all else as Python shows it."""
    return f"{value:g}" if is_number(value) else repr(value)


def is_number(value: object, *, whole: bool = False) -> bool:
    """Whether it is a number, or a whole one, of Python or NumPy; True and False are none."""
    return not isinstance(value, bool) and isinstance(value, Integral if whole else Real)
