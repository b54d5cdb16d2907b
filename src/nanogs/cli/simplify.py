"""`nanogs simplify`."""

from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from nanogs.cli import file_options, options, parsing
from nanogs.cli.blocks import DASH
from nanogs.cli.groups import with_options
from nanogs.cli.importing import without_gc
from nanogs.cli.method import Method
from nanogs.errors import OptionError
from nanogs.quantities import parse_bytes

if TYPE_CHECKING:
    from nanogs.cli.many import Run


@with_options
def simplify(
    *,
    paths: file_options.Paths,
    ratio: Annotated[
        float | None,
        typer.Option(
            "--ratio",
            "-r",
            parser=lambda text: parsing.parse_ratio(text, "--ratio"),
            metavar="RATIO",
            help="Share of the splats to keep, e.g. 0.1 or 10%.",
        ),
    ] = None,
    count: Annotated[
        int | None,
        options.count("Number of splats to keep, e.g. 50000, 100k or 1.5M."),
    ] = None,
    size: Annotated[
        int | None,
        typer.Option(
            parser=parse_bytes,
            help="Largest size of OUT, e.g. 20MB or 20MiB; makes the best file that fits.",
            metavar="SIZE",
        ),
    ] = None,
    psnr: Annotated[
        float | None,
        typer.Option(
            help="PSNR in dB, as `nanogs compare` measures it, e.g. 35; keeps the fewest splats"
            " that reach it.",
            metavar="DB",
        ),
    ] = None,
    draw_cost: Annotated[
        float | None,
        typer.Option(
            "--draw-cost",
            parser=lambda text: parsing.parse_ratio(text, "--draw-cost"),
            metavar="SHARE",
            help="Highest cost of drawing OUT, e.g. 0.5: splats a pixel as a share of those of IN,"
            " the column draws of `nanogs compare`; keeps as many splats as that allows.",
        ),
    ] = None,
    of_format: options.OfFormat,
    device: options.Device = "cpu",
    overwrite: options.Overwrite = False,
    verbose: Annotated[
        bool,
        typer.Option("--verbose", "-v", help="Show how it was done: stages, passes, counts tried."),
    ] = False,
    files: file_options.Files,
    method: Method,
) -> None:
    """Make a smaller model of the scene: of a ratio, count, file size, PSNR or draw cost."""
    # Imported here because `--help` does not need it.
    with without_gc():
        from nanogs.cli import many, plan, simplify_run
        from nanogs.cli.simplify_report import print_report
        from nanogs.io.collect import collect_parts
        from nanogs.pipeline.options.target import Goal

    # All checks are made here, before minutes of computing.
    if method.blocks.join and files.out_dir is not None:
        raise OptionError(
            "--join cannot be combined with --out-dir, because it makes one result of all inputs;"
            " name OUT after them."
        )
    joined, notes = collect_parts(paths[:-1]) if method.blocks.join else ((), ())
    pairs = many.plan_pairs([joined[0], paths[-1]] if joined else paths, files)
    method.check(paths)
    arguments = simplify_run.Arguments(
        request=plan.request_of(
            method, Goal(ratio, count, size, psnr, draw_cost), overwrite=overwrite,
            format_options=of_format, device=device, notes=notes,
        ),
        method=method,
        joined=joined,
        piped=DASH in paths,
        folder_later=files.out_dir is not None and not files.out_dir.exists(),
    )  # fmt: skip
    show = partial(print_report, verbose=verbose)
    runs = many.run_all(
        pairs, partial(simplify_run.run_one, arguments),
        simplify_run.print_plan if method.dry_run else show,
        method, files, writes=not method.dry_run, overwrite=overwrite,
    )  # fmt: skip
    _exit_if_short([] if method.dry_run else runs, hushed=method.hushed)


def _exit_if_short(runs: "list[Run]", *, hushed: bool) -> None:
    """Name the results that miss the request, and exit with code 3 if there are any.

    A whole model that was written because fewer splats miss the PSNR is named unless `hushed`.

    Raises:
        typer.Exit: With code 3.
    """
    from nanogs.cli.console import warn
    from nanogs.report import stop_text

    for run in runs:
        if not (run.report.met if hushed else run.report.stop.met):
            text = stop_text(run.report)
            warn(text if len(runs) == 1 else f"{run.files['output']}: {text}")
    if not all(run.report.met for run in runs):
        raise typer.Exit(3)
