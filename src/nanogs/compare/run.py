"""A comparison from file names: what `nanogs compare` does."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nanogs.compare.comparison import (
    Comparison,
    NamedModel,
    compare_models,
    compare_with_photographs,
)
from nanogs.compare.page import render_page
from nanogs.compare.protocol import BLACK, PIXELS, VIEWS, Background, Judged, Kind
from nanogs.compare.scoring import ReferenceView
from nanogs.errors import OptionError
from nanogs.formatting import counted
from nanogs.io import inspect, load
from nanogs.io.atomic import atomic_write
from nanogs.memory import allowed_memory, refuse_too_large
from nanogs.needs import compare_bytes, photographs_bytes
from nanogs.progress import Progress, Stage, Tracker, each
from nanogs.render.opening import Opening, opening_for
from nanogs.render.source import AUTOMATIC, cameras_for
from nanogs.view.bundle import check_built
from nanogs.view.pack import pack
from nanogs.view.page import Shown, facts_of, viewer_part


def compare_files(
    reference: tuple[str, Path],
    tests: Sequence[tuple[str, Path]],
    *,
    cameras: str = "auto",
    views: int = VIEWS,
    width: int = PIXELS,
    height: int = PIXELS,
    up: Sequence[float] | None = None,
    background: Background | None = None,
    extras: Sequence[str] = (),
    photos: Path | None = None,
    images: str | None = None,
    split: str = "test",
    report: Path | None = None,
    interactive: bool = False,
    max_memory: int | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Comparison:
    """Read, score, and write the page if one is asked for.

    Args:
        reference: Name and file of the original model.
        tests: Names and files of the models to score.
        cameras: See `cameras_for`; without effect where photographs are given.
        views: Number of automatic views.
        width: Width of automatic views, pixels.
        height: Height of automatic views, pixels.
        up: Up direction of automatic views.
        background: RGB in [0, 1]; by default black, and for photographs the data set's own (see
            `Dataset.background`).
        extras: Further metrics.
        photos: Data-set folder; the reference is then scored against its photographs too.
        images: Folder of the photographs in a COLMAP data set.
        split: Photographs to use, "test" or "train".
        report: Page to write, or None.
        interactive: Put the models into the page too, to be loaded and moved there.
        max_memory: Bytes that this process may take; by default what is free.
        overwrite: Replace the page if it exists.
        progress: Called with each `nanogs.progress.Step`.

    Raises:
        NanogsError: A file or an option is not usable, or there is too little memory.
    """
    if report and interactive:
        check_built()
    page = interactive if report else None
    infos = [inspect(path) for _name, path in (reference, *tests)]
    automatic = photos is None and cameras in AUTOMATIC
    needed = compare_bytes(infos, width * height, views if automatic else 0, paged=bool(page))
    refuse_too_large("Comparing these models", needed, allowed_memory(max_memory), _LESS)
    tracker = Tracker(progress, _stages(1 + len(tests), views, page, with_photos=bool(photos)))
    tracker.begin("read")
    models = []
    for name, path in each((reference, *tests), tracker.part):
        models.append(NamedModel(name, load(path), inspect(path).file_bytes))
    options: dict[str, Any] = {
        "extras": extras,
        "pictures": report is not None,
        "progress": tracker,
    }
    if photos is None:
        chosen = cameras_for(
            models[0].splats, cameras, count=views, width=width, height=height, up=up
        )
        kind: Kind = AUTOMATIC.get(cameras, "given")
        behind = background or BLACK
        comparison, sheets = compare_models(
            models[0], models[1:], chosen, kind=kind, background=behind, **options
        )
    else:
        tracker.begin("photographs")
        behind, frames = photographs(photos, images, split, background, max_memory)
        chosen = [frame.camera for frame in frames]
        comparison, sheets = compare_with_photographs(
            str(photos), models, frames, split=split, background=behind, **options
        )
    if report:
        viewer = None
        if interactive:
            tracker.begin("encode")
            place = chosen[0] if photos else AUTOMATIC.get(cameras, chosen[0])
            start = opening_for(models[0].splats, place, up)
            viewer = viewer_part(_shown(models, comparison, start), start, behind)
        tracker.begin("write")
        page_text = render_page(comparison, sheets, f"{reference[0]}: comparison", viewer)
        with atomic_write(report, overwrite=overwrite) as file:
            file.write(page_text.encode("utf-8"))
    tracker.finish()
    return comparison


_LESS = "free some, or compare fewer or smaller views (`views`, `pixels`) or smaller models"


def _stages(models: int, views: int, page: bool | None, *, with_photos: bool) -> list[Stage]:
    """The stages to come, for so many models; the page has a 3D part, none, or is not made."""
    looking = Stage("photographs", views) if with_photos else Stage("render", views)
    stages = [Stage("read", 2.0 * models), looking, Stage("score", models * views)]
    stages += [Stage("encode", 3.0 * models)] if page else []
    return stages + ([] if page is None else [Stage("write", 1.0)])


def _shown(models: Sequence[NamedModel], comparison: Comparison, start: Opening) -> list[Shown]:
    """The models as the page's viewer has them, with their scores."""
    judged: list[Judged | None] = [comparison.judged(i) for i in range(len(comparison.models))]
    if len(judged) < len(models):  # the original is what the others are held against
        judged = [None, *judged]
    original = models[0].splats
    return [
        Shown(
            model.name,
            facts_of(
                len(model.splats),
                model.file_bytes,
                reference=None if place == 0 else len(original),
                judged=score,
            ),
            pack(model.splats, start),
        )
        for place, (model, score) in enumerate(zip(models, judged, strict=True))
    ]


def photographs(
    folder: Path,
    images: str | None,
    split: str,
    background: Background | None,
    max_memory: int | None = None,
) -> tuple[Background, list[ReferenceView]]:
    """Cameras and photographs of a data set's split.

    Args:
        folder: NeRF-Synthetic or COLMAP data set.
        images: Folder of the photographs in a COLMAP data set.
        split: "test" or "train".
        background: RGB in [0, 1] behind transparent parts; None for the data set's own.
        max_memory: Bytes that this process may take; by default what is free.

    Returns:
        The background, and the photographs over it.

    Raises:
        NotEnoughMemoryError: They are too many, or too large.
        NanogsError: The folder holds no such data set, split or photograph.
    """
    from nanogs.datasets.dataset import Split, open_dataset

    splits: dict[str, Split] = {"test": "test", "train": "train"}
    if split not in splits:
        raise OptionError(f"The split must be test or train, not {split!r}.")
    dataset = open_dataset(folder, images=images)
    frames = dataset.split(splits[split])
    pixels = [frame.camera.width * frame.camera.height for frame in frames]
    refuse_too_large(
        f"Comparing with {counted(len(frames), 'photograph')}",
        photographs_bytes(pixels),
        allowed_memory(max_memory),
        'free some, or use smaller photographs, as with `images="images_4"`',
    )
    behind = background or dataset.background(frames)
    return behind, [
        ReferenceView(frame.camera, dataset.load_photo(frame, behind)) for frame in frames
    ]
