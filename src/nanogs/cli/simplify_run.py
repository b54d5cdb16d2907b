"""`nanogs simplify` of each file: plan it, and simplify it, whole or in blocks."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from nanogs.ahead import compile_ahead
from nanogs.cli.console import warn
from nanogs.cli.framing import frames_of
from nanogs.cli.importing import uncollected
from nanogs.cli.many import Run
from nanogs.cli.method import Method
from nanogs.cli.plan import Plan, asked, plan_run, sees_to_output, show_plan
from nanogs.errors import OptionError
from nanogs.formatting import counted
from nanogs.io import bytes_on_disk, check_writable, registry
from nanogs.io.collect import Pair
from nanogs.kernels.compiling import when_compiling
from nanogs.pipeline.api import refuse_searches
from nanogs.pipeline.files import simplify_files
from nanogs.pipeline.job import import_stages
from nanogs.pipeline.presets import renders
from nanogs.pipeline.rows import Changes
from nanogs.pipeline.target import Goal
from nanogs.progress import Progress
from nanogs.protocol import Protocol


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
    return _made(plan, request.saving, progress)


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
        parts, target, (goal,), method, replace(request.changes, frame=turn), piped=request.piped,
        saving=request.saving,
    )  # fmt: skip


def _made(plan: Plan, saving: dict[str, Any], progress: Progress) -> Run:
    """Simplify a file, and measure the result."""
    wish = asked(plan, saving)
    with uncollected():
        import_stages(plan.method.chosen)
    if not plan.divided and (renders(plan.method.chosen) or plan.method.measured):
        when_compiling(compile_ahead)
    if plan.divided:
        with plan.executor() as executor:
            wish = replace(wish, executor=executor, max_memory=plan.process_memory)
            report = simplify_files(wish, progress)
    else:
        report = simplify_files(wish, progress)
    report = replace(report, notes=(*plan.notes(), *report.notes))
    files: dict[str, Any] = {"frames": plan.changes.frame}
    files |= {"input": plan.name, "output": str(plan.target)}
    files |= {"input_bytes": plan.info.file_bytes, "output_bytes": bytes_on_disk(plan.target)}
    return Run(report, files)


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
