"""Memory that a comparison needs, computed before anything is read. Numba is not imported."""

from collections.abc import Sequence

from nanogs.io.parts import FileSource
from nanogs.memory import allowed_memory, refuse_too_large
from nanogs.memory_estimates import compare_bytes, models_bytes, pictures_bytes, scoring_bytes
from nanogs.source import Source, source_of
from nanogs.splats import Splats
from nanogs.views.plan import budget_for_splats


def budget_for_comparison(
    models: Sequence[Splats | Source],
    pixels: int,
    views: int,
    max_memory: int | None,
    *,
    remedy: str,
    photographs: int = 0,
    shown: bool = False,
) -> int | None:
    """Compute the bytes left for splats while rendering, if models must be read in parts.

    Args:
        models: The models.
        pixels: Pixels of the largest view.
        views: Number of views.
        max_memory: Bytes that this process may take; by default the free memory, less a tenth.
        remedy: What helps besides more memory, as the end of the message.
        photographs: Bytes of photographs, and of renders kept beside them, that will be held too.
        shown: Whether a page will show the models, opened files, so that all must be in memory.

    Returns:
        The bytes, or None if all models fit in memory.

    Raises:
        NotEnoughMemoryError: There is too little memory either way.
    """
    given, memory = max_memory is not None, allowed_memory(max_memory)
    if shown:
        infos = [model.info for model in models if isinstance(model, FileSource)]
        remedy += ", or leave the models out of the page (`interactive=False`)"
        needed = compare_bytes(infos, pixels, views, photographs)
        refuse_too_large("Comparing these models", needed, memory, remedy)
        return None
    if photographs + needed_bytes(models, pixels, views, all_of_it=given) <= memory.bytes:
        return None
    held = models_bytes([model for model in models if isinstance(model, Splats)], all_of_it=given)
    others = held + photographs + pictures_bytes(pixels, views)
    read = [source_of(model) for model in models]
    return budget_for_splats("Comparing these models", read, others, memory, remedy)


def needed_bytes(
    models: Sequence[Splats | Source], pixels: int, views: int, *, all_of_it: bool
) -> int:
    """Compute the bytes needed to load models and score them against the first.

    Args:
        models: The models.
        pixels: Pixels of the largest view.
        views: Number of views.
        all_of_it: Also count models that are in memory already.
    """
    read = models_bytes(models, all_of_it=all_of_it)
    return read + scoring_bytes([source_of(model).count for model in models], pixels, views)
