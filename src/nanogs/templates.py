"""The templates of pages, for Jinja."""

from collections.abc import Callable
from importlib.resources import files
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jinja2 import Template


def template(package: str, name: str, **filters: Callable[..., str]) -> "Template":
    """Return a template, in which every value that is not `Markup` is escaped.

    Args:
        package: The package that has its file.
        name: Name of the file.
        **filters: Functions that it applies to values.
    """
    from jinja2 import Environment  # no command needs it to start

    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters.update(filters)
    text = files(package).joinpath(name).read_text(encoding="utf-8")
    return environment.from_string(text)
