"""`nanogs simplify` of each file: plan it, and simplify it."""

import time
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from nanogs.ahead import compile_ahead
from nanogs.cli.console import warn, with_file_seconds
from nanogs.cli.framing import Frames, frames_of
from nanogs.cli.importing import uncollected
from nanogs.cli.reading import Reading, inspect_parts, read_parts
from nanogs.cli.simplify_report import Plan, plan_json, print_plan, print_wish
from nanogs.cli.too_large import Blocks, refuse_whole_model_wishes
from nanogs.clock import StageClock
from nanogs.errors import FormatError, ModelError, OptionError
from nanogs.frames import change_frame
from nanogs.io import bytes_on_disk, check_writable, losses, registry, save
from nanogs.io.collect import Pair
from nanogs.kernels.compiling import when_compiling
from nanogs.pipeline.api import refuse_searches, target_of
from nanogs.pipeline.api import simplify as library_simplify
from nanogs.pipeline.asked import asked_views
from nanogs.pipeline.cameras import requested_cameras
from nanogs.pipeline.job import import_stages, usable_rows
from nanogs.pipeline.presets import Parameters, renders
from nanogs.pipeline.rows import Changes
from nanogs.pipeline.target import Goal
from nanogs.pipeline.weights import measure_stage, write_weight
from nanogs.progress import Progress, Stage, Tracker
from nanogs.protocol import Judged
from nanogs.splats import Splats


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """The wishes for every file, checked.

    Attributes:
        goal: The wish.
        preset: Name of the preset.
        chosen: Parameters of the method.
        reading: What is done to the model first.
        saving: What `save` takes.
        frames: From and to where the result is turned, as given, or None.
        cameras: As `requested_cameras` takes it.
        up: Up direction of automatic views, or None.
        given: What the library's `simplify` takes beside.
        json: Whether a plan is said as JSON alone.
        quiet: Whether nothing is said on the way but errors.
        folder_later: Whether the folder of the results is still to be made.
        blocks: How a model is treated that does not fit into memory.
        measure: Whether the result is held against the input as `nanogs compare` does it; None for
            where the preset renders anyway.
    """

    goal: Goal
    preset: str
    chosen: Parameters
    reading: Reading
    saving: dict[str, Any]
    frames: Frames | None
    cameras: str
    up: tuple[float, float, float] | None
    given: dict[str, Any]
    json: bool
    quiet: bool
    folder_later: bool
    blocks: Blocks
    measure: bool | None

    @property
    def measured(self) -> bool:
        """Whether the result is held against the input."""
        return renders(self.chosen) if self.measure is None else self.measure

    def changes(self, pair: Pair) -> Changes:
        """Changes to a model in blocks besides making it smaller."""
        frames = frames_of(pair, self.frames)
        asked = asked_views(self.cameras, self.up)
        return Changes(self.reading.filters, self.reading.sh_degree, frames, asked)


def plan_one(request: Request, pair: Pair, _progress: Progress) -> dict[str, Any]:
    """Say what would be done with a file; the plan.

    Raises:
        NanogsError: It cannot be done.
    """
    plan, divided = _plan(pair, request, dry_run=True), None
    if plan.divided:
        from nanogs.cli.in_blocks import plan_of, plan_rows, warn_of_blocks

        warn_of_blocks(plan, request.blocks, pair.target, quiet=request.quiet)
        changes = request.changes(pair)
        divided = plan_of(pair, plan, request.blocks, request.given["nan"], changes)
        plan = replace(plan, info=replace(plan.info, splats=divided.splats))
        plan = replace(plan, count=plan.goal.target(divided.splats, lambda _count: 0))
        if not request.json:
            print_wish(plan)
            plan_rows(divided)
    elif not request.json:
        for note in request.blocks.unused():
            warn(note)
        print_plan(plan)
    return plan_json(plan) | {"blocks": asdict(divided) if divided else None}


def run_one(request: Request, pair: Pair, progress: Progress) -> dict[str, Any]:
    """Simplify a file; the report.

    Raises:
        NanogsError: It cannot be done.
    """
    plan = _plan(pair, request, dry_run=False)
    if plan.divided:
        from nanogs.cli.in_blocks import simplify_in_blocks, warn_of_blocks

        warn_of_blocks(plan, request.blocks, pair.target, quiet=request.quiet)
        given = request.given | request.saving
        changes = request.changes(pair)
        return simplify_in_blocks(pair, plan, request.blocks, changes, given, progress)
    return _simplify_file(plan, pair, request, progress)


