"""`nanogs.compare`: image quality of models, compared with their original or photographs."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from nanogs.bar import show_progress
from nanogs.errors import OptionError
from nanogs.io.models import Model, opened
from nanogs.io.urls import place
from nanogs.progress import Progress, Stage, Tracker
from nanogs.protocol import BLACK, PIXELS, Background, plain_background
from nanogs.quantities import as_bytes
from nanogs.ranges import one_or_several
from nanogs.raster.camera import Camera
from nanogs.scoring.needed import room_for_comparison
from nanogs.scoring.packed_models import (
    files_of,
    named,
    packing_notes,
    remarks_on,
    write_packed_files,
)
from nanogs.scoring.packing import packing_of
from nanogs.source import Source
from nanogs.splats import Splats
from nanogs.views.cameras import Cameras, given_cameras, picture_size, view_count

if TYPE_CHECKING:
    from nanogs.io.format import FormatOptions
    from nanogs.scoring.comparison import Comparison
    from nanogs.scoring.view_sets import Size, ViewSet

Pixels: TypeAlias = int | tuple[int, int] | list[int] | list[tuple[int, int]]


def compare(
    original: Model,
    *models: Model,
    names: Sequence[str] | None = None,
    cameras: Cameras | Sequence[str] = "auto",
    views: int | None = None,
    pixels: Pixels = PIXELS,
    up: Sequence[float] | None = None,
    background: Background | None = None,
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
        names: Names of the models, in order; by default their files' names, or "model 1" and so
            on.
        cameras: As for `render`, or several kinds, as in `["auto", "roam"]`; automatic ones are
            computed from the original.
        views: Number of automatic views of each kind; by default 8, or 24 roaming ones.
        pixels: Size of automatic views: one number for width and height, or both; a list of these
            to measure at several sizes.
        up: (3,) direction of automatic views, scene units; found from the original by default.
        background: RGB in [0, 1] behind the splats; by default black, and for photographs the data
            set's own.
        photos: Folder of a NeRF-Synthetic or COLMAP data set: all models, also the original, are
            scored against its photographs, rendered from their cameras. Excludes the arguments of
            automatic views.
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
    called, asked = _names(models, names), compared_views(cameras, pixels)
    views = None if views is None else view_count(views)
    background = None if background is None else plain_background(background)
    chosen = views is not None or up is not None or asked != compared_views("auto", PIXELS)
    if photos is not None and chosen:
        raise OptionError(
            "`photos` cannot be combined with options for views, because photographs have views of"
            " their own; leave these options out."
        )
    if photos is None and (images is not None or split != "test"):
        raise OptionError(
            "`images` and `split` work only with photographs; name their data set with `photos`."
        )
    largest, most = asked.pictures(views) if photos is None else (PIXELS**2, 0)
    packing = packing_of(packed, format_options) if packed else {}
    extras = one_or_several(metrics)
    given, limit = (original, *models), None if max_memory is None else as_bytes(max_memory)
    with ExitStack() as stack:
        names = [file_name(original) or "original", *called]
        sources = [
            stack.enter_context(opened(model, name))
            for name, model in zip(names, given, strict=True)
        ]
        looking = largest, most * (2 if packing else 1), limit
        room = room_for_comparison(given, sources, *looking)
        # Imported here because these import Numba.
        from nanogs.card.device import device_notes, use_device
        from nanogs.scoring.comparison import compare_with_photographs
        from nanogs.scoring.on_sets import compare_on_sets
        from nanogs.scoring.photos import photographs, room_beside_photographs
        from nanogs.threads import use_threads

        with use_device(device) as used, use_threads(threads), show_progress(progress) as on_step:
            first, *tests = zip(names, sources, strict=True)
            entries: list[tuple[str, Splats | Source, str]] = [(*test, "") for test in tests]
            files = files_of(sources[1:], packing)
            sets_count = asked.sets_count if photos is None else 0
            tracker = Tracker(on_step, _stages(len(models), files, sets_count))
            if packing:
                entries = write_packed_files(tests, packing, stack, limit, tracker)
                made = [source for _, source, suffix in entries if suffix]
                room = room_for_comparison([*given, *made], [*sources, *made], *looking)
            every = [named(*entry, room is None) for entry in [(*first, ""), *entries]]
            if photos is None:
                sets = asked.sets(every[0].splats, views, up)
                comparison, _ = compare_on_sets(
                    every[0], every[1:], sets, background=background or BLACK, extras=extras,
                    room=room, progress=tracker,
                )  # fmt: skip
            else:
                tracker.begin("photographs")
                behind, frames = photographs(Path(photos), images, split, background, limit)
                comparison, _ = compare_with_photographs(
                    str(photos), every, frames, split=split, background=behind, extras=extras,
                    room=room_beside_photographs(room, frames, packed=bool(packing)),
                    progress=tracker,
                )  # fmt: skip
            tracker.finish()
            remarks = remarks_on([*zip(names, sources, strict=True)])
            notes = (*remarks, *packing_notes(tests, packing), *comparison.notes)
            notes = (*notes, *device_notes(device, used))
    return replace(comparison, notes=notes)


@dataclass(frozen=True, slots=True)
class ComparedViews:
    """The requested views: cameras, or else kinds of automatic views (or a file) and sizes."""

    cameras: "list[Camera]"
    sources: Sequence[str] = ()
    sizes: "Sequence[Size]" = ()

    def pictures(self, views: int | None) -> tuple[int, int]:
        """Return the pixels of the largest view and of the largest set the number of views.

        The number is 0 for the cameras of a file.
        """
        from nanogs.scoring.view_sets import found_views

        if self.cameras:
            return max(camera.width * camera.height for camera in self.cameras), len(self.cameras)
        largest = max((width * height for width, height in self.sizes), default=0)
        return largest, max(found_views(self.sources, views), default=0)

    @property
    def sets_count(self) -> int:
        """Number of sets of views."""
        return 1 if self.cameras else len(self.sources) * len(self.sizes)

    def sets(
        self, model: Splats | Source, views: int | None, up: Sequence[float] | None
    ) -> "list[ViewSet]":
        """Return the sets of views; views that are not given are computed from the model."""
        from nanogs.scoring.view_sets import ViewSet, view_sets

        if self.cameras:
            return [ViewSet(self.cameras, "given")]
        return view_sets(model, self.sources, self.sizes, views=views, up=up)


def compared_views(cameras: Cameras | Sequence[str], pixels: Pixels) -> ComparedViews:
    """Parse the requested views; arguments and errors are those of `compare`."""
    from nanogs.scoring.view_sets import parse_sources

    if isinstance(cameras, Camera):
        return ComparedViews([cameras])
    names = one_or_several(cameras)
    sources = [fspath(name) for name in names if isinstance(name, str | PathLike)]
    if not sources or len(sources) < len(names):
        return ComparedViews(given_cameras(names))
    sources = parse_sources(sources[0]) if len(sources) == 1 else sources
    several = pixels if isinstance(pixels, list) else [pixels]
    return ComparedViews([], sources, [picture_size(size) for size in several])


def _names(models: Sequence[Model], names: Sequence[str] | None) -> list[str]:
    if not models:
        raise OptionError("Give at least one model to compare with the original.")
    if names is None:
        return [file_name(model) or f"model {place}" for place, model in enumerate(models, 1)]
    if isinstance(names, str) or not isinstance(names, Sequence) or len(names) != len(models):
        raise OptionError(f"Give one name for each model, {len(models)} in all, not {names!r}.")
    return list(names)


def file_name(model: Model) -> str | None:
    """Return the name of a model's file, or None if the model is not given as a path."""
    return place(model).name if isinstance(model, str | PathLike) else None


def _stages(models: int, files: int, sets: int) -> list[Stage]:
    """Return the stages of a comparison from numbers of models, packed files and sets of views.

    No sets of views means photographs.
    """
    looking = [Stage("render", 1.0), Stage("score", float(models + files))] * sets
    if not sets:
        looking = [Stage("photographs", 1.0), Stage("score", 1.0 + models + files)]
    return [Stage("pack", float(files))] * bool(files) + looking
