"""Scores of opened models, and of packed files of them, on views or against photographs."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import NamedTuple

from nanogs.io.frames import other_frames
from nanogs.progress import Stage, Tracker, each
from nanogs.protocol import BLACK, PIXELS, VIEWS, Background
from nanogs.raster.camera import Camera
from nanogs.scoring.comparison import (
    Comparison,
    NamedModel,
    Scoring,
    Sheet,
    compare_with_photographs,
)
from nanogs.scoring.needed import budget_for_comparison
from nanogs.scoring.on_sets import compare_on_sets
from nanogs.scoring.packed_models import (
    files_of,
    named,
    packing_notes,
    reading_notes,
    write_packed_files,
)
from nanogs.scoring.packing import PackingFormats
from nanogs.scoring.photo_views import PhotoViews
from nanogs.scoring.photos import held_bytes, photographs, photographs_remedy
from nanogs.scoring.scores import check_metrics
from nanogs.scoring.view_sets import ComparedViews, Photographs
from nanogs.source import Source
from nanogs.splats import Splats


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Measurement:
    """How models are scored.

    Attributes:
        views: Views of the original, or photographs that the original is scored against too.
        background: RGB in [0, 1]; None for black, or for that of the photographs' data set.
        extras: Further metrics, names in `scoring.scores.EXTRA_METRICS`.
        packing: Formats in which each model but the original is also written and scored.
        max_memory: Bytes that this process may take; by default the free memory, less a tenth.
        pictures: Also make the pictures for a page.
        shown: Also hold all models in memory, for a page that shows them.
    """

    views: ComparedViews | Photographs
    background: Background | None
    extras: Sequence[str]
    packing: PackingFormats
    max_memory: int | None
    pictures: bool = False
    shown: bool = False

    def scoring(self, budget: int | None) -> Scoring:
        """Return what is measured of each model, draw costs included; see `Scoring`."""
        return Scoring(extras=self.extras, pictures=self.pictures, costs=True, budget=budget)


class ScoredModels(NamedTuple):
    """Scores of models.

    Attributes:
        comparison: The scores.
        sheets: Pictures for a page, if requested.
        models: The models, the original first, each followed by its packed files.
        cameras: The views of the first set.
        background: RGB in [0, 1] behind the splats.
    """

    comparison: Comparison
    sheets: list[Sheet]
    models: list[NamedModel]
    cameras: Sequence[Camera]
    background: Background


def measure(
    models: Sequence[tuple[str, Splats | Source]],
    how: Measurement,
    stack: ExitStack,
    progress: Tracker,
) -> ScoredModels:
    """Score models against the first, or all against photographs.

    Args:
        models: Names and models; files stay open as long as `stack`.
        how: See `Measurement`.
        stack: Owns the packed files, which are removed when it closes.
        progress: Receives the stages of `measuring_stages`.

    Raises:
        NanogsError: As for `nanogs.compare`.
    """
    check_metrics(how.extras)
    asked = how.views
    views = photographs(*asked, how.background) if isinstance(asked, Photographs) else asked
    budget = _budget([source for _name, source in models], views, how)
    entries = [(name, source, "") for name, source in models]
    if how.packing:
        entries[1:] = write_packed_files(models[1:], how.packing, stack, how.max_memory, progress)
        budget = _budget([source for _name, source, _suffix in entries], views, how)
    progress.begin("read")
    ready = [named(*entry, whole=budget is None) for entry in each(entries, progress.part)]
    if isinstance(views, PhotoViews):
        found = _on_photographs(ready, views, how, budget, progress)
    else:
        found = _on_views(ready, views, how, budget, progress)
    notes = reading_notes(models, [model for model in ready if not model.packed_as])
    notes += (*other_frames(models), *packing_notes(models[1:], how.packing))
    notes += found.comparison.notes
    return found._replace(comparison=replace(found.comparison, notes=notes))


def _on_views(
    models: list[NamedModel],
    views: ComparedViews,
    how: Measurement,
    budget: int | None,
    progress: Tracker,
) -> ScoredModels:
    sets, behind = views.sets(models[0].splats), how.background or BLACK
    comparison, sheets = compare_on_sets(
        models[0], models[1:], sets,
        background=behind, scoring=how.scoring(budget), progress=progress,
    )  # fmt: skip
    return ScoredModels(comparison, sheets, models, sets[0].cameras, behind)


def _on_photographs(
    models: list[NamedModel],
    photos: PhotoViews,
    how: Measurement,
    budget: int | None,
    progress: Tracker,
) -> ScoredModels:
    asked = how.views
    assert isinstance(asked, Photographs)  # noqa: S101 - these are what was asked for
    progress.begin("photographs")
    comparison, sheets = compare_with_photographs(
        str(asked.folder), models, list(photos), split=asked.split,
        background=photos.background, scoring=how.scoring(budget), progress=progress,
    )  # fmt: skip
    comparison = replace(comparison, notes=(*comparison.notes, *photos.notes))
    return ScoredModels(comparison, sheets, models, photos.cameras, photos.background)


def _budget(
    sources: Sequence[Splats | Source], views: ComparedViews | PhotoViews, how: Measurement
) -> int | None:
    """Return the bytes left for splats while rendering, or None if all models are held."""
    kept = 2 if how.packing else 1  # the renders of unpacked models are kept too
    if isinstance(views, PhotoViews):
        largest = max(camera.width * camera.height for camera in views.cameras)
        return budget_for_comparison(
            sources, largest, 1, how.max_memory, photographs=kept * held_bytes(views),
            remedy=photographs_remedy(views), shown=how.shown,
        )  # fmt: skip
    pixels, count = views.pictures
    return budget_for_comparison(
        sources, pixels, kept * count, how.max_memory, remedy=views.remedy, shown=how.shown
    )


def measuring_stages(models: Sequence[Splats | Source], how: Measurement) -> list[Stage]:
    """Return the stages of `measure`, with their efforts."""
    files = files_of(models[1:], how.packing)
    scored = len(models) + files
    stages = [Stage("pack", 8.0 * files)] if files else []
    stages += [Stage("read", 2.0 * scored)]
    if isinstance(how.views, Photographs):
        return [*stages, Stage("photographs", 8), Stage("score", 8.0 * scored)]
    for views in how.views.counts:
        for pixels in how.views.pixels:
            effort = (views or VIEWS) * max(1.0, pixels / PIXELS**2)
            stages += [Stage("render", effort), Stage("score", scored * effort)]
    return stages
