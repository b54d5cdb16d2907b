"""A comparison of files: the implementation of `nanogs compare`."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from nanogs.formatting import utf8
from nanogs.io import open as open_model
from nanogs.io.atomic import atomic_write
from nanogs.io.format import FormatOptions
from nanogs.io.parts import FileSource
from nanogs.memory import allowed_memory, refuse_too_large
from nanogs.memory_estimates import compare_bytes
from nanogs.progress import Progress, Stage, Tracker, each
from nanogs.protocol import BLACK, PIXELS, VIEWS, Background, Judged
from nanogs.scoring.comparison import (
    Comparison,
    NamedModel,
    Sheet,
    compare_with_photographs,
)
from nanogs.scoring.needed import REMEDY, room_for_comparison
from nanogs.scoring.on_sets import compare_on_sets
from nanogs.scoring.packed_models import (
    files_of,
    named,
    packing_notes,
    remarks_on,
    write_packed_files,
)
from nanogs.scoring.packing import packing_of
from nanogs.scoring.page import render_page
from nanogs.scoring.photos import photographs, room_beside_photographs
from nanogs.scoring.scores import ReferenceView
from nanogs.scoring.view_sets import Size, ViewSet, found_views, parse_sources, view_sets
from nanogs.source import source_of
from nanogs.splats import Splats
from nanogs.view.bundle import check_built
from nanogs.view.pack import pack
from nanogs.view.page import Shown, facts_of, viewer_part
from nanogs.views.cameras import AUTOMATIC, FOUND
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
    page = interactive if report else None
    packing = packing_of(packed, format_options) if packed else {}
    kinds = [] if photos else parse_sources(cameras)
    counts = found_views(kinds, views)
    with ExitStack() as stack:
        given = [
            (name, stack.enter_context(open_model(path, render_mode=render_mode)))
            for name, path in (reference, *tests)
        ]
        sources = [source for _name, source in given]
        looking = _most_pixels(sizes), max(counts, default=0) * (2 if packing else 1), page
        room = _room(sources, *looking, max_memory)
        files = files_of(sources[1:], packing)
        tracker = Tracker(progress, _stages(len(given), files, counts, sizes, page))
        opened = [(name, source, "") for name, source in given]
        if packing:
            opened[1:] = write_packed_files(given[1:], packing, stack, max_memory, tracker)
            room = _room([source for _name, source, _suffix in opened], *looking, max_memory)
        tracker.begin("read")
        models = []
        for name, source, suffix in each(opened, tracker.part):
            models.append(named(name, source, suffix, room is None))
        scoring = _Scoring(extras, bool(report), room, tracker)
        if photos is None:
            sets = view_sets(models[0].splats, kinds, sizes, views=views, up=up)
            found = scoring.on_views(models, sets, kinds[0], background or BLACK)
        else:
            tracker.begin("photographs")
            behind, frames = photographs(photos, images, split, background, max_memory)
            found = scoring.on_photographs(
                models, str(photos), frames, split, behind, packed=bool(packing)
            )
        notes = (*remarks_on(given), *packing_notes(given[1:], packing), *found.comparison.notes)
        found = found._replace(comparison=replace(found.comparison, notes=notes))
    if report:
        viewer = None
        if interactive:
            tracker.begin("encode")
            viewer = _viewer(models, found, up)
        tracker.begin("write")
        text = render_page(found.comparison, found.sheets, f"{reference[0]}: comparison", viewer)
        with atomic_write(report, overwrite=overwrite) as file:
            file.write(utf8(text))
    tracker.finish()
    return found.comparison


class _Found(NamedTuple):
    """A comparison with its sheets, and the first view and background of the page's viewer."""

    comparison: Comparison
    sheets: list[Sheet]
    start: "Kind | Camera"
    behind: Background


class _Scoring(NamedTuple):
    """Settings of scoring that do not depend on the views; see `compare_models`."""

    extras: Sequence[str]
    pictures: bool
    room: int | None
    progress: Tracker

    def on_views(
        self, models: Sequence[NamedModel], sets: Sequence[ViewSet], kind: str, behind: Background
    ) -> _Found:
        """Score models against the first of them; `kind` is the kind of the first set of views."""
        start = AUTOMATIC.get(kind, "auto") if kind in FOUND else sets[0].cameras[0]
        found = compare_on_sets(
            models[0], models[1:], sets, background=behind, extras=self.extras,
            pictures=self.pictures, room=self.room, progress=self.progress,
        )  # fmt: skip
        return _Found(*found, start, behind)

    def on_photographs(
        self,
        models: Sequence[NamedModel],
        source: str,
        frames: Sequence[ReferenceView],
        split: str,
        behind: Background,
        *,
        packed: bool,
    ) -> _Found:
        """Score models against photographs; `packed` as for `room_beside_photographs`."""
        room = room_beside_photographs(self.room, frames, packed=packed)
        found = compare_with_photographs(
            source, models, frames, split=split, background=behind, extras=self.extras,
            pictures=self.pictures, room=room, progress=self.progress,
        )  # fmt: skip
        return _Found(*found, frames[0].camera, behind)


def _room(
    sources: Sequence[FileSource],
    pixels: int,
    views: int,
    page: bool | None,
    max_memory: int | None,
) -> int | None:
    """Call `room_for_comparison`; a page with embedded models needs all models in memory (None)."""
    if not page:
        paths = [source.path for source in sources]
        return room_for_comparison(paths, sources, pixels, views, max_memory)
    needed = compare_bytes([source.info for source in sources], pixels, views)
    remedy = f"{REMEDY}, or leave the models out of the page (`interactive=False`)"
    refuse_too_large("Comparing these models", needed, allowed_memory(max_memory), remedy)
    return None


def _most_pixels(sizes: Sequence[Size]) -> int:
    return max((width * height for width, height in sizes), default=0)


def _stages(
    given: int, files: int, counts: Sequence[int], sizes: Sequence[Size], page: bool | None
) -> list[Stage]:
    """Return the stages of a comparison with their efforts.

    Args:
        given: Number of models, with the original.
        files: Number of packed files.
        counts: Number of views of each kind; empty for photographs.
        sizes: Sizes of the views.
        page: Whether the page has an interactive part; None without a page.
    """
    models = given + files
    stages = [Stage("pack", 8.0 * files)] if files else []
    stages += [Stage("read", 2.0 * models)]
    if not counts:
        stages += [Stage("photographs", 8), Stage("score", 8.0 * models)]
    for views in counts:
        for width, height in sizes:
            effort = (views or VIEWS) * max(1.0, width * height / PIXELS**2)
            stages += [Stage("render", effort), Stage("score", models * effort)]
    stages += [Stage("encode", 3.0 * given)] if page else []
    return stages + ([] if page is None else [Stage("write", 1.0)])


def _viewer(models: Sequence[NamedModel], found: _Found, up: Sequence[float] | None) -> str:
    """Return the page's interactive part, with the given models but not their packed files."""
    models = [model for model in models if not model.packed_as]
    held = [source_of(model.splats).load() for model in models]
    opening = opening_for(held[0], found.start, up)
    return viewer_part(_shown(models, held, found.comparison, opening), opening, found.behind)


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
