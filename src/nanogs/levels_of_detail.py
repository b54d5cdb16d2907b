"""`nanogs.write_levels`: write levels of detail of a model into a folder, with a manifest.

`pipeline`, which makes levels, and `lod`, which lays them out, do not import each other; this
module and `environments` connect them.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from os import PathLike
from typing import Any

from nanogs._types import F64
from nanogs.bar import show_progress
from nanogs.card.device import CPU, device_notes
from nanogs.clock import StageClock
from nanogs.environments import AUTO, NOTHING, EnvironmentRequest, surroundings, without_environment
from nanogs.errors import OptionError
from nanogs.frames import turned
from nanogs.io import inspect, registry
from nanogs.io.collect import as_parts
from nanogs.io.frames import refuse_frame_written
from nanogs.io.models import Model, as_splats
from nanogs.io.retag import in_mode
from nanogs.io.url_files import refuse_address
from nanogs.io.urls import local_path, path_text
from nanogs.lod.archive import LevelsArchive
from nanogs.lod.chunks import ChunkLayout
from nanogs.lod.folder import PLY, LevelsFolder
from nanogs.lod.layout import LodLayout, block_layout_of, refuse_misnamed
from nanogs.lod.manifest import Manifest, describe_levels
from nanogs.lod.tree_file import LevelsTree
from nanogs.lod.usual import default_ratios
from nanogs.pipeline.checks import refuse_device
from nanogs.pipeline.estimates.durations import levels_stages
from nanogs.pipeline.estimates.stage_weights import measure_stage, write_weight
from nanogs.pipeline.files import checked_options, limit_degree
from nanogs.pipeline.in_blocks import fill_in_blocks
from nanogs.pipeline.in_memory import import_stages
from nanogs.pipeline.levels import checked_ratios, requested_levels
from nanogs.pipeline.options.target import Goal, target_count
from nanogs.pipeline.reading import ChangedModel, changed, read_changed, reading_stages
from nanogs.pipeline.request import Request, RequestPlan, plan_files
from nanogs.place import Place
from nanogs.progress import Progress, Stage, Tracker
from nanogs.quantities import as_bytes
from nanogs.ranges import as_switch
from nanogs.report import SimplifyReport
from nanogs.scoring.file_judge import file_judge
from nanogs.sink import Environment
from nanogs.source import InMemory, Joined, Source
from nanogs.splats import Splats
from nanogs.threads import use_threads

# Options for files alone, and all that are handed on to the request.
_OF_JOBS = ("block", "executor", "job", "resume", "scratch")
_OPTIONS = frozenset({
    *_OF_JOBS, "cameras", "device", "filters", "format_options", "max_memory", "nan", "patience",
    "preset", "render_mode", "sh_degree", "threads", "up",
})  # fmt: skip


def write_levels(
    model: Model | Sequence[str | PathLike[str]],
    folder: str | PathLike[str],
    ratios: Iterable[float] | None = None,
    *,
    source: str | None = None,
    layout: LodLayout | str = LodLayout.FILES,
    chunk: int | None = None,
    chunk_min: int | None = None,
    plain: bool = False,
    place: Place | Sequence[Sequence[float]] | F64 | None = None,
    suffix: str = PLY,
    frame: tuple[str, str] | None = None,
    overwrite: bool = False,
    measured: bool | None = False,
    environment: str | PathLike[str] | Splats | Source = AUTO,
    environment_ratio: float | None = None,
    progress: Progress | bool | None = None,
    **options: Any,  # noqa: ANN401 - as `levels` or `simplify_blocks` takes them
) -> tuple[Manifest, tuple[SimplifyReport, ...]]:
    """Write levels of detail of a model; the folder appears complete or not at all.

    Files may be of any size: a model that does not fit into memory is processed in blocks. With a
    layout of chunks, each block then has a tree of its own, and the manifest joins them.

    Args:
        model: The model, a source of it, a path, or paths of the parts of one scene; one that is
            given twice is taken once, with a note.
        folder: The folder to make.
        ratios: Share of the splats to keep in each level, as for `levels`; by default 1,
            1/2, 1/4 and so on, see `lod.usual.default_ratios`.
        source: Name of the model in the manifest; by default that of its files.
        layout: "files", one for each level; "streamed sog" or "3d tiles"; or "streamed sog archive"
            or "spark tree", for which `folder` is the `.ssog` or `.rad` file to make.
        chunk: Most splats of the finest level in a chunk, for a layout with chunks; 32,768 by
            default.
        chunk_min: Fewest splats of such a chunk, and of a file of streamed SOG, unless a level has
            fewer; 8,192 by default, or a quarter of `chunk`.
        plain: Store the contents of 3D Tiles uncompressed, every number unchanged; by default they
            are compressed by SPZ.
        place: Position on Earth of 3D Tiles: a `nanogs.Place`, or a (4, 4) transform from their
            frame, z up, to Earth-centred, Earth-fixed coordinates, with the translation in its last
            column; scene units are metres there. By default the scene has no position.
        suffix: Format of the levels for the layout "files", with or without its dot.
        frame: Coordinate frames from and to which the levels are turned before they are written.
        overwrite: Replace the folder if it holds nothing but earlier levels.
        measured: Compare the written files of each level with the model, as `nanogs compare` does.
            With None that is done if the preset renders and the model is in memory.
        environment: Splats that streamed SOG stores beside the levels and draws with each of them,
            such as the sky: "auto" takes them out of the model if they are clearly separate
            (`lod.environment`), "none" leaves all splats in the levels, and a path or a model, in
            the model's frame, is written in addition.
        environment_ratio: Share of the environment's splats to keep, in (0, 1]; all by default.
        progress: Progress reporting as for `levels`; a stage "write" follows each level.
        **options: Options of `simplify_blocks`, such as `preset`, `max_memory` and `filters`;
            `block`, `job`, `scratch`, `resume` and `executor` need the model as files, and
            `format_options` the layout "files".

    Returns:
        The contents of the manifest, and the report of each level.

    Raises:
        OptionError: See `levels`; or there is no such layout, the name of the output does not fit
            it, the layout does not have chunks, contents, a place, an environment, a suffix or
            format options to choose, the place is invalid, or the format of the files cannot be
            written or has no such option.
        ModelError: See `levels`; or the environment has another render mode than the model.
        OutputError: The folder may not be replaced, or it cannot be written.
    """
    files, notes = ((), ()) if isinstance(model, Splats | Source) else as_parts(model)
    for path in files:
        refuse_address(path, "give the source that nanogs.open returns for it")
    held = model if isinstance(model, Splats | Source) else files
    ratios = usual_levels(held, layout) if ratios is None else checked_ratios(ratios)
    given, overrides = _parsed(options)
    plain = as_switch("`plain`", plain)
    registry.file_of(suffix)  # raises if it is not a format
    if not isinstance(source, str | None):
        raise OptionError(f"`source` is the name of the model, not {source!r}.")
    request = Request(
        inputs=files, output=local_path(folder), goal=Goal(ratio=ratios[0]), ratios=ratios,
        block_layout=block_layout_of(layout, chunk, chunk_min, plain=plain, place=place),
        level_suffix=registry.suffix_of(suffix), overwrite=overwrite, measured=measured,
        frame=frame, overrides=overrides, notes=notes, **given,
    )  # fmt: skip
    _refuse_suffix(request, layout)
    request.refuse_unused_views()
    sink = sink_of(request, source=source, layout=layout)
    refuse_misnamed(request.output, LodLayout(layout))
    sky = surroundings(environment, environment_ratio, layout)
    with show_progress(progress) as on_step:
        if not isinstance(model, Splats | Source):
            return write_levels_of_files(request, sink, on_step, sky)
        if for_files := [name for name in _OF_JOBS if given.get(name)]:
            raise OptionError(f"{for_files[0]} is for files; give the model's path in its place.")
        return _write_held(request, model, sink, on_step, sky)


def _parsed(options: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Parse the options of `write_levels`; return those of a request, and parameters to replace."""
    parse: dict[str, Callable[[Any], Any]] = {
        "max_memory": as_bytes,
        "job": lambda given: local_path(path_text("job", given)),
        "scratch": partial(path_text, "scratch"),
    }  # fmt: skip
    given = {k: parse[k](v) if k in parse and v is not None else v for k, v in options.items()}
    overrides = {key: given.pop(key) for key in given.keys() - _OPTIONS}
    return given, overrides


