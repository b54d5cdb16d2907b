"""Making a page with one or two models: the implementation of `nanogs view`."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from nanogs.clock import StageClock
from nanogs.defaults import PAGE_SPLATS
from nanogs.formatting import counted, utf8
from nanogs.io import FileInfo, inspect, load
from nanogs.io import open as open_model
from nanogs.io.atomic import atomic_write
from nanogs.io.collect import model_in
from nanogs.io.frames import other_frames
from nanogs.io.parts import FileSource
from nanogs.io.registry import refuse_level, stem_of
from nanogs.memory import allowed_memory, refuse_too_large
from nanogs.memory_estimates import compare_bytes, page_bytes
from nanogs.progress import PartProgress, Progress, Stage, Tracker, each
from nanogs.protocol import BLACK, PIXELS, VIEWS, Background, Judged, Kind
from nanogs.raster.camera import Camera
from nanogs.splats import Splats
from nanogs.view.bundle import check_built
from nanogs.view.pack import Packed, pack
from nanogs.view.page import Shown, facts_of, render_page
from nanogs.views.cameras import KINDS, chosen_cameras, known_cameras
from nanogs.views.costing import pictures_of
from nanogs.views.opening import opening_for

if TYPE_CHECKING:
    from nanogs.scoring.comparison import Comparison


@dataclass(frozen=True, slots=True)
class ViewedModel:
    """A model of a page.

    Attributes:
        name: Its name.
        input: Its file.
        input_bytes: Bytes of all its files; for a streamed model, of the files of the level shown.
        splats: Number of splats.
        sh_degree: Spherical-harmonic degree.
        page_bytes: Size of the model in the page, before it is encoded as text.
        notes: Changes made by reading it, and properties that the page does not show.
    """

    name: str
    input: str
    input_bytes: int
    splats: int
    sh_degree: int
    page_bytes: int
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class ViewReport:
    """The result of `view_files`.

    Attributes:
        output: The page.
        output_bytes: Its size.
        models: The one or two models.
        judged: Scores of the second model against the first as it is shown, as from `compare`; None
            for one model, or if not requested.
        notes: Remarks that matter for reading these scores.
        seconds: Time by stage.
    """

    output: str
    output_bytes: int
    models: tuple[ViewedModel, ...]
    judged: Judged | None
    notes: tuple[str, ...]
    seconds: dict[str, float]

    def to_dict(self) -> dict[str, Any]:
        """Return plain dictionaries, lists, numbers and strings."""
        return asdict(self)


def view_files(
    inputs: Sequence[tuple[str, Path]],
    page: Path,
    *,
    cameras: str = "auto",
    views: int = VIEWS,
    width: int = PIXELS,
    height: int = PIXELS,
    up: Sequence[float] | None = None,
    background: Background = BLACK,
    psnr: bool = True,
    level: int | None = None,
    render_mode: str | None = None,
    max_memory: int | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> ViewReport:
    """Read one or two models, measure the second against the first, and write the page.

    Args:
        inputs: Names and files; the first is the original, on the left.
        page: The page to write.
        cameras: See `cameras_for`; the page starts at the first camera of a file, or with a view of
            the whole scene.
        views: Number of automatic views to measure on.
        width: Width of automatic views, pixels.
        height: Height of automatic views, pixels.
        up: Up direction; found from the first model by default.
        background: RGB in [0, 1].
        psnr: Measure the second model.
        level: Level of detail of streamed models; by default the finest of at most `PAGE_SPLATS`
            splats, or the coarsest.
        render_mode: Render mode of the models, which overrides that of their files; see
            `nanogs.open`.
        max_memory: Bytes that this process may take; by default the free memory.
        overwrite: Replace the page if it exists.
        progress: Called with each `nanogs.progress.Step`.

    Raises:
        NanogsError: A file or an option is not usable, or the viewer was not built.
    """
    check_built()
    clock = StageClock()
    measured = psnr and len(inputs) > 1
    wanted = known_cameras(cameras)
    pictures = pictures_of(wanted, views, (width, height))
    tracker = Tracker(progress, _stages(len(inputs), pictures[1] if measured else 0))
    tracker.begin("read")
    with clock.time("read"):
        files = [_open(name, path, level) for name, path in inputs]
        _refuse_too_large([file.info for file in files], pictures if measured else None, max_memory)
        models = _read(files, level, render_mode, tracker.part)
    tracker.begin("cameras")
    with clock.time("cameras"):
        found: list[Camera] = []
        kind: Kind = "given"
        if measured:
            found, kind = chosen_cameras(models[0], wanted, views, (width, height), up)
        first_view = KINDS.get(wanted, "auto") if isinstance(wanted, str) else wanted[0]
        start = opening_for(models[0], first_view, up)
    judged, notes = None, other_frames([(file.name, file.source) for file in files])
    if measured:
        with clock.time("measure"):
            comparison = _compare(files, models, found, kind, background, tracker)
        judged = comparison.judged(0)
        notes += (*_against(files[0]), *comparison.notes)
    tracker.begin("encode")
    with clock.time("pack"):
        packed = [pack(splats, start) for splats in each(models, tracker.part)]
    tracker.begin("write")
    with clock.time("write"):
        text = render_page(_shown(files, models, packed, judged), start, background)
        with atomic_write(page, overwrite=overwrite) as file:
            file.write(utf8(text))
    tracker.finish()
    return ViewReport(
        output=str(page),
        output_bytes=page.stat().st_size,
        models=tuple(map(_viewed, files, models, packed)),
        judged=judged,
        notes=notes,
        seconds=dict(clock.seconds),
    )


class _File(NamedTuple):
    """A file of a page's model.

    Attributes:
        name: Name of the model.
        path: The file.
        source: The file, opened.
        levels: Splats of each of its levels; empty without levels.
        level: The level that is shown; 0 without levels.
        info: Of that level.
    """

    name: str
    path: Path
    source: FileSource
    levels: Sequence[int]
    level: int
    info: FileInfo

    @property
    def level_text(self) -> str:
        """Name of the level; empty for the finest, and for a model without levels."""
        return f"level {self.level} (0 to {len(self.levels) - 1})" if self.level else ""


def _open(name: str, path: Path, level: int | None) -> _File:
    """Open a model's file, at a level, or at the finest that a page shows if that is None."""
    path = model_in(path)
    source = open_model(path)
    levels = source.levels
    number = _number(levels, level)
    return _File(name, path, source, levels, number, inspect(path, level=number))


