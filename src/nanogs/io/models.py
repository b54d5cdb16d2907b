"""A model that is given as such, or as the name of its file."""

import os
from os import PathLike
from typing import TypeAlias

from nanogs.errors import ModelError
from nanogs.splats import Splats

Model: TypeAlias = Splats | str | PathLike[str]
"""What functions take that begin with a model: `Splats`, or a path that `load` reads."""


def as_splats(model: Model, name: str = "the model") -> Splats:
    """The model itself, or what its file holds.

    Args:
        model: The model, or a path.
        name: What it is called, for the message.

    Raises:
        FormatError: The file cannot be read; see `load`.
        ModelError: It is neither.
    """
    if isinstance(model, Splats):
        return model
    if isinstance(model, str | PathLike):
        from nanogs.io import load  # not above: it refuses what is no model by what is below

        return load(model)
    raise ModelError(f"{name} must be Splats or a path, not {type(model).__name__}.")


def refuse_other(model: object) -> None:
    """Refuse what is no model where no path can stand for one.

    Raises:
        ModelError: It is none.
    """
    if isinstance(model, str | PathLike):
        path = os.fspath(model)
        raise ModelError(f"A model is needed, not the path {path!r}; nanogs.load({path!r}) is one.")
    if not isinstance(model, Splats):
        raise ModelError(f"A model is needed, Splats, not {type(model).__name__}.")