def _refuse_suffix(request: Request, layout: LodLayout | str) -> None:
    """Refuse a format of levels for a layout that has one of its own."""
    if request.block_layout and request.level_suffix not in (PLY, request.block_layout.suffix):
        raise OptionError(
            f'The layout "{LodLayout(layout)}" has a format of its own; leave out `suffix`, or'
            f' write the layout "{LodLayout.FILES}".'
        )


LevelsSink = LevelsFolder | LevelsTree
"""A sink to which levels of detail can be written."""


def usual_levels(
    model: Splats | Source | Sequence[str | PathLike[str]], layout: LodLayout | str
) -> tuple[float, ...]:
    """Return the default ratios of the levels of a model; see `lod.usual.default_ratios`.

    Args:
        model: The model, a source of it, or paths of the parts of one scene.
        layout: Layout of the levels.

    Raises:
        FormatError: A path is no model.
        OptionError: The model has no splats.
    """
    if isinstance(model, Splats | Source):
        splats = len(model)
    else:
        splats = sum(inspect(path).splats for path in model)
    return default_ratios(splats, tree=layout == LodLayout.TREE)


def sink_of(
    request: Request,
    *,
    source: str | None = None,
    layout: LodLayout | str = LodLayout.FILES,
) -> LevelsSink:
    """Make the sink for the requested levels; see `write_levels` for the arguments.

    Raises:
        OptionError: The format of the files cannot be written, has no such options, or has a frame
            of its own that is not the requested one.
    """
    if request.format_options and layout != LodLayout.FILES:
        raise OptionError(
            f'The layout "{layout}" has no format options; leave out `format_options`, or write'
            f' the layout "{LodLayout.FILES}".'
        )
    name = source or ", ".join(path.name for path in request.inputs) or "a model"
    if layout == LodLayout.TREE:
        return LevelsTree(request.output, request.overwrite, name)
    chunked = request.block_layout if isinstance(request.block_layout, ChunkLayout) else None
    sink = LevelsArchive if layout == LodLayout.ARCHIVE else LevelsFolder
    options = request.format_options
    if request.frame is not None:
        refuse_frame_written(request.frame, request.file)
    if chunked is None:
        options = registry.add_target_frame(request.file, options, request.frame)
    return sink(request.output, request.overwrite, name, chunked, request.level_suffix, options)


