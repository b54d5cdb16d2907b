"""`nanogs.simplify_blocks`: simplify model files into one file, in memory or in blocks."""

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nanogs.bar import show_progress
from nanogs.card.device import CPU, device_notes
from nanogs.clock import StageClock
from nanogs.defaults import PATIENCE
from nanogs.frames import checked_frames
from nanogs.io import bytes_on_disk, check_writable, losses, registry, write_model
from nanogs.io import open as open_model
from nanogs.io.collect import as_parts
from nanogs.io.frames import (
    keep_stated_frame,
    refuse_frame_read,
    refuse_frame_written,
    refuse_mixed_frames,
)
from nanogs.io.limits import degree_left_out
from nanogs.io.url_files import local_copies
from nanogs.io.urls import as_path, local_path, path_text
from nanogs.pipeline.api import simplify
from nanogs.pipeline.estimates.stage_weights import measure_stage, write_weight
from nanogs.pipeline.in_blocks import fill_in_blocks
from nanogs.pipeline.in_memory import NanPolicy, import_stages
from nanogs.pipeline.options.presets import DEFAULT_PRESET, parameters, renders
from nanogs.pipeline.options.target import Goal, chooses_packing
from nanogs.pipeline.reading import open_parts, read_changed, reading_stages
from nanogs.pipeline.request import Request, RequestPlan, plan_files
from nanogs.progress import Progress, Stage, Tracker
from nanogs.quantities import as_bytes
from nanogs.report import SimplifyReport
from nanogs.scoring.file_judge import file_costs, file_judge
from nanogs.sink import OneFile
from nanogs.source import joined_layout
from nanogs.splats import Splats
from nanogs.store.columns import no_splats
from nanogs.threads import use_threads

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from distributed import Client

    from nanogs.filters import Filter
    from nanogs.io.format import FormatOptions
    from nanogs.views.cameras import Cameras


