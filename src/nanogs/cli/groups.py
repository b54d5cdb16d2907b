"""Groups of options: one parameter of a command for a dataclass whose fields are options.

Typer reads a function's signature, so it is given a wrapper whose signature lists the options of
all groups one by one.
"""

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from inspect import Parameter, Signature, signature
from typing import Any, get_type_hints

Fields = dict[str, tuple[Any, Any]]
"""Options by name: the annotated type that Typer reads, and the default."""


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Wrap a command so that its groups of options appear as single options.

    Args:
        command: Each parameter is an option or argument; a group, which is a dataclass of these; or
            a dictionary of them, as `Annotated[dict[str, Any], fields]`, which receives those that
            are not None.

    Returns:
        A wrapper for Typer, with one parameter for each option.
    """
    taken = _fields_of(command, signature(command).parameters)

    def called(**given: Any) -> None:  # noqa: ANN401 - whatever the options hold
        command(**{name: _gathered(kind, name, given) for name, (kind, _) in taken.items()})

    options = [option for name, field in taken.items() for option in _spread(name, *field)]
    called.__name__, called.__doc__ = command.__name__, command.__doc__
    called.__annotations__ = {option.name: option.annotation for option in options}
    called.__signature__ = Signature(options)  # type: ignore[attr-defined]
    return called


def _fields_of(owner: Any, parameters: Any) -> Fields:  # noqa: ANN401 - a function or class
    hints = get_type_hints(owner, include_extras=True)
    return {name: (hints[name], parameters[name].default) for name in parameters}


def _inside(kind: Any) -> Fields | None:  # noqa: ANN401 - any type
    """Return the options of a group; None if `kind` is an option or argument."""
    if is_dataclass(kind):
        return _fields_of(kind, {field.name: field for field in fields(kind)})
    known = getattr(kind, "__metadata__", (None,))[0]
    return known if isinstance(known, dict) else None


def _spread(name: str, kind: Any, default: Any) -> list[Parameter]:  # noqa: ANN401
    inside = _inside(kind)
    if inside is None:
        return [Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=kind)]
    return [option for inner, field in inside.items() for option in _spread(inner, *field)]


def _gathered(kind: Any, name: str, given: dict[str, Any]) -> Any:  # noqa: ANN401
    """Build the argument for a parameter of the command: a given value, or a group of them."""
    inside = _inside(kind)
    if inside is None:
        return given[name]
    values = {inner: _gathered(each, inner, given) for inner, (each, _) in inside.items()}
    if is_dataclass(kind):
        return kind(**values)  # type: ignore[operator]
    return {inner: value for inner, value in values.items() if value is not None}
