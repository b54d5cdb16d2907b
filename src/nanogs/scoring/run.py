"""A comparison of files: the implementation of `nanogs compare`."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from nanogs.formatting import utf8
from nanogs.io import open as open_model
from nanogs.io.atomic import atomic_write
from nanogs.io.format import FormatOptions
from nanogs.progress import Progress, Stage, Tracker
from nanogs.protocol import PIXELS, Background, Judged
from nanogs.scoring.comparison import Comparison, NamedModel
from nanogs.scoring.measure import (
    Measurement,
    ScoredModels,
    measure,
    measuring_stages,
)
from nanogs.scoring.packing import packing_of
from nanogs.scoring.page import render_page
from nanogs.scoring.view_sets import ComparedViews, Photographs, Size, views_from
from nanogs.source import Source, source_of
from nanogs.splats import Splats
from nanogs.view.bundle import check_built
from nanogs.view.pack import pack
from nanogs.view.page import Shown, facts_of, viewer_part
from nanogs.views.cameras import KINDS
from nanogs.views.opening import Opening, opening_for

if TYPE_CHECKING:
    from nanogs.raster.camera import Camera
    from nanogs.views.automatic import Kind


def compare_files(
    reference: tuple[str, Path],
    tests: Sequence[tuple[str, Path]],
    *,
    cameras: str = "auto",
    views: int | None = None,
    sizes: Sequence[Size] = ((PIXELS, PIXELS),),
    up: Sequence[float] | None = None,
    background: Background | None = None,
    extras: Sequence[str] = (),
    photos: Path | None = None,
    images: str | None = None,
    split: str = "test",
    report: Path | None = None,
    interactive: bool = False,
    packed: Sequence[str] = (),
    format_options: FormatOptions | None = None,
    render_mode: str | None = None,
    max_memory: int | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Comparison:
    """Read and score models, and write the page if one is requested.

    Args:
        reference: Name and file of the original model.
        tests: Names and files of the models to score.
        cameras: See `cameras_for`; or several kinds of automatic ones, separated by commas. Without
            effect if photographs are given.
        views: Number of automatic views of each kind; None for the kind's usual number.
        sizes: Widths and heights of automatic views, pixels.
        up: Up direction of automatic views.
        background: RGB in [0, 1]; by default black, and for photographs the data set's own (see
            `Dataset.background`).
        extras: Further metrics.
        photos: Data-set folder; all models, also the reference, are scored against its photographs.
        images: Folder of the photographs in a COLMAP data set.
        split: Photographs to use, "test" or "train".
        report: Page to write, or None.
        interactive: Embed the models in the page, for an interactive viewer.
        packed: Suffixes of formats: each test is also written in these and scored.
        format_options: Options of these formats, as for `save`; each gets those that it supports.
        render_mode: Render mode of all models, which overrides that of their files; see
            `nanogs.open`.
        max_memory: Bytes that this process may take; by default the free memory, less a tenth.
            Models that do not fit are read some rows at a time, with the same numbers.
        overwrite: Replace the page if it exists.
        progress: Called with each `nanogs.progress.Step`.

    Raises:
        NanogsError: A file or an option is not usable, or there is too little memory.
    """
    if report and interactive:
        check_built()
    seen: ComparedViews | Photographs
    if photos is None:
        seen = views_from([cameras], sizes, views, up)
    else:
        seen = Photographs(photos, images, split)
    how = Measurement(
        views=seen,
        background=background,
        extras=extras,
        packing=packing_of(packed, format_options) if packed else {},
        max_memory=max_memory,
        pictures=report is not None,
        shown=report is not None and interactive,
    )
    with ExitStack() as stack:
        given = [
            (name, stack.enter_context(open_model(path, render_mode=render_mode)))
            for name, path in (reference, *tests)
        ]
        tracker = Tracker(progress, _stages([source for _name, source in given], how))
        found = measure(given, how, stack, tracker)
    comparison, viewer = found.comparison, None
    if how.shown:
        tracker.begin("encode")
        viewer, notes = _viewer(found, _first_view(seen, found), up)
        comparison = replace(comparison, notes=(*comparison.notes, *notes))
    if report:
        tracker.begin("write")
        text = render_page(comparison, found.sheets, f"{reference[0]}: comparison", viewer)
        with atomic_write(report, overwrite=overwrite) as file:
            file.write(utf8(text))
    tracker.finish()
    return comparison


def _stages(sources: Sequence[Source], how: Measurement) -> list[Stage]:
    """List the stages: those of measuring, then those of the page if there is one."""
    stages = measuring_stages(sources, how)
    if how.shown:
        stages += [Stage("encode", 3.0 * len(sources))]
    if how.pictures:
        stages += [Stage("write", 1.0)]
    return stages


def _first_view(seen: ComparedViews | Photographs, found: ScoredModels) -> "Kind | Camera":
    """Return the view that the page's viewer opens with: of the first kind, or the first camera."""
    if isinstance(seen, ComparedViews) and seen.kinds:
        return KINDS.get(seen.kinds[0], "auto")
    return found.cameras[0]


def _viewer(
    found: ScoredModels, start: "Kind | Camera", up: Sequence[float] | None
) -> tuple[str, list[str]]:
    """Return the page's interactive part, and notes on how it shows the models.

    It holds the given models but not their packed files.
    """
    models = [model for model in found.models if not model.packed_as]
    held = [source_of(model.splats).load() for model in models]
    opening = opening_for(held[0], start, up)
    shown = _shown(models, held, found.comparison, opening)
    notes = [f"{model.name}, in 3D: {note}" for model in shown for note in model.packed.notes]
    return viewer_part(shown, opening, found.background), notes


def _shown(
    models: Sequence[NamedModel],
    held: Sequence[Splats],
    comparison: Comparison,
    start: Opening,
) -> list[Shown]:
    """Return the models for the page's viewer, with their scores."""
    judged: list[Judged | None] = [
        comparison.judged(place)
        for place, model in enumerate(comparison.models)
        if model.packed is None
    ]
    if len(judged) < len(models):  # the original is the reference and has no score
        judged = [None, *judged]
    return [
        Shown(
            model.name,
            facts_of(
                len(splats),
                model.file_bytes,
                reference=None if place == 0 else len(held[0]),
                judged=score,
            ),
            pack(splats, start),
        )
        for place, (model, splats, score) in enumerate(zip(models, held, judged, strict=True))
    ]