def write_levels_of_files(
    request: Request, sink: LevelsSink, on_step: Progress | None, sky: EnvironmentRequest = NOTHING
) -> tuple[Manifest, tuple[SimplifyReport, ...]]:
    """Write the requested levels of files, in memory or in blocks.

    Args:
        request: The request.
        sink: Sink for the levels.
        on_step: Called with each progress step.
        sky: The requested environment.

    Raises:
        NanogsError: The levels cannot be made or written.
    """
    refuse_device(request.device, request.preset, request.parameters, request.goal)
    plan = plan_files(request)
    options, notes = checked_options(request, divided=plan.divided)
    notes = (*notes, *request.notes)
    if plan.divided:
        request.refuse_device_in_blocks()
        notes = (*notes, *device_notes(request.device, CPU))
    # If levels are turned, the sink already has the options that state the frame they get.
    if isinstance(sink, LevelsFolder) and sink.block_layout is None and request.frame is None:
        sink = replace(sink, format_options=options)
    if plan.divided:
        with use_threads(request.threads):  # limits the threads of planning too
            return _in_blocks(request, plan, sink, on_step, sky, notes)
    sink.check()
    import_stages(request.parameters)
    stages = _stages(request, plan.splats)
    tracker = Tracker(on_step, [*reading_stages(request.edits, plan.splats), *stages])
    with use_threads(request.threads):  # limits the threads of reading and writing too
        model = read_changed(request.inputs, request.edits, tracker, StageClock())
        model = model._replace(notes=(*model.notes, *notes))
        manifest, reports = _in_memory(request, model, sink, tracker.passing(), sky)
    tracker.finish()
    return manifest, tuple(replace(report, read_count=plan.splats) for report in reports)


