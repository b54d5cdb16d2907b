"""A model that is given as such, as a source, or as the name of its file."""

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from typing import TypeAlias

from nanogs.errors import ModelError
from nanogs.source import Source
from nanogs.splats import Splats

Model: TypeAlias = Splats | Source | str | PathLike[str]
"""Models as functions take them: `Splats`, a `Source`, or a path that `load` reads."""


@contextmanager
def opened(model: Model, name: str = "the model") -> Iterator[Splats | Source]:
    """The model or the source itself, or the source of a file, which is closed at the end.

    Args:
        model: The model, a source of it, or a path.
        name: What it is called, for the message.

    Raises:
        FormatError: The file cannot be read; see `open`.
        ModelError: It is none of these.
    """
    if isinstance(model, str | PathLike):
        from nanogs.io import open as open_model  # `--help` does without

        with open_model(model) as source:
            yield source
    else:
        yield model if isinstance(model, Source) else as_splats(model, name)


def as_splats(model: Model, name: str = "the model") -> Splats:
    """The model itself, or what its source or its file holds.

    Args:
        model: The model, a source of it, or a path.
        name: What it is called, for the message.

    Raises:
        FormatError: The file cannot be read; see `load`.
        ModelError: It is none of these.
    """
    if isinstance(model, Splats):
        return model
    if isinstance(model, Source):
        return model.load()
    if isinstance(model, str | PathLike):
        from nanogs.io import load  # `--help` does without

        return load(model)
    raise ModelError(f"{name} must be Splats, a Source or a path, not {type(model).__name__}.")
