"""How much memory a comparison takes, before anything is read. No Numba here."""

from collections.abc import Sequence
from os import PathLike

from nanogs.io import inspect
from nanogs.io.files import splat_bytes
from nanogs.io.models import Model
from nanogs.needs import model_bytes, scoring_bytes
from nanogs.source import Source
from nanogs.splats import Splats

LESS = "free some, or compare fewer or smaller views (`views`, `pixels`) or smaller models"


def needed_bytes(models: Sequence[Model], pixels: int, views: int, *, all_of_it: bool) -> int:
    """Bytes that reading models and scoring them against the first takes.

    Args:
        models: Models, or paths.
        pixels: Of the largest view.
        views: Their number.
        all_of_it: Count the models too that are held already.

    Raises:
        FormatError: A path is no model.
    """
    counts, read = [], 0
    for model in models:
        if isinstance(model, str | PathLike):
            info = inspect(model)
            counts.append(info.splats)
            read += model_bytes(info)
        elif isinstance(model, Source):
            counts.append(model.count)
            read += model.count * splat_bytes(model.columns.sh_degree)
        elif isinstance(model, Splats):
            counts.append(len(model))
            read += len(model) * splat_bytes(model.sh_degree) if all_of_it else 0
    return read + scoring_bytes(counts, pixels, views) if counts else 0