def simplify_blocks(
    inputs: str | PathLike[str] | Sequence[str | PathLike[str]],
    output: str | PathLike[str],
    *,
    ratio: float | None = None,
    count: int | None = None,
    size: int | str | None = None,
    psnr: float | None = None,
    draw_cost: float | None = None,
    measured: bool | None = False,
    preset: str = DEFAULT_PRESET,
    max_memory: int | str | None = None,
    block: int | None = None,
    job: str | PathLike[str] | None = None,
    scratch: str | PathLike[str] | None = None,
    resume: bool = False,
    overwrite: bool = False,
    nan: NanPolicy = "drop",
    filters: "Sequence[Filter]" = (),
    sh_degree: int | None = None,
    frame: tuple[str, str] | None = None,
    render_mode: str | None = None,
    cameras: "Cameras | None" = None,
    up: Sequence[float] | None = None,
    device: str | None = None,
    threads: int | None = None,
    executor: "Client | Executor | None" = None,
    patience: float = PATIENCE,
    format_options: "FormatOptions | None" = None,
    progress: Progress | bool | None = None,
    **overrides: Any,  # noqa: ANN401 - checked against the preset's parameters
) -> SimplifyReport:
    """Simplify files of any size: in memory if that is enough, otherwise block by block.

    Blocks take bounded memory, in this process or in workers. Each block is rendered, cut and
    fitted as a whole model is, surrounded by a coarse level of all others, on views of the whole
    scene. The result does not depend on where, in how many processes or in how many runs it was
    made; it does depend on the size of the blocks.

    Args:
        inputs: A file, or several that are parts of one scene, of which one that is given twice is
            taken once, with a note; or their URLs, which are downloaded first, so that such a job
            cannot be resumed.
        output: The file to write, or a URL to send it to; see `nanogs.save`. Files of .ply,
            .compressed.ply, .splat, .npz, .spz, .rad, .glb and .gltf are written block by block;
            for others the whole result is held in memory.
        ratio: Compaction ratio in (0, 1]; exactly one of the five is given.
        count: Number of splats to deliver.
        size: As `simplify` takes it.
        psnr: As `simplify` takes it.
        draw_cost: As `simplify` takes it.
        measured: Whether to compare the file with the model, as `nanogs compare` does. None does so
            if the preset renders anyway and the model is in memory.
        preset: Name of a preset; in blocks one that grows a forest: any but `paper`.
        max_memory: Bytes that each process may take, a number or text like "4GB"; it decides
            whether there are blocks, and their size. By default nine tenths of the free memory;
            4 GB with an executor. A job that is resumed keeps its blocks.
        block: Number of splats of a block, instead of a size that follows from `max_memory`. If
            `block`, `job`, `scratch` or `executor` is given, the model is simplified in blocks,
            perhaps a single one.
        job: Folder for the files that have to survive a crash; by default, for a model in blocks,
            the output's name with `.job`. It is removed when the run succeeds.
        scratch: Folder or URL of the intermediate files, which all workers must see; by default in
            the job folder.
        resume: Continue the job in that folder, or begin it if there is none.
        overwrite: Replace the output if it exists.
        nan: As `simplify` takes it.
        filters: Filters that leave out splats first, such as `[nanogs.filters.box(low, high)]`; the
            inputs are read once more for them. In blocks, one that needs the whole model is
            refused.
        sh_degree: As `simplify` takes it.
        frame: Source and target frame to turn the result from and to, such as ("rdf", "rub").
        render_mode: "default" or "mip" in place of the render mode that the inputs name; see
            `nanogs.open`.
        cameras: Views that matter, for presets that render: "auto", "orbit", "inside", "roam", a
            file or folder of cameras, or cameras; by default automatic.
        up: Up direction for views that are found, in scene coordinates.
        device: As `simplify` takes it; blocks are always computed on the CPU.
        threads: Number of threads of each process; all of its machine by default.
        executor: Executor that runs the tasks: a Dask client, or a `concurrent.futures.Executor`
            such as a ProcessPoolExecutor. It is not closed.
        patience: Seconds to wait while a Dask cluster has no workers, before the run ends.
        format_options: Options of the output's format, as `save` takes them.
        progress: True for a bar, in a notebook or on a terminal, or a function that is called with
            each `nanogs.progress.Step`, whose parts are tasks; the stage is "wait" while a cluster
            has no worker.
        **overrides: Parameters of the preset to replace.

    Returns:
        The report; its `blocks` say how the work was divided, if it was.

    Raises:
        NanogsError: The inputs or options are invalid, the output cannot be written, or workers
            were lost. The job folder is then kept for `resume`, unless nothing was begun.
    """
    frame = checked_frames(frame)
    parameters(preset, overrides)  # first, so that a misspelt target is named
    parts, notes = as_parts(inputs)
    request = Request(
        inputs=parts, output=as_path(output),
        goal=Goal(ratio, count, None if size is None else as_bytes(size), psnr, draw_cost),
        preset=preset, overrides=overrides, measured=measured,
        max_memory=None if max_memory is None else as_bytes(max_memory), block=block,
        job=None if job is None else local_path(path_text("job", job)),
        scratch=None if scratch is None else path_text("scratch", scratch), resume=resume,
        overwrite=overwrite, nan=nan, filters=filters, sh_degree=sh_degree, frame=frame,
        render_mode=render_mode, cameras=cameras, up=up, device=device, threads=threads,
        executor=executor, patience=patience,
        format_options=registry.add_target_frame(as_path(output), format_options, frame),
        notes=notes,
    )  # fmt: skip
    request.check_addresses()
    target = request.output
    with (
        show_progress(progress) as on_step,
        local_copies(parts, target, overwrite=overwrite) as (here, there),
    ):
        real = replace(request, inputs=tuple(here), output=there or target)
        return simplify_files(real, on_step)


