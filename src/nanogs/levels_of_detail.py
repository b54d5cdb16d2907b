"""`nanogs.write_levels`: levels of a model in a folder, with what describes them.

Here who makes levels (`pipeline`) and who lays them out (`lod`) meet, and nowhere else.
"""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nanogs.bar import drawn
from nanogs.frames import change_frame
from nanogs.io.models import Model, as_splats
from nanogs.lod.folder import PLY, LevelsFolder
from nanogs.lod.layout import Layout, chunks_of
from nanogs.lod.manifest import Manifest, describe_levels
from nanogs.lod.measured import LevelJudge, level_judge
from nanogs.pipeline.foreseen import levels_stages
from nanogs.pipeline.in_blocks import simplify_into
from nanogs.pipeline.levels import check_ratios, judged_levels
from nanogs.pipeline.presets import DEFAULT_PRESET, Parameters, parameters
from nanogs.pipeline.target import Goal, target_count
from nanogs.pipeline.weights import measure_stage, write_weight
from nanogs.progress import Progress, Stage, Tracker
from nanogs.report import SimplifyReport

if TYPE_CHECKING:
    from nanogs.pipeline.stored_job import Where

_NO_PARAMETERS = ("preset", "cameras", "nan", "threads", "max_memory")


def write_levels(
    model: Model,
    folder: str | PathLike[str],
    ratios: Sequence[float],
    *,
    source: str | None = None,
    layout: Layout | str = Layout.FILES,
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
        layout: "files", one a level; "streamed sog" or "3d tiles".
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
        OptionError: As for `levels`, there is no such layout, it has no such chunks or contents, or
            the format of the files is not written.
        ModelError: As for `levels`.
        OutputError: The folder may not be replaced, or it cannot be written.
    """
    chunks = chunks_of(layout, chunk, plain=plain)
    name = source or (Path(model).name if isinstance(model, str | PathLike) else "a model")
    sink, splats = LevelsFolder(Path(folder), overwrite, name, chunks, suffix), as_splats(model)
    stages = write_levels_stages(
        _parameters(options), len(splats), ratios, layout, suffix, measured=measured
    )
    reports: list[SimplifyReport] = []
    with drawn(progress) as tell:
        tracker = Tracker(tell, stages)
        made = judged_levels(splats, ratios, judged=measured, progress=tracker.passing(), **options)
        judge = LevelJudge()
        if measured:
            judge = level_judge(splats, suffix, frame, options.get("threads"), tracker)
        with sink.filled() as filling:
            for small, report in made:
                tracker.begin("write")
                filling.add(change_frame(small, *frame) if frame else small, tracker.part)
                reports.append(report)
                del small  # or it would be kept while the next one is made
            manifest = filling.finish(reports, judge)
        tracker.finish()
        return manifest, tuple(reports)


def write_levels_stages(
    parameters: Parameters,
    splats: int,
    ratios: Sequence[float],
    layout: Layout | str,
    suffix: str = PLY,
    *,
    measured: bool = False,
) -> list[Stage]:
    """The stages of `write_levels`: those of `levels`, and a "write" after each level.

    Where levels are measured, "measure" comes first, and the rest of it belongs to the writing.
    """
    measure = [measure_stage(splats)] if measured else []
    counts = [target_count(splats, ratio, None) for ratio in ratios]
    stages = levels_stages(parameters, splats, counts)
    ending = ".sog" if layout == Layout.SOG else suffix
    writes = [Stage("write", write_weight(ending, count)) for count in counts]
    first = len(stages) - len(counts)
    pairs = zip(stages[first:], writes, strict=True)
    return [*measure, *stages[:first], *(stage for pair in pairs for stage in pair)]


def _parameters(options: dict[str, Any]) -> Parameters:
    """The parameters of the method among the options of `levels`."""
    overrides = {name: value for name, value in options.items() if name not in _NO_PARAMETERS}
    return parameters(options.get("preset", DEFAULT_PRESET), overrides)


def write_levels_in_blocks(
    inputs: Sequence[Path],
    folder: Path,
    ratios: Sequence[float],
    *,
    layout: Layout = Layout.FILES,
    chunk: int | None = None,
    plain: bool = False,
    suffix: str = PLY,
    overwrite: bool = False,
    where: "Where",
    progress: Progress | None = None,
    **options: Any,  # noqa: ANN401 - as `simplify_into` takes them
) -> tuple[Manifest, tuple[SimplifyReport, ...]]:
    """Make the levels from one forest of each block; all of the folder appears or nothing.

    Inputs, the parts of one scene, and options are as `simplify_into` takes them, and all else as
    `write_levels` does. In chunks, each block has a tree of its own, and what describes the folder
    joins them.

    Returns:
        What the manifest says, and the report of each level.

    Raises:
        NanogsError: As for `simplify_blocks`, or the folder may not be replaced.
    """
    check_ratios(ratios)
    source, goals = ", ".join(part.name for part in inputs), [Goal(ratio=each) for each in ratios]
    chunks = chunks_of(layout, chunk, plain=plain)
    sink = LevelsFolder(folder, overwrite, source, chunks, suffix)
    written, reports = simplify_into(sink, inputs, goals, where, progress, **options)
    return describe_levels(source, reports, written), tuple(reports)
