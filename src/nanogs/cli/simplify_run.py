"""`nanogs simplify` of each file: plan it, and simplify it, whole or in blocks."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from nanogs.ahead import compile_ahead
from nanogs.cli.console import warn, with_file_seconds
from nanogs.cli.framing import frames_of
from nanogs.cli.importing import uncollected
from nanogs.cli.many import Run
from nanogs.cli.method import Method
from nanogs.cli.plan import Plan, plan_run, sees_to_output, show_plan
from nanogs.clock import StageClock
from nanogs.errors import OptionError
from nanogs.filters import FilterReport
from nanogs.formatting import counted
from nanogs.frames import change_frame
from nanogs.io import bytes_on_disk, check_writable, losses, registry, save
from nanogs.io.collect import Pair
from nanogs.kernels.compiling import when_compiling
from nanogs.pipeline.api import refuse_searches, simplify
from nanogs.pipeline.cameras import requested_cameras
from nanogs.pipeline.in_blocks import simplify_blocks
from nanogs.pipeline.job import import_stages
from nanogs.pipeline.presets import renders
from nanogs.pipeline.reading import read_changed, reading_stages
from nanogs.pipeline.rows import Changes
from nanogs.pipeline.target import Goal
from nanogs.pipeline.weights import measure_stage, write_weight
from nanogs.progress import Progress, Stage, Tracker
from nanogs.protocol import Protocol
from nanogs.report import SimplifyReport


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """The wishes for every file, checked.

    Attributes:
        goal: The wish.
        method: How it is met.
        changes: What else is done to models.
        joined: Inputs that are parts of one scene, or none.
        piped: Whether a model comes from stdin or goes to stdout.
        saving: What `save` takes.
        folder_later: Whether the folder of the results is still to be made.
    """

    goal: Goal
    method: Method
    changes: Changes
    joined: tuple[Path, ...]
    piped: bool
    saving: dict[str, Any]
    folder_later: bool


def run_one(request: Request, pair: Pair, progress: Progress) -> Run:
    """Simplify a file, or plan to; the report.

    Raises:
        NanogsError: It cannot be done.
    """
    plan, method = _plan(request, pair), request.method
    if plan.divided and not method.hushed:
        for note in plan.notes():
            warn(note)
    if method.dry_run:
        shown, goal = plan.shown(), plan.goal
        asked: dict[str, Any] = {"asked_ratio": goal.ratio, "asked_count": shown.count}
        asked |= {"asked_size": goal.size, "asked_psnr": goal.psnr}
        return Run(shown, {"input": plan.name} | asked)
    if plan.divided:
        return _in_blocks(plan, request.saving, progress)
    return _whole(plan, request.saving, progress)


def _plan(request: Request, pair: Pair) -> Plan:
    """Check the files and the goal, and plan."""
    goal, method, target = request.goal, request.method, pair.target
    refuse_searches(goal, method.preset, target)
    turn = frames_of(pair, method.edits.frame)
    if turn and goal.size is not None and not registry.has_known_size(target):
        raise OptionError(
            f"--frame changes the size of a {target.suffix} file that --size has found; turn"
            " it with `nanogs convert` before."
        )
    begun = sees_to_output(method, target, overwrite=request.saving["overwrite"])
    if not begun and not (method.dry_run and request.folder_later):
        check_writable(target, **request.saving)
    parts = request.joined or (pair.source,)
    return plan_run(
        parts, target, (goal,), method, replace(request.changes, frame=turn), piped=request.piped
    )


def _in_blocks(plan: Plan, saving: dict[str, Any], progress: Progress) -> Run:
    """Simplify a model that does not fit."""
    start, blocks, changes = time.perf_counter(), plan.method.blocks, plan.changes
    with plan.executor() as executor:
        report = simplify_blocks(
            plan.parts, plan.target, ratio=plan.goal.ratio, count=plan.goal.count,
            max_memory=plan.process_memory, job=blocks.job, scratch=blocks.scratch,
            resume=blocks.resume, filters=changes.filters, sh_degree=changes.sh_degree,
            frame=changes.frame, cameras=plan.method.cameras, up=plan.method.up,
            threads=plan.threads, executor=executor, patience=blocks.patience,
            progress=progress, **plan.method.given, **saving,
        )  # fmt: skip
    report = replace(report, total_seconds=time.perf_counter() - start)
    took = report.blocks.filters if report.blocks else ()
    return _run(plan, report, took)


def _whole(plan: Plan, saving: dict[str, Any], told: Progress) -> Run:
    """Read, simplify in memory, write and measure."""
    start, clock, goal, method = time.perf_counter(), StageClock(), plan.goal, plan.method
    target, known = plan.target, registry.find(plan.target)
    with uncollected():
        import_stages(method.chosen)
    if renders(method.chosen) or method.measured:
        when_compiling(compile_ahead)
    progress = Tracker(told, _stages(plan))
    prepared = read_changed(plan.parts, plan.changes, progress, clock)
    splats = prepared.splats
    small, report = simplify(
        splats,
        ratio=goal.ratio,
        count=goal.count,
        size=goal.size,
        psnr=goal.psnr,
        format=known.suffix if known else target.suffix,
        format_options=saving["format_options"],
        cameras=requested_cameras(splats, method.cameras, method.up, method.chosen),
        threads=method.threads,
        max_memory=method.blocks.max_memory,
        progress=progress.passing(),
        **method.given,
    )
    if plan.changes.frame:
        small = change_frame(small, *plan.changes.frame)
    progress.begin("write")
    with clock.time("write"):
        save(small, target, progress=progress.passing(), **saving)
    judged, unmeasured = report.judged, tuple[str, ...]()
    if method.measured and judged is None:
        from nanogs.scoring.held_out import judge_file  # which brings Numba

        progress.begin("measure")
        with clock.time("measure"):
            judged, unmeasured = judge_file(
                splats, target, turn=plan.changes.frame, threads=method.threads, tell=progress.part
            )
    progress.finish()
    notes = (*plan.notes(), *report.notes, *prepared.notes, *losses(small, target), *unmeasured)
    report = replace(with_file_seconds(report, clock, start), judged=judged, notes=notes)
    return _run(plan, report, prepared.took)


def _run(plan: Plan, report: SimplifyReport, took: Sequence[FilterReport]) -> Run:
    """The report with what there is to say of the files."""
    files: dict[str, Any] = {
        "read_count": plan.info.splats,
        "filters": took,
        "frames": plan.changes.frame,
    }
    files |= {"input": plan.name, "output": str(plan.target)}
    files |= {"input_bytes": plan.info.file_bytes, "output_bytes": bytes_on_disk(plan.target)}
    return Run(report, files)


def _stages(plan: Plan) -> list[Stage]:
    """The stages to come: reading, filters, the method's own ones, writing, measuring."""
    from nanogs.pipeline.stages import simplify_stages  # which brings Numba

    splats, suffix = plan.info.splats, plan.target.suffix
    method = simplify_stages(plan.method.chosen, plan.goal, splats, plan.count, suffix)
    write = Stage("write", write_weight(suffix, plan.count or splats // 10))
    measured = plan.method.measured and plan.goal.psnr is None
    measure = [measure_stage(splats)] if measured else []
    return [*reading_stages(plan.changes, splats), *method, write, *measure]


def print_plan(run: Run) -> None:
    """Show on stderr what a run would do."""
    plan: Plan = run.report
    if plan.count is None and plan.goal.size is not None:
        text = f"as many splats as fit into {plan.goal.size:,} B, found by writing some"
    elif plan.count is None:
        text = f"as few splats as reach {plan.goal.psnr:g} dB on {Protocol().text}"
    else:
        text = f"{counted(plan.count, 'splat')} ({plan.count / plan.info.splats:.3%})"
    show_plan(plan, text)
