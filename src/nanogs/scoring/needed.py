"""How much memory a comparison takes, before anything is read. No Numba here."""

from collections.abc import Sequence
from os import PathLike

from nanogs.io import inspect
from nanogs.io.models import Model
from nanogs.memory import allowed_memory
from nanogs.needs import models_bytes, pictures_bytes, scoring_bytes
from nanogs.source import Source, source_of
from nanogs.splats import Splats
from nanogs.views.plan import room_for_splats

LESS = "free some, or compare fewer or smaller views (`views`, `pixels`) or smaller models"


def room_for_comparison(
    models: Sequence[Model],
    sources: Sequence[Splats | Source],
    pixels: int,
    views: int,
    max_memory: int | None,
) -> int | None:
    """Bytes for the splats of pictures, where models do not fit and are read some rows at a time.

    Args:
        models: Models, or paths.
        sources: The same, as they are read.
        pixels: Of the largest view.
        views: Their number.
        max_memory: Bytes that this process may take; by default what is free, less a tenth.

    Returns:
        None where all fit.

    Raises:
        FormatError: A path is no model.
        NotEnoughMemoryError: There is too little memory either way.
    """
    given, memory = bool(max_memory), allowed_memory(max_memory)
    if needed_bytes(models, pixels, views, all_of_it=given) <= memory.bytes:
        return None
    held = models_bytes([model for model in models if isinstance(model, Splats)], all_of_it=given)
    others = held + pictures_bytes(pixels, views)
    read = [source_of(source) for source in sources]
    return room_for_splats("Comparing these models", read, others, memory, LESS)


def needed_bytes(models: Sequence[Model], pixels: int, views: int, *, all_of_it: bool) -> int:
    """Bytes that reading models whole and scoring them against the first takes.

    Args:
        models: Models, or paths.
        pixels: Of the largest view.
        views: Their number.
        all_of_it: Count the models too that are held already.

    Raises:
        FormatError: A path is no model.
    """
    counts = [
        inspect(model).splats if isinstance(model, str | PathLike) else len(model)
        for model in models
        if isinstance(model, str | PathLike | Source | Splats)
    ]
    read = models_bytes(models, all_of_it=all_of_it)
    return read + scoring_bytes(counts, pixels, views) if counts else 0
