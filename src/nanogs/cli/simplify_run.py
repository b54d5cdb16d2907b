"""`nanogs simplify` for one file: plan it, and simplify it, in memory or in blocks."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from nanogs.cli.console import warn
from nanogs.cli.framing import frames_of
from nanogs.cli.many import Run
from nanogs.cli.method import Method
from nanogs.cli.plan import RunPlan, execute, plan_run, show_plan
from nanogs.formatting import counted
from nanogs.io import bytes_on_disk, check_writable, registry
from nanogs.io.collect import Pair
from nanogs.pipeline.files import simplify_files
from nanogs.pipeline.request import Request
from nanogs.progress import Progress
from nanogs.protocol import Protocol


@dataclass(frozen=True, slots=True, kw_only=True)
class Arguments:
    """The options of a run of `simplify`, parsed and the same for each file.

    Attributes:
        request: The request to the library, without files.
        method: Options of the method and of its execution.
        joined: Inputs that are parts of one scene, or none.
        piped: Whether a model comes from stdin or goes to stdout.
        folder_later: Whether the folder of the results does not exist yet.
    """

    request: Request
    method: Method
    joined: tuple[Path, ...]
    piped: bool
    folder_later: bool


def run_one(arguments: Arguments, pair: Pair, progress: Progress) -> Run:
    """Simplify a file and return the report, or with --dry-run the plan.

    Raises:
        NanogsError: The file cannot be simplified as requested.
    """
    plan, method = _plan(arguments, pair), arguments.method
    if not method.hushed:
        for note in plan.notes():
            warn(note)
    if method.dry_run:
        shown = plan.shown()
        asked = {"asked_count": shown.count, **plan.request.goal.reported}
        return Run(shown, {"input": plan.name, **asked})
    return _made(plan, progress)


def _plan(arguments: Arguments, pair: Pair) -> RunPlan:
    """Check the files and the request, and plan the run."""
    method, target = arguments.method, pair.target
    inputs = arguments.joined or (pair.source,)
    turn = frames_of(inputs, target, method.edits.frame)
    options = registry.add_target_frame(target, arguments.request.format_options, turn)
    request = replace(
        arguments.request, inputs=inputs, output=target, frame=turn, format_options=options
    )
    request.check()
    if not request.continues_job() and not (method.dry_run and arguments.folder_later):
        check_writable(target, overwrite=request.overwrite, format_options=request.format_options)
    return plan_run(request, method, piped=arguments.piped)


def _made(plan: RunPlan, progress: Progress) -> Run:
    """Simplify a file, and return the report with names and sizes of the files."""
    request, report = plan.request, execute(plan, lambda request: simplify_files(request, progress))
    if plan.method.hushed and not plan.divided:
        report = replace(report, notes=(*plan.notes(), *report.notes))
    files: dict[str, Any] = {
        "frames": request.frame,
        "input": plan.name,
        "output": str(request.output),
    }
    files |= {"input_bytes": plan.info.file_bytes, "output_bytes": bytes_on_disk(request.output)}
    return Run(report, files)


def print_plan(run: Run) -> None:
    """Print the plan of a dry run on stderr."""
    plan: RunPlan = run.report
    if plan.count is None and plan.request.goal.size is not None:
        text = (
            f"as many splats as fit into {plan.request.goal.size:,} B, found by writing some files"
        )
    elif plan.count is None and plan.request.goal.draw_cost is not None:
        share = f"{plan.request.goal.draw_cost:.1%} of the splats a pixel"
        text = f"as many splats as need at most {share} that the model needs, on {Protocol().text}"
    elif plan.count is None:
        text = f"as few splats as reach {plan.request.goal.psnr:g} dB on {Protocol().text}"
    else:
        text = f"{counted(plan.count, 'splat')} ({plan.count / plan.info.splats:.3%})"
        text += plan.condition
    show_plan(plan, text)
