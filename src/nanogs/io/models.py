"""Accepting a model as `Splats`, as a `Source`, or as a path."""

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from typing import TypeAlias

from nanogs.errors import ModelError
from nanogs.source import Source
from nanogs.splats import Splats, how_to_make

Model: TypeAlias = Splats | Source | str | PathLike[str]
"""A model as a function argument: `Splats`, a `Source`, or a path that `load` reads."""


@contextmanager
def opened(model: Model, name: str = "the model") -> Iterator[Splats | Source]:
    """Yield `Splats` or a source unchanged, or open a path as a source, closed after the block.

    Args:
        model: The model, a source of it, or a path.
        name: Name of the argument, for the message.

    Raises:
        FormatError: The file cannot be read; see `open`.
        ModelError: It is none of these.
    """
    if isinstance(model, str | PathLike):
        from nanogs.io import open as open_model  # slow to import, and not needed by `--help`

        with open_model(model) as source:
            yield source
    else:
        yield model if isinstance(model, Source) else as_splats(model, name)


def as_splats(model: Model, name: str = "the model") -> Splats:
    """Return the model in memory: `Splats` unchanged, a source or a path loaded.

    Args:
        model: The model, a source of it, or a path.
        name: Name of the argument, for the message.

    Raises:
        FormatError: The file cannot be read; see `load`.
        ModelError: It is none of these.
    """
    if isinstance(model, Splats):
        return model
    if isinstance(model, Source):
        return model.load()
    if isinstance(model, str | PathLike):
        from nanogs.io import load  # slow to import, and not needed by `--help`

        return load(model)
    raise ModelError(
        f"{name[0].upper()}{name[1:]} must be Splats, a Source or a path, not"
        f" {type(model).__name__}; {how_to_make(model)}."
    )
