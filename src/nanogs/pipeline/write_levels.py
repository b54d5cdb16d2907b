"""Write the levels of a model into a folder, one at a time, with what describes them."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

from nanogs._version import __version__
from nanogs.bar import drawn
from nanogs.frames import change_frame
from nanogs.io.folder import atomic_folder
from nanogs.io.models import Model, as_splats
from nanogs.lod.chunks import Written
from nanogs.lod.file_levels import PLY
from nanogs.lod.layout import NAMES, Layout, LevelWriter, check_options, made_files, writer
from nanogs.lod.manifest import ChunkedLevel, Level, Manifest, describe_chunks, describe_level
from nanogs.lod.measured import LevelJudge, level_judge
from nanogs.pipeline.levels import judged_levels
from nanogs.pipeline.presets import DEFAULT_PRESET, Parameters, parameters
from nanogs.pipeline.target import target_count
from nanogs.pipeline.weights import measure_stage, write_weight
from nanogs.progress import Progress, Stage, Tracker
from nanogs.report import SimplifyReport
from nanogs.splats import Splats

_NO_PARAMETERS = ("preset", "cameras", "nan", "threads", "max_memory")


def write_levels(
    model: Model,
    folder: str | PathLike[str],
    ratios: Sequence[float],
    *,
    source: str | None = None,
    layout: Layout = Layout.FILES,
    chunk: int | None = None,
    plain: bool = False,
    suffix: str = PLY,
    frame: tuple[str, str] | None = None,
    overwrite: bool = False,
    measured: bool = False,
    progress: Progress | bool | None = None,
    **options: Any,  # noqa: ANN401 - as `levels` takes them
) -> tuple[Manifest, tuple[SimplifyReport, ...]]:
    """Make the levels of a model; all of the folder appears or nothing.

    Args:
        model: The model, a source of it, or a path.
        folder: The folder to make.
        ratios: As `levels` takes them.
        source: Name of the model for the manifest; by default that of its file.
        layout: ".ply files", "streamed sog" or "3d tiles".
        chunk: Most splats of the finest level in a chunk, for a layout with chunks; 32,768 by
            default.
        plain: Leave the contents of 3D Tiles unpacked, every number as it is; by default SPZ packs
            them.
        suffix: Format of levels in files of their own.
        frame: From and to which the levels are turned before they are written.
        overwrite: Replace the folder if it holds nothing but earlier levels.
        measured: Hold what was written of each level against the model, as `nanogs compare` does.
        progress: As `levels` takes it; a stage "write" follows each level.
        **options: As `levels` takes them.

    Returns:
        What the manifest says, and the report of each level.

    Raises:
        OptionError: As for `levels`, or the layout has no such chunks or contents.
        ModelError: As for `levels`.
        OutputError: The folder may not be replaced, or it cannot be written.
    """
    layout, splats = Layout(layout), as_splats(model)
    name = source or (Path(model).name if isinstance(model, str | PathLike) else "a model")
    entries: list[Level | ChunkedLevel] = []
    reports: list[SimplifyReport] = []
    left_out: list[str] = []
    check_options(layout, chunk, plain=plain)
    stages = write_levels_stages(
        _parameters(options), len(splats), ratios, layout, suffix, measured=measured
    )
    with drawn(progress) as tell:
        tracker = Tracker(tell, stages)
        made = judged_levels(splats, ratios, judged=measured, progress=tracker.passing(), **options)
        threads = options.get("threads")
        judge = LevelJudge()
        if measured:
            judge = level_judge(splats, suffix, frame, threads, tracker)
        with atomic_folder(Path(folder), made_files, overwrite=overwrite) as temporary:
            out = writer(layout, temporary, chunk, plain=plain, suffix=suffix)
            for ratio in ratios:
                report, written, losses = _write_next(made, out, frame, tracker)
                # Said once of the finest level, and of others where it is not the same.
                prefix = f"Level {len(reports)}: " if reports else ""
                left_out += [prefix + loss for loss in losses if loss not in left_out]
                reports.append(report)
                if layout is Layout.FILES:
                    path = temporary / written.names[0]
                    entries.append(judge.of_file(describe_level(path, ratio, report), path))
                else:
                    entries.append(describe_chunks(*written, ratio, report))
            manifest = _manifest(name, entries, reports, [*left_out, *judge.notes])
            if judge.views:
                manifest = replace(manifest, protocol=judge.views.protocol)
            out.finish(manifest)
            if layout is not Layout.FILES:  # what describes the chunks is there now
                manifest = judge.of_chunks(manifest, temporary / NAMES[layout])
        tracker.finish()
        return manifest, tuple(reports)


def _write_next(
    made: Iterator[tuple[Splats, SimplifyReport]],
    out: LevelWriter,
    frame: tuple[str, str] | None,
    progress: Tracker,
) -> tuple[SimplifyReport, Written, tuple[str, ...]]:
    """Make and write one level; nothing of it is kept but its report and what was left out."""
    small, report = next(made)
    if frame:
        small = change_frame(small, *frame)
    progress.begin("write")
    return report, out.add(small, progress.part), out.losses(small)


def write_levels_stages(
    parameters: Parameters,
    splats: int,
    ratios: Sequence[float],
    layout: Layout,
    suffix: str = PLY,
    *,
    measured: bool = False,
) -> list[Stage]:
    """The stages of `write_levels`: those of `levels`, and a "write" after each level.

    Where levels are measured, "measure" comes first, and the rest of it belongs to the writing.
    """
    from nanogs.pipeline.stages import levels_stages

    measure = [measure_stage(splats)] if measured else []
    counts = [target_count(splats, ratio, None) for ratio in ratios]
    stages = levels_stages(parameters, splats, counts)
    ending = ".sog" if layout is Layout.SOG else suffix
    writes = [Stage("write", write_weight(ending, count)) for count in counts]
    first = len(stages) - len(counts)
    pairs = zip(stages[first:], writes, strict=True)
    return [*measure, *stages[:first], *(stage for pair in pairs for stage in pair)]


def _parameters(options: dict[str, Any]) -> Parameters:
    """The parameters of the method among the options of `levels`."""
    overrides = {name: value for name, value in options.items() if name not in _NO_PARAMETERS}
    return parameters(options.get("preset", DEFAULT_PRESET), overrides)


def _manifest(
    source: str,
    entries: list[Level | ChunkedLevel],
    reports: list[SimplifyReport],
    left_out: list[str],
) -> Manifest:
    first = reports[0]
    notes = [note for report in reports for note in report.notes]
    return Manifest(
        generator=f"nanogs {__version__}",
        source=source,
        source_count=first.input_count,
        preset=first.preset,
        parameters=first.parameters,
        levels=tuple(entries),
        notes=tuple(dict.fromkeys([*notes, *left_out])),
    )