def simplify_files(request: Request, on_step: Progress | None) -> SimplifyReport:
    """Carry out a request whose paths are local files, in memory or in blocks.

    Args:
        request: All arguments of the call.
        on_step: Progress callback, called with each step.

    Raises:
        NanogsError: The request cannot be carried out.
    """
    request.check()
    if request.frame is not None:
        refuse_frame_written(request.frame, request.output)
    plan = plan_files(request)
    options, notes = checked_options(request, divided=plan.divided)
    request = replace(request, format_options=options)
    request, left_out = limit_degree(request, plan.sh_degree)
    notes = (*notes, *left_out, *request.notes)
    if plan.divided:
        request.refuse_device_in_blocks()
        notes = (*notes, *device_notes(request.device, CPU))
    carry_out = _in_blocks if plan.divided else _in_memory
    report = carry_out(request, plan, on_step)
    return replace(report, notes=tuple(dict.fromkeys((*report.notes, *notes))))


def limit_degree(request: Request, degree: int) -> tuple[Request, tuple[str, ...]]:
    """Lower the degree of the result's harmonics to the highest that the format can store.

    The result is then fitted at this degree, which makes up for the harmonics left out. A search
    that chooses the degree itself does so without this: its choice remains free, and it reports
    what is left out.

    Args:
        request: All arguments of the call.
        degree: Degree of the model's harmonics.

    Returns:
        The request, and a note if its degree was lowered.
    """
    known, goal = request.written_format, request.goal
    most = known.max_degree
    if request.sh_degree is not None or degree <= most or not renders(request.parameters):
        return request, ()
    searched = goal.size is not None and request.searches(degree)
    if searched or chooses_packing(goal, known):
        return request, ()
    return replace(request, sh_degree=most), (degree_left_out(known.suffix, most),)


def checked_options(
    request: Request, *, divided: bool
) -> tuple["FormatOptions | None", tuple[str, ...]]:
    """Check that the output can hold what the inputs have, and return format options and notes.

    These store the frame that the inputs state; see `keep_stated_frame`.

    Args:
        request: All arguments of the call.
        divided: Whether the model is processed in blocks, which leave further elements out.

    Raises:
        FormatError: An input cannot be read.
        ModelError: The inputs are in different frames.
        OptionError: The model is to be turned from or to another frame than its files have, or the
            format options do not allow the elements of the input.
        OutputError: The output cannot hold a column of the inputs.
    """
    with ExitStack() as stack:
        opened = open_parts(request.inputs, request.render_mode)
        files = [stack.enter_context(file) for file in opened]
        known = request.written_format
        known.check_columns(joined_layout(files))
        if len(files) == 1 and not divided:
            elements = [name for name, _ in files[0].elements]
            known.check_elements(elements, request.format_options or {})
        guessed = refuse_mixed_frames(files, request.frame[0] if request.frame else "")
        if request.frame is not None:
            refuse_frame_read(request.frame, files)
            return request.format_options, guessed
        options, notes = keep_stated_frame(request.file, request.format_options, files)
        return options, (*guessed, *notes)


def _in_blocks(request: Request, plan: RequestPlan, on_step: Progress | None) -> SimplifyReport:
    """Simplify and write, block by block."""
    sink = OneFile(request.output, request.overwrite, request.format_options)
    with use_threads(request.threads):  # limits the threads of planning, too
        [written], [report] = fill_in_blocks(request, sink, on_step)
    report = replace(report, notes=(*report.notes, *written.losses))
    if request.goal.size is None:
        return report
    report = replace(report, achieved_size=bytes_on_disk(request.output))
    from nanogs.pipeline.size_ending import with_size_ending

    counts = report.achieved_count, report.input_count - report.dropped_nonfinite
    return with_size_ending(
        report, request.goal.size, request.sizer, counts,
        lambda: _written_columns(request.output), degree=plan.sh_degree,
    )  # fmt: skip


def _written_columns(output: Path) -> Splats:
    """Return no splats, with the columns of a file."""
    with open_model(output) as file:
        return no_splats(file.columns)


