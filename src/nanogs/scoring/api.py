"""`nanogs.compare`: image quality of models, compared with their original or photographs."""

from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from nanogs.bar import show_progress
from nanogs.errors import OptionError
from nanogs.io.models import Model, opened
from nanogs.io.urls import as_path, short_names
from nanogs.progress import Progress, Tracker
from nanogs.protocol import PIXELS, plain_background
from nanogs.quantities import as_bytes
from nanogs.ranges import one_or_several
from nanogs.scoring.packing import packing_of
from nanogs.scoring.view_sets import (
    Photographs,
    Pixels,
    compared_views,
    refuse_beside_photos,
    refuse_beside_views,
)
from nanogs.views.cameras import Cameras

if TYPE_CHECKING:
    from nanogs.io.format import FormatOptions
    from nanogs.scoring.comparison import Comparison


def compare(
    original: Model,
    *models: Model,
    names: Sequence[str] | None = None,
    cameras: Cameras | Sequence[str] = "auto",
    views: int | None = None,
    pixels: Pixels = PIXELS,
    up: Sequence[float] | None = None,
    background: Iterable[float] | None = None,
    photos: str | PathLike[str] | None = None,
    images: str | None = None,
    split: str = "test",
    metrics: str | Sequence[str] = (),
    packed: str | Sequence[str] = (),
    format_options: "FormatOptions | None" = None,
    device: str | None = None,
    threads: int | None = None,
    max_memory: int | str | None = None,
    progress: Progress | bool | None = None,
) -> "Comparison":
    """Score models on test views against their original, or against photographs.

    No method learns from the test views. The numbers are those of the command `nanogs compare`.

    Args:
        original: The reference: a model, or a path.
        *models: At least one to score: models, or paths.
        names: Names of the models, in order; by default their files' names, with as many folders
            as tell them apart, or "model 1" and so on.
        cameras: As for `render`, or several kinds, as in `["auto", "roam"]`; automatic ones are
            computed from the original.
        views: Number of automatic views of each kind; by default 8, or 24 roaming ones.
        pixels: Size of automatic views: one number for width and height, or both; a list of these
            to measure at several sizes.
        up: (3,) direction of automatic views, scene units; found from the original by default.
        background: RGB in [0, 1] behind the splats; by default black, and for photographs the data
            set's own.
        photos: Folder of a NeRF-Synthetic, nerfstudio or COLMAP data set: all models, also the
            original, are scored against its photographs, rendered from their cameras. Excludes the
            arguments of automatic views.
        images: Folder of the photographs in a COLMAP data set.
        split: Photographs to use, "test" or "train".
        metrics: One or several further metrics: "flip", "lpips"; each needs its extra.
        packed: Suffix of a format, or several, such as [".sog", ".spz"]: each model is also
            written in the format, read back and scored; the loss due to packing alone is `packed`
            of that score.
        format_options: Options of these formats, as for `save`; each format gets those it supports.
        device: Device to render on, as for `render`; the notes name it if it is not the CPU.
        threads: Threads to use; all by default. The result does not depend on it.
        max_memory: Bytes that this process may take, a number or a text such as "4GB"; by default
            the free memory, less a tenth. Models that do not fit are read some rows at a time,
            several times if necessary: the numbers are the same.
        progress: True for a bar, in a notebook or on a terminal, or a function that is called with
            each `nanogs.progress.Step`.

    Returns:
        Scores of each model with their means in `models` (against photographs, the original is the
        first), the conditions of measurement in `protocol`, and in `further` the same for each
        further kind and size of views.

    Raises:
        FormatError: A model, the cameras or the photographs cannot be read.
        ModelError: The original is seen in none of the views.
        NotEnoughMemoryError: It takes more memory than is free or allowed, even row by row.
        OptionError: An argument is out of range, there is no such device, or no model is given.
    """
    called, requested = _names(original, models, names), compared_views(cameras, pixels, views, up)
    background = None if background is None else plain_background(background)
    usual = up is None and requested == compared_views("auto", PIXELS)
    refuse_beside_photos(photos, views=not usual)
    refuse_beside_views(photos, images, split)
    if format_options and not packed:
        raise OptionError("`format_options` work only with `packed`; name the formats with it.")
    packing = packing_of(packed, format_options) if packed else {}
    extras = one_or_several(metrics)
    limit = None if max_memory is None else as_bytes(max_memory)
    with ExitStack() as stack:
        given = [
            (name, stack.enter_context(opened(model, name)))
            for name, model in zip(called, (original, *models), strict=True)
        ]
        # Imported here because these import Numba.
        from nanogs.card.device import device_notes, use_device
        from nanogs.scoring.measure import Measurement, measure, measuring_stages
        from nanogs.threads import use_threads

        seen = requested if photos is None else Photographs(Path(photos), images, split)
        how = Measurement(
            views=seen, background=background, extras=extras, packing=packing, max_memory=limit
        )
        with use_device(device) as used, use_threads(threads), show_progress(progress) as on_step:
            tracker = Tracker(on_step, measuring_stages([source for _, source in given], how))
            comparison = measure(given, how, stack, tracker).comparison
            tracker.finish()
    return replace(comparison, notes=(*comparison.notes, *device_notes(device, used)))


def _names(original: Model, models: Sequence[Model], names: Sequence[str] | None) -> list[str]:
    """Return the names of the original and of the models."""
    if not models:
        raise OptionError("Give at least one model to compare with the original.")
    if names is None:
        return names_of([original, *models])
    return [*names_of([original]), *checked_names(names, len(models), "for each model")]


def checked_names(names: Sequence[str], count: int, whose: str) -> Sequence[str]:
    """Return names that were given, if they are so many texts.

    Args:
        names: The names.
        count: Their number.
        whose: Words for the message, such as "for each model".

    Raises:
        OptionError: They are not.
    """
    several = isinstance(names, Sequence) and not isinstance(names, str)
    if not several or len(names) != count or not all(isinstance(name, str) for name in names):
        raise OptionError(f"Give one name {whose}, {count} in all, not {names!r}.")
    return names


def names_of(models: Sequence[Model]) -> list[str]:
    """Return names for an original and models: those of their files, where they are paths."""
    paths = [as_path(model) for model in models if isinstance(model, str | PathLike)]
    short = iter(short_names(paths))
    return [
        next(short)
        if isinstance(model, str | PathLike)
        else (f"model {number}" if number else "original")
        for number, model in enumerate(models)
    ]
