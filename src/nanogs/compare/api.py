"""`nanogs.compare`: how much models look like their original."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from nanogs.bar import drawn
from nanogs.compare.protocol import BLACK, PIXELS, VIEWS, Background
from nanogs.errors import OptionError
from nanogs.io import inspect
from nanogs.io.models import Model, as_splats
from nanogs.progress import Progress, Stage, Tracker
from nanogs.render.api import Cameras, chosen_cameras

if TYPE_CHECKING:
    from nanogs.compare.comparison import Comparison, NamedModel


def compare(
    original: Model,
    *models: Model,
    names: Sequence[str] | None = None,
    cameras: Cameras = "auto",
    views: int = VIEWS,
    pixels: int | tuple[int, int] = PIXELS,
    up: Sequence[float] | None = None,
    background: Background = BLACK,
    metrics: Sequence[str] = (),
    threads: int | None = None,
    progress: Progress | bool | None = None,
) -> "Comparison":
    """Score models against their original, on views that no method learns from.

    The numbers are those of the command `nanogs compare`.

    Args:
        original: What the others should look like: a model, or a path.
        *models: At least one to score: models, or paths.
        names: Of the models, in their order; by default their files' names, or "model 1" and so
            on.
        cameras: As `render` takes them; automatic views are found from the original.
        views: Number of automatic views.
        pixels: Of an automatic view: width and height in one number, or both.
        up: (3,) direction of automatic views, scene units; found from the original by default.
        background: RGB in [0, 1] behind the splats.
        metrics: Further ones: "flip", "lpips"; each needs its extra.
        threads: Threads to use; all by default. The result does not depend on it.
        progress: True for a bar, in a notebook or on a terminal, or a function that is called with
            each `nanogs.progress.Step`.

    Returns:
        Scores of each model, their means in `models`, and how they were measured in `protocol`.

    Raises:
        FormatError: A model or the cameras cannot be read.
        ModelError: The original is seen in none of the views.
        OptionError: An argument is out of range, or no model is given.
    """
    called = _names(models, names)
    first = _named(_file_name(original) or "original", original)
    others = [_named(name, model) for name, model in zip(called, models, strict=True)]
    chosen, kind = chosen_cameras(first.splats, cameras, views, pixels, up)
    # Here and not above: these bring Numba.
    from nanogs.compare.comparison import compare_models
    from nanogs.threads import use_threads

    with use_threads(threads), drawn(progress) as tell:
        tracker = Tracker(tell, [Stage("render", 1.0), Stage("score", float(len(others)))])
        comparison, _ = compare_models(
            first, others, chosen, kind=kind, background=background, extras=metrics,
            progress=tracker,
        )  # fmt: skip
        tracker.finish()
    return comparison


def _names(models: Sequence[Model], names: Sequence[str] | None) -> list[str]:
    if not models:
        raise OptionError("Give at least one model to compare with the original.")
    if names is None:
        return [_file_name(model) or f"model {place}" for place, model in enumerate(models, 1)]
    if isinstance(names, str) or len(names) != len(models):
        raise OptionError(f"Give one name for each model, {len(models)} in all, not {names!r}.")
    return list(names)


def _file_name(model: Model) -> str | None:
    return Path(model).name if isinstance(model, str | PathLike) else None


def _named(name: str, model: Model) -> "NamedModel":
    from nanogs.compare.comparison import NamedModel

    splats = as_splats(model, name)
    file_bytes = inspect(model).file_bytes if isinstance(model, str | PathLike) else None
    return NamedModel(name, splats, file_bytes)