def _in_memory(request: Request, plan: RequestPlan, on_step: Progress | None) -> SimplifyReport:
    """Read, simplify and write; the report has the seconds of the whole call."""
    start = time.perf_counter()
    check_writable(
        request.output, overwrite=request.overwrite, format_options=request.format_options
    )
    import_stages(request.parameters)
    with use_threads(request.threads):  # limits reading and writing, too
        report = _from_file_to_file(request, plan, on_step)
    return replace(report, total_seconds=time.perf_counter() - start)


def _from_file_to_file(
    request: Request, plan: RequestPlan, on_step: Progress | None
) -> SimplifyReport:
    """Read the model, simplify it, write the result and measure its file."""
    clock, goal = StageClock(), request.goal
    output, options = request.output, request.format_options
    tracker = Tracker(on_step, _stages(request, plan))
    splats, filtered, notes = read_changed(request.inputs, request.edits, tracker, clock)
    small, report = simplify(
        splats, ratio=goal.ratio, count=goal.count, size=goal.size, psnr=goal.psnr,
        draw_cost=goal.draw_cost,
        format=request.suffix, preset=request.preset, sh_degree=request.sh_degree,
        frame=request.frame, nan=request.nan, device=request.device, threads=request.threads,
        cameras=request.cameras, up=request.up, max_memory=request.max_memory,
        progress=tracker.passing(), format_options=options, **request.overrides,
    )  # fmt: skip
    report = replace(report, notes=(*report.notes, *notes))
    options = {**(options or {}), **report.format_options}
    tracker.begin("write")
    with clock.time("write"):
        write_model(
            small, output, overwrite=request.overwrite, format_options=options,
            progress=tracker.passing(),
        )  # fmt: skip
    report = _with_scores(report, request, splats, small, tracker, clock)
    tracker.finish()
    return replace(
        report,
        notes=tuple(dict.fromkeys((*report.notes, *losses(small, output)))),
        read_count=plan.splats,
        filters=filtered,
        seconds=_around(clock, report.seconds),
    )


def _with_scores(
    report: SimplifyReport,
    request: Request,
    original: Splats,
    small: Splats,
    tracker: Tracker,
    clock: StageClock,
) -> SimplifyReport:
    """Measure the result's file as far as that is asked for and no search has done so."""
    output, turn, threads = request.output, request.frame, request.threads
    if request.is_compared and report.judged is None:
        tracker.begin("measure")
        with clock.time("measure"):
            judge = file_judge(
                original, request.suffix, turn=turn, threads=threads, on_progress=tracker.part
            )
            judged, packed = judge.beside(output, small)
        notes = (*report.notes, *judge.notes)
        report = replace(report, judged=judged, packed=packed, notes=notes)
    if request.measured and report.cost is None:
        with clock.time("measure"):
            costs = file_costs(original, output, turn, threads)
        if costs:
            report = replace(report, cost=costs[0], original_cost=costs[1])
    return report


def _stages(request: Request, plan: RequestPlan) -> list[Stage]:
    """List the stages of the call: reading, filters, those of the method, writing, measuring."""
    from nanogs.pipeline.estimates.durations import simplify_stages

    splats, suffix, goal = plan.splats, request.suffix, request.goal
    count = goal.known_count(splats)
    if goal.size is not None and not request.searches(plan.sh_degree):
        count = max(splats // 10, 1)  # a guess: the size gives the count once the model is read
    stages = reading_stages(request.edits, splats)
    stages += simplify_stages(request.parameters, goal, splats, count, request.written_format)
    stages.append(Stage("write", write_weight(suffix, count or splats // 10)))
    return [*stages, measure_stage(splats)] if request.is_compared and not goal.psnr else stages


def _around(clock: StageClock, inner: dict[str, float]) -> dict[str, float]:
    """Order the seconds: reading and filtering, then the method (`inner`), then the rest."""
    before = {name: value for name, value in clock.seconds.items() if name in ("read", "filter")}
    total = StageClock(before | inner)
    total.add({name: value for name, value in clock.seconds.items() if name not in before})
    return total.seconds
