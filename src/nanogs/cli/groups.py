"""Options that belong together, as one parameter of a command: a dataclass whose fields are they.

Typer asks a function what it takes, so what it is shown has the options in place of their groups.
"""

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from inspect import Parameter, Signature, signature
from typing import Any, get_type_hints

Fields = dict[str, tuple[Any, Any]]
"""Options by name, each with its type, which Typer reads, and its default."""


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """A command that takes the options of its groups.

    Args:
        command: A parameter of it is an option or argument; a group, which is a dataclass of
            these; or a dictionary of them, as `Annotated[dict[str, Any], fields]`: it gets those
            that are not None.

    Returns:
        The same command for Typer to read and call, with a parameter for each option.
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
    """The options of a group; None for an option or argument."""
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
    """The argument for a parameter of the command: as given, or made of the options it gathers."""
    inside = _inside(kind)
    if inside is None:
        return given[name]
    values = {inner: _gathered(each, inner, given) for inner, (each, _) in inside.items()}
    if is_dataclass(kind):
        return kind(**values)  # type: ignore[operator]
    return {inner: value for inner, value in values.items() if value is not None}
