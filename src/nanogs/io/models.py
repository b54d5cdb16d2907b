"""A model that is given as such, or as the name of its file."""

from os import PathLike
from typing import TypeAlias

from nanogs.errors import ModelError
from nanogs.splats import Splats

Model: TypeAlias = Splats | str | PathLike[str]
"""Models as functions take them: `Splats`, or a path that `load` reads."""


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
        from nanogs.io import load  # `--help` does without

        return load(model)
    raise ModelError(f"{name} must be Splats or a path, not {type(model).__name__}.")