def _refuse_too_large(
    infos: Sequence[FileInfo], measured: tuple[int, int] | None, max_memory: int | None
) -> None:
    """Refuse models that do not fit into memory while the page is made.

    Args:
        infos: Of the files.
        measured: Pixels and number of the views to measure on; None if nothing is measured.
        max_memory: Bytes that this process may take; by default the free memory.

    Raises:
        NotEnoughMemoryError: They do not.
    """
    page_alone = page_bytes(infos)
    needed = page_alone if measured is None else compare_bytes(infos, *measured)
    remedy = "view smaller models"
    if page_alone <= allowed_memory(max_memory, compiled=False).bytes:
        remedy += ", or leave out the PSNR (`psnr=False`)"
    allowed = allowed_memory(max_memory, compiled=measured is not None)
    refuse_too_large("Making this page", needed, allowed, remedy)


def _read(
    files: Sequence[_File], level: int | None, mode: str | None, on_progress: PartProgress
) -> list[Splats]:
    """Load the models; if no `level` is asked for, a note names that of a streamed model."""
    if level is not None and not any(file.levels for file in files):
        refuse_level(files[0].path, level)
    models = []
    for file in each(files, on_progress):
        shown = load(file.path, level=file.level, render_mode=mode)
        models.append(_with_note(shown, file) if level is None else shown)
    return models


def _number(levels: Sequence[int], level: int | None) -> int:
    """Return the level that is shown of a model; 0 if it has no levels."""
    if not levels:
        return 0
    return _affordable(levels) if level is None else level


def _affordable(levels: Sequence[int]) -> int:
    """Return the finest level of at most `PAGE_SPLATS` splats, or the coarsest."""
    fitting = (number for number, count in enumerate(levels) if count <= PAGE_SPLATS)
    return next(fitting, len(levels) - 1)


def _against(first: _File) -> tuple[str, ...]:
    """Return a note if the scores are against a coarse level of the first model."""
    coarse, name = first.level_text, first.name
    note = f"The PSNR is against {coarse} of {name}; nanogs compare measures against the finest."
    return (note,) if coarse else ()


def _with_note(splats: Splats, file: _File) -> Splats:
    """Return the model with a note if another level than the finest is shown."""
    if not file.level_text:
        return splats
    note = (
        f"{file.level_text} is shown, {counted(len(splats), 'splat')};"
        f" `level=0` shows the finest, {file.levels[0]:,}."
    )
    return replace(splats, notes=(*splats.notes, note))


def _stages(models: int, views: int) -> list[Stage]:
    """Return the stages for a number of models, measured on a number of views (0: not measured)."""
    measuring = [Stage("render", views), Stage("score", views)] if views else []
    return [
        Stage("read", 2.0 * models), Stage("cameras", 1.0), *measuring,
        Stage("encode", 3.0 * models), Stage("write", 1.0),
    ]  # fmt: skip


def page_path(paths: Sequence[Path]) -> Path:
    """Return the default page for models: in the current folder, named after them."""
    return Path("-".join(stem_of(path) or "model" for path in paths) + ".html")


def _compare(
    files: Sequence[_File],
    models: Sequence[Splats],
    cameras: Sequence[Camera],
    kind: Kind,
    background: Background,
    progress: Tracker,
) -> "Comparison":
    from nanogs.scoring.comparison import NamedModel, compare_models

    reference, other = (
        NamedModel(file.name, splats) for file, splats in zip(files, models, strict=True)
    )
    comparison, _ = compare_models(
        reference,
        [other],
        cameras,
        kind=kind,
        background=background,
        progress=progress,
    )
    return comparison


def _shown(
    files: Sequence[_File],
    models: Sequence[Splats],
    packed: Sequence[Packed],
    judged: Judged | None,
) -> list[Shown]:
    """Return the models for the page, with the scores of the second."""
    shown = []
    for place, (file, splats, data) in enumerate(zip(files, models, packed, strict=True)):
        reference, score = (len(models[0]), judged) if place else (None, None)
        facts = facts_of(len(splats), file.info.file_bytes, reference=reference, judged=score)
        if score is not None and files[0].level_text:
            facts += (f"against {files[0].level_text}",)
        coarse = file.level_text
        shown.append(Shown(file.name, (*facts, coarse) if coarse else facts, data))
    return shown


def _viewed(file: _File, splats: Splats, packed: Packed) -> ViewedModel:
    return ViewedModel(
        name=file.name,
        input=str(file.path),
        input_bytes=file.info.file_bytes,
        splats=len(splats),
        sh_degree=splats.sh_degree,
        page_bytes=len(packed.data),
        notes=(*splats.notes, *packed.notes),
    )