def _write_held(
    request: Request,
    model: Splats | Source,
    sink: LevelsSink,
    on_step: Progress | None,
    sky: EnvironmentRequest,
) -> tuple[Manifest, tuple[SimplifyReport, ...]]:
    """Write the requested levels of a model that is given itself, not as files."""
    with use_threads(request.threads):  # limits the threads of filtering and writing too
        whole = in_mode(as_splats(model), request.edits.render_mode, "The model")
        known = request.written_format
        known.check_columns(InMemory(whole).columns)
        elements = [each.name for each in whole.elements]
        known.check_elements(elements, request.format_options or {})
        return _in_memory(request, changed(whole, request.edits), sink, on_step, sky)


def _in_blocks(
    request: Request,
    plan: RequestPlan,
    sink: LevelsSink,
    on_step: Progress | None,
    sky: EnvironmentRequest,
    notes: tuple[str, ...],
) -> tuple[Manifest, tuple[SimplifyReport, ...]]:
    request, left_out = limit_degree(request, plan.sh_degree)
    request, beside = sky.in_blocks(request)
    sink = _with(sink, beside)
    notes = (*left_out, *sky.notes(beside), *notes)
    written, made = fill_in_blocks(request, sink, on_step, notes)
    made = without_environment(made)
    return describe_levels(sink.source, made, written), tuple(made)


def _with(sink: LevelsSink, beside: Environment | None) -> LevelsSink:
    if beside is None:
        return sink
    assert isinstance(sink, LevelsFolder), "a tree has no environment"  # noqa: S101
    return replace(sink, environment=beside)


def _in_memory(
    request: Request,
    model: ChangedModel,
    sink: LevelsSink,
    on_step: Progress | None,
    sky: EnvironmentRequest,
) -> tuple[Manifest, tuple[SimplifyReport, ...]]:
    """Make and write the levels of a model in memory."""
    whole, filtered, notes = model
    request, left_out = limit_degree(request, whole.sh_degree)
    splats, beside = sky.in_memory(request, whole)
    notes = (*notes, *left_out, *sky.notes(beside))
    sink = _with(sink, beside)
    if beside is not None and not beside.own and request.is_compared:
        whole = Joined([InMemory(whole), InMemory(beside.original())]).load()
    elif not request.is_compared:
        whole = splats  # so that the splats of the environment are not held twice
    del model
    tracker = Tracker(on_step, _stages(request, len(splats)))
    made = requested_levels(splats, request, tracker.passing(), judged=request.is_compared)
    judge, reports = None, []
    if request.is_compared:
        tracker.begin("measure")
        turn, threads = request.frame, request.threads
        judge = file_judge(
            whole, sink.suffix, turn=turn, threads=threads, on_progress=tracker.part,
            costs=bool(request.measured),
        )  # fmt: skip
    with sink.filled() as filling:
        for small, report in made:
            tracker.begin("write")
            filling.add(turned(small, request.frame), tracker.part)
            # Notes on all levels are those of the first, so that the written manifest has them.
            own, notes = (*report.notes, *notes), ()
            reports.append(replace(report, filters=filtered, notes=own))
            del small  # frees it before the next level is made
        manifest = filling.finish(reports, judge)
    tracker.finish()
    scored = tuple(
        replace(report, **each.measured)
        for report, each in zip(reports, filling.written, strict=True)
    )
    return manifest, scored


def _stages(request: Request, splats: int) -> list[Stage]:
    """List the progress stages of `_in_memory`: those of `levels`, and a "write" after each level.

    If levels are measured, a stage "measure" comes first, in which the original is rendered; the
    time to measure the levels themselves counts as writing.
    """
    measure = [measure_stage(splats)] if request.is_compared else []
    counts = [target_count(splats, ratio, None) for ratio in request.ratios]
    stages = levels_stages(request.parameters, splats, counts, request.result_format)
    suffix = request.file.suffix
    writes = [Stage("write", write_weight(suffix, count)) for count in counts]
    first = len(stages) - len(counts)
    pairs = zip(stages[first:], writes, strict=True)
    return [*measure, *stages[:first], *(stage for pair in pairs for stage in pair)]
