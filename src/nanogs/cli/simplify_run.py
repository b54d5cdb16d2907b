"""`nanogs simplify` for one file: plan it, and simplify it, in memory or in blocks."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from nanogs.cli.console import warn
from nanogs.cli.framing import frames_of
from nanogs.cli.many import Run
from nanogs.cli.method import Method
from nanogs.cli.plan import Plan, execute, plan_run, show_plan
from nanogs.formatting import counted
from nanogs.io import bytes_on_disk, check_writable, registry
from nanogs.io.collect import Pair
from nanogs.pipeline.files import simplify_files
from nanogs.pipeline.request import Request
from nanogs.progress import Progress
from nanogs.protocol import Protocol


@dataclass(frozen=True, slots=True, kw_only=True)
class Wishes:
    """The options of a run of `simplify`, parsed and the same for each file.

    Attributes:
        wish: The request to the library, without files.
        method: Options of the method and of its execution.
        joined: Inputs that are parts of one scene, or none.
        piped: Whether a model comes from stdin or goes to stdout.
        folder_later: Whether the folder of the results does not exist yet.
    """

    wish: Request
    method: Method
    joined: tuple[Path, ...]
    piped: bool
    folder_later: bool


def run_one(wishes: Wishes, pair: Pair, progress: Progress) -> Run:
    """Simplify a file and return the report, or with --dry-run the plan.

    Raises:
        NanogsError: The file cannot be simplified as requested.
    """
    plan, method = _plan(wishes, pair), wishes.method
    if plan.divided and not method.hushed:
        for note in plan.notes():
            warn(note)
    if method.dry_run:
        shown, goal = plan.shown(), plan.wish.goal
        asked: dict[str, Any] = {"asked_ratio": goal.ratio, "asked_count": shown.count}
        asked |= {"asked_size": goal.size, "asked_psnr": goal.psnr}
        asked |= {"asked_draw_cost": goal.draw_cost}
        return Run(shown, {"input": plan.name} | asked)
    return _made(plan, progress)


def _plan(wishes: Wishes, pair: Pair) -> Plan:
    """Check the files and the request, and plan the run."""
    method, target = wishes.method, pair.target
    turn = frames_of(pair, method.edits.frame)
    inputs = wishes.joined or (pair.source,)
    options = registry.add_target_frame(target, wishes.wish.format_options, turn)
    wish = replace(wishes.wish, inputs=inputs, output=target, frame=turn, format_options=options)
    wish.check()
    if not wish.continues_job() and not (method.dry_run and wishes.folder_later):
        check_writable(target, overwrite=wish.overwrite, format_options=wish.format_options)
    return plan_run(wish, method, piped=wishes.piped)


def _made(plan: Plan, progress: Progress) -> Run:
    """Simplify a file, and return the report with names and sizes of the files."""
    wish, report = plan.wish, execute(plan, lambda wish: simplify_files(wish, progress))
    if not plan.divided:
        report = replace(report, notes=(*plan.notes(), *report.notes))
    files: dict[str, Any] = {"frames": wish.frame, "input": plan.name, "output": str(wish.output)}
    files |= {"input_bytes": plan.info.file_bytes, "output_bytes": bytes_on_disk(wish.output)}
    return Run(report, files)


def print_plan(run: Run) -> None:
    """Print the plan of a dry run on stderr."""
    plan: Plan = run.report
    if plan.count is None and plan.wish.goal.size is not None:
        text = f"as many splats as fit into {plan.wish.goal.size:,} B, found by writing some files"
    elif plan.count is None and plan.wish.goal.draw_cost is not None:
        share = f"{plan.wish.goal.draw_cost:.1%} of the splats a pixel"
        text = f"as many splats as need at most {share} that the model needs, on {Protocol().text}"
    elif plan.count is None:
        text = f"as few splats as reach {plan.wish.goal.psnr:g} dB on {Protocol().text}"
    else:
        text = f"{counted(plan.count, 'splat')} ({plan.count / plan.info.splats:.3%})"
        text += "" if plan.read else ", if none holds a NaN or an infinite value"
    show_plan(plan, text)
