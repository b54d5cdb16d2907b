"""Memory that a comparison needs, computed before anything is read. Numba is not imported."""

from collections.abc import Sequence
from os import PathLike

from nanogs.io import inspect
from nanogs.io.models import Model
from nanogs.memory import allowed_memory
from nanogs.memory_estimates import models_bytes, pictures_bytes, scoring_bytes
from nanogs.source import Source, source_of
from nanogs.splats import Splats
from nanogs.views.plan import room_for_splats

REMEDY = "free some, or compare fewer or smaller views (`views`, `pixels`) or smaller models"


def room_for_comparison(
    models: Sequence[Model],
    sources: Sequence[Splats | Source],
    pixels: int,
    views: int,
    max_memory: int | None,
) -> int | None:
    """Compute the bytes left for splats while rendering, if models must be read in parts.

    Args:
        models: Models, or paths.
        sources: The same models, opened.
        pixels: Pixels of the largest view.
        views: Number of views.
        max_memory: Bytes that this process may take; by default the free memory, less a tenth.

    Returns:
        The bytes, or None if all models fit in memory.

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
    return room_for_splats("Comparing these models", read, others, memory, REMEDY)


def needed_bytes(models: Sequence[Model], pixels: int, views: int, *, all_of_it: bool) -> int:
    """Compute the bytes needed to load models and score them against the first.

    Args:
        models: Models, or paths.
        pixels: Pixels of the largest view.
        views: Number of views.
        all_of_it: Also count models that are in memory already.

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
