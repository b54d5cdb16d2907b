"""`nanogs.convert`: write a model in another format, streaming blocks of rows if formats allow."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nanogs import memory, memory_estimates
from nanogs.bar import show_progress
from nanogs.clock import StageClock
from nanogs.filters import Filter, FilterReport, apply, checked_filters
from nanogs.findings import join_findings
from nanogs.frames import checked_frames
from nanogs.io import bytes_on_disk, check_writable, inspect, registry, write_model
from nanogs.io import open as open_model
from nanogs.io.frames import keep_stated_frame, refuse_frame_read, refuse_frame_written
from nanogs.io.parts import FileSource, level_note
from nanogs.io.url_files import local_copies
from nanogs.io.urls import as_path
from nanogs.pipeline.estimates.stage_weights import read_weight, write_weight
from nanogs.pose import Pose, pose_of_options
from nanogs.progress import Progress, Stage, Tracker
from nanogs.quantities import as_bytes
from nanogs.ranges import as_switch
from nanogs.source import Filtered, InMemory, Layout, Posed, Reduced, Source, turned_source
from nanogs.splats import RenderMode, check_degree

if TYPE_CHECKING:
    from nanogs.io.format import FormatOptions


@dataclass(frozen=True, slots=True)
class ConvertReport:
    """The report of `convert`: what was written, and what the format leaves out.

    Attributes:
        input: The file that was read.
        output: The file that was written.
        filters: Number of splats that each filter removed.
        frames: Coordinate frames from and to which the model was turned, or None.
        input_bytes: Bytes of the input.
        output_bytes: Bytes of the output.
        format: Name of the output's format.
        splats: Number of splats in the output.
        sh_degree: Degree of its spherical harmonics.
        render_mode: The rasteriser that the output names.
        notes: What reading changed, one sentence each.
        losses: What the output leaves out, one sentence each.
        seconds: Time by stage, seconds.
        total_seconds: Time of the whole call, seconds.
    """

    input: str
    output: str
    filters: tuple[FilterReport, ...]
    frames: tuple[str, str] | None
    input_bytes: int
    output_bytes: int
    format: str
    splats: int
    sh_degree: int
    render_mode: RenderMode
    notes: tuple[str, ...]
    losses: tuple[str, ...]
    seconds: dict[str, float]
    total_seconds: float

    def to_dict(self) -> dict[str, Any]:
        """Return the report as plain dictionaries, lists, numbers and strings."""
        return asdict(self)


def convert(
    source: str | PathLike[str],
    target: str | PathLike[str],
    *,
    level: int = 0,
    filters: Sequence[Filter] = (),
    sh_degree: int | None = None,
    frame: tuple[str, str] | None = None,
    scale: float = 1.0,
    rotate: Sequence[float] = (0.0, 0.0, 0.0),
    translate: Sequence[float] = (0.0, 0.0, 0.0),
    render_mode: str | None = None,
    overwrite: bool = False,
    format_options: "FormatOptions | None" = None,
    max_memory: int | str | None = None,
    progress: Progress | bool | None = None,
) -> ConvertReport:
    """Write a model in another format, chosen by the suffix of the target.

    Args:
        source: The file to read, or its URL.
        target: The file to write, or a URL to send it to; see `nanogs.save`.
        level: Level of detail to read of a streamed model; 0 is the finest.
        filters: Filters that remove splats, such as `[nanogs.filters.box(low, high)]`.
        sh_degree: The highest degree of spherical harmonics to keep, 0 to 4; all by default.
        frame: Coordinate frames from and to which the model is turned, such as ("rdf", "rub").
        scale: Factor by which the model is scaled after that, about the origin.
        rotate: Angles in degrees by which it is then turned: about x, then about y, then about z.
        translate: Shift by which it is moved at last, scene units.
        render_mode: "default" or "mip" in place of the render mode that the file names; see `open`.
        overwrite: Replace the output if it exists.
        format_options: Options of the output's format; see `save`.
        max_memory: Bytes of memory that this process may use, a number or text like "4GB"; by
            default the free memory, less a tenth.
        progress: True for a bar, in a notebook or on a terminal, or a function that is called with
            each `nanogs.progress.Step`.

    Returns:
        The report: splats and bytes, what was changed or left out, and the time taken.

    Raises:
        FormatError: The input cannot be read.
        OptionError: An option is invalid.
        ModelError: A filter leaves no splat.
        OutputError: The output exists, or it cannot be written.
        NotEnoughMemoryError: The conversion takes more memory than is free or allowed.
    """
    start, clock = time.perf_counter(), StageClock()
    given, wanted, filters = as_path(source), as_path(target), checked_filters(filters)
    frame, pose = checked_frames(frame), pose_of_options(scale, rotate, translate)
    check_degree(sh_degree)
    format_options = registry.add_target_frame(wanted, format_options, frame)
    overwrite = as_switch("`overwrite`", overwrite)
    saving: dict[str, Any] = {"overwrite": overwrite, "format_options": format_options}
    check_writable(wanted, **saving)
    with (
        show_progress(progress) as on_step,
        local_copies([given], wanted, overwrite=overwrite) as ([here], there),
        open_model(here, level=level, render_mode=render_mode) as file,
    ):
        path = there or wanted
        known = registry.writable(wanted)
        known.check_columns(file.columns)
        known.check_elements([name for name, _ in file.elements], format_options or {})
        if frame is not None:
            refuse_frame_read(frame, [file])
            refuse_frame_written(frame, wanted)
        unturned = () if frame else (file,)
        saving["format_options"], said = keep_stated_frame(wanted, format_options, unturned)
        allowed = None if max_memory is None else as_bytes(max_memory)
        _refuse_too_large(file, path, filters, format_options, allowed)
        typical = 1_000_000  # only the ratio of the two weights matters
        write = Stage("write", write_weight(path.suffix, typical))
        tracker = Tracker(on_step, [Stage("read", read_weight(typical)), write])
        tracker.begin("read")
        with clock.time("read"):
            model, took = _changed(file, path, filters, sh_degree, frame, pose)
            # Read the input's facts now: the output may replace the input.
            notes, lost = _said(model, path)
            said = (*_which(file, level), *said)
            ignored = known.without_effect(format_options, model.columns.sh_degree)
            count, columns, read_bytes = model.count, model.columns, file.info.file_bytes
        tracker.begin("write")
        with clock.time("write"):
            write_model(model, path, progress=tracker.passing(), **saving)
        tracker.finish()
        made = _written(path, count, columns) | {"output_bytes": bytes_on_disk(path)}
    return ConvertReport(
        input=str(given), output=str(wanted), filters=took, frames=frame,
        input_bytes=read_bytes, **made, notes=(*notes, *said, *ignored), losses=lost,
        seconds=clock.seconds, total_seconds=time.perf_counter() - start,
    )  # fmt: skip


def _refuse_too_large(
    source: FileSource,
    target: Path,
    filters: Sequence[Filter],
    options: "FormatOptions | None",
    max_memory: int | None,
) -> None:
    known, given = registry.find(target), options or {}
    compiled = known is not None and (known.suffix == ".sog" or given.get("palette") is not None)
    memory.refuse_too_large(
        f"Converting {source.name}",
        memory_estimates.convert_bytes(source, target, whole=_need_whole(filters), options=given),
        memory.allowed_memory(max_memory, compiled=compiled),
        "name a .ply file, which is written in parts, or make a smaller model with"
        " `nanogs simplify` first, which works in blocks",
    )


def _need_whole(filters: Sequence[Filter]) -> bool:
    return any(each.whole for each in filters)


def _changed(
    source: Source,
    target: Path,
    filters: Sequence[Filter],
    sh_degree: int | None,
    frame: tuple[str, str] | None,
    pose: Pose | None,
) -> tuple[Source, tuple[FilterReport, ...]]:
    """Return the model to write and the filters' reports.

    It is loaded whole only if a filter or the target's format needs that.
    """
    took: tuple[FilterReport, ...] = ()
    if _need_whole(filters):
        splats, took = apply(source.load(), filters)
        source = InMemory(splats)
    elif filters:
        source = Filtered(source, filters)
        took = source.reports
    if sh_degree is not None:
        source = Reduced(source, sh_degree)
    source = turned_source(source, frame)
    source = source if pose is None else Posed(source, pose)
    return source if registry.writable(target).streams else InMemory(source.load()), took


def _which(file: FileSource, level: int) -> tuple[str, ...]:
    """Return a note on the level that was read, if there are several.

    Reading 3D Tiles adds such a note itself.
    """
    if registry.reader(file.path).suffix == registry.TILESET or len(file.levels) < 2:
        return ()
    return (level_note(level, len(file.levels)),)


def _said(model: Source, target: Path) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Collect the notes of reading and the losses of the target's format, in one pass."""
    losses, notes, lost = registry.writable(target).losses, [model.columns.notes], []
    for block in model.blocks():
        notes.append(tuple(block.notes))
        lost.append(losses(block))
    return join_findings(notes), join_findings(lost)


def _written(target: Path, count: int, columns: Layout) -> dict[str, Any]:
    """Describe the file that was written, by its own header if the format can be read."""
    known = registry.writable(target)
    if not known.readable:  # a page, which draws all modes but mip as the default
        mip = columns.render_mode == RenderMode.MIP
        return {
            "format": target.suffix.lstrip("."),
            "splats": count,
            "sh_degree": min(columns.sh_degree, known.max_degree),
            "render_mode": RenderMode.MIP if mip else RenderMode.DEFAULT,
        }
    info = inspect(target)
    names = ("format", "splats", "sh_degree", "render_mode")
    return {name: getattr(info, name) for name in names}