def _plan(pair: Pair, request: Request, *, dry_run: bool) -> Plan:
    """Check the files and the goal; the count that it comes to, where that is known yet."""
    goal, reading = request.goal, request.reading
    refuse_searches(goal, request.preset, pair.target)
    frames = frames_of(pair, request.frames)
    if frames and goal.size is not None and not registry.has_known_size(pair.target):
        raise OptionError(
            f"--frame changes the size of a {pair.target.suffix} file that --size has found; turn"
            " it with `nanogs convert` before."
        )
    blocks = request.blocks
    info = inspect_parts(blocks.sources(pair))
    begun = blocks.is_begun(pair.target, overwrite=request.saving["overwrite"])
    if not (dry_run and request.folder_later) and not begun:
        check_writable(pair.target, **request.saving)
    plan = Plan(
        info, goal, None, request.preset, request.chosen, measured=request.measured,
        joined=blocks.joined,
    )  # fmt: skip
    if blocks.needed(plan, pair.target):
        plan = replace(plan, divided=True)
        refuse_whole_model_wishes(
            plan, blocks, filters=reading.filters,
            measured=bool(request.measure),
        )  # fmt: skip
    else:
        blocks.refuse_fitting(pair.target)
    if goal.size is None and not (reading.filters and dry_run):
        count = goal.target(info.splats, lambda _count: 0)
    elif (
        dry_run and not plan.divided
    ):  # what a row takes and what filters leave is only known from the columns
        splats = reading.prepare(read_parts(blocks.sources(pair))).splats
        plan = replace(plan, info=replace(info, splats=len(splats)))
        usable = usable_rows(splats, request.given["nan"])
        count = target_of(goal, splats, len(usable), pair.target)
    else:
        count = None
    return replace(plan, count=count)


def _simplify_file(plan: Plan, pair: Pair, request: Request, told: Progress) -> dict[str, Any]:
    """Read, simplify and write; the report with the files' names and the seconds of I/O."""
    start, clock, goal = time.perf_counter(), StageClock(), plan.goal
    target, saving = pair.target, request.saving
    known = registry.find(target)
    with uncollected():
        import_stages(plan.parameters)
    if renders(plan.parameters) or request.measured:
        when_compiling(compile_ahead)
    progress = Tracker(told, _stages(plan, request, target))
    prepared = request.reading.load(request.blocks.sources(pair), progress, clock)
    splats = prepared.splats
    small, report = library_simplify(
        splats,
        ratio=goal.ratio,
        count=goal.count,
        size=goal.size,
        psnr=goal.psnr,
        format=known.suffix if known else target.suffix,
        format_options=saving["format_options"],
        cameras=requested_cameras(splats, request.cameras, request.up, request.chosen),
        max_memory=request.blocks.max_memory,
        progress=progress.passing(),
        **request.given,
    )
    if frames := frames_of(pair, request.frames):
        small = change_frame(small, *frames)
    progress.begin("write")
    with clock.time("write"):
        save(small, target, progress=progress.passing(), **saving)
    judged, unmeasured = report.judged, tuple[str, ...]()
    if request.measured and judged is None:
        progress.begin("measure")
        with clock.time("measure"):
            judged, unmeasured = _judge(splats, pair, request, progress)
    progress.finish()
    run = with_file_seconds(report.to_dict(), clock, start)
    run["judged"] = judged and asdict(judged)
    run["notes"] = [
        *request.blocks.unused(),
        *run["notes"],
        *prepared.notes,
        *losses(small, target),
        *unmeasured,
    ]
    run |= {"read_count": plan.info.splats, "filters": [asdict(report) for report in prepared.took]}
    run["frames"] = frames
    run |= {"input": plan.name, "output": str(target)}
    run |= {"input_bytes": plan.info.file_bytes, "output_bytes": bytes_on_disk(target)}
    return run


def _judge(
    splats: Splats, pair: Pair, request: Request, progress: Tracker
) -> tuple[Judged | None, tuple[str, ...]]:
    """The numbers that `nanogs compare` gives the file, or why nothing can be measured."""
    from nanogs.scoring.held_out import judge_file

    known = registry.find(pair.target)
    if known is not None and not known.readable:
        return None, (f"The result was not measured: nanogs does not read {known.suffix} files.",)
    frames = frames_of(pair, request.frames)
    try:
        judged = judge_file(
            splats,
            pair.target,
            back=partial(change_frame, source=frames[1], target=frames[0]) if frames else None,
            threads=request.given["threads"],
            tell=progress.part,
        )
    except (ModelError, FormatError) as error:
        return None, (f"The result was not measured: {error}",)
    return judged, ()


def _stages(plan: Plan, request: Request, target: Path) -> list[Stage]:
    """The stages to come: reading, filters, the method's own ones, writing."""
    from nanogs.pipeline.stages import simplify_stages

    splats, suffix = plan.info.splats, target.suffix
    method = simplify_stages(plan.parameters, plan.goal, splats, plan.count, suffix)
    write = Stage("write", write_weight(suffix, plan.count or splats // 10))
    measure = [measure_stage(splats)] if request.measured and plan.goal.psnr is None else []
    return [*request.reading.stages(splats), *method, write, *measure]
