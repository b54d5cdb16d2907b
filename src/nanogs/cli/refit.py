"""`nanogs refit`."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from nanogs.cli import options
from nanogs.cli.groups import Fields, with_options
from nanogs.fit.parameters import RefitParameters
from nanogs.formatting import counted
from nanogs.ranges import known_parameters

if TYPE_CHECKING:
    from rich.table import Table

    from nanogs.progress import Stage

_DEFAULTS, _TYPES = RefitParameters(), get_type_hints(RefitParameters)
_PARAMETERS: Fields = {
    name: (Annotated[_TYPES[name], options.of_parameter(name, known)], getattr(_DEFAULTS, name))
    for name, known in known_parameters(RefitParameters).items()
    if known.help
}


@with_options
def refit(
    *,
    original: Annotated[Path, typer.Argument(metavar="ORIGINAL", help="The model to look like.")],
    small: Annotated[
        Path, typer.Argument(metavar="SMALL", help="The model to fit, from any tool.")
    ],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="File to write.")],
    cameras: options.Cameras = "auto",
    up: options.Up = None,
    given: Annotated[dict[str, Any], _PARAMETERS],
    overwrite: options.Overwrite = False,
    threads: options.Threads = None,
    max_memory: options.MaxMemory = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: Annotated[
        bool,
        typer.Option(
            "--verbose", "-v", help="Show every round and what each group of views gained."
        ),
    ] = False,
) -> None:
    """Fit a small model to renders of the original: no photographs, no training data."""
    # What only a run needs is imported here, and not for `--help`.
    from nanogs.cli.console import print_json, warn
    from nanogs.io import check_writable, inspect
    from nanogs.memory import allowed_memory, refuse_too_large
    from nanogs.needs import refit_bytes

    chosen = RefitParameters(**given)
    check_writable(target, overwrite=overwrite)
    refuse_too_large(
        f"Fitting {small}",
        refit_bytes(inspect(original), inspect(small), chosen.size**2, chosen.kept + chosen.held),
        allowed_memory(max_memory),
        "free some, or take fewer or smaller views (--views, --pixels)",
    )
    run = _refit_files(
        original, small, target, cameras, up, chosen, threads, overwrite, quiet or json
    )
    if json:
        print_json(run)
        return
    if quiet:
        return
    for note in run["notes"]:
        warn(note)
    _print_report(run, verbose=verbose)


def _refit_files(
    original: Path,
    small: Path,
    target: Path,
    cameras: str,
    up: tuple[float, float, float] | None,
    parameters: RefitParameters,
    threads: int | None,
    overwrite: bool,
    quiet: bool,
) -> dict[str, Any]:
    """Read, fit and write; the report with the files' names and the seconds of I/O."""
    from nanogs.cli.console import with_file_seconds
    from nanogs.cli.progress import shown
    from nanogs.clock import StageClock
    from nanogs.fit.api import refit as library_refit
    from nanogs.io import load, losses, save
    from nanogs.pipeline.cameras import fit_cameras
    from nanogs.progress import Tracker

    start, clock = time.perf_counter(), StageClock()
    with shown(quiet=quiet) as watch:
        progress = Tracker(watch, _stages(original, small, target, parameters))
        progress.begin("read")
        with clock.time("read"):
            reference, model = load(original), load(small)
        count = parameters.views + parameters.held
        views = fit_cameras(reference, cameras, up, count, parameters.size)
        fitted, report = library_refit(
            reference,
            model,
            cameras=views,
            parameters=parameters,
            threads=threads,
            progress=progress.passing(),
        )
        progress.begin("write")
        with clock.time("write"):
            save(fitted, target, overwrite=overwrite, progress=progress.passing())
    run = with_file_seconds(report.to_dict(), clock, start)
    run["notes"] = [*run["notes"], *losses(fitted, target)]
    return run | {"original": str(original), "input": str(small), "output": str(target)}


def _stages(
    original: Path, small: Path, target: Path, parameters: RefitParameters
) -> "list[Stage]":
    """The stages to come: reading, the fit's own ones, writing."""
    from nanogs.fit.stages import refit_stages
    from nanogs.io import inspect
    from nanogs.pipeline.weights import read_weight, write_weight
    from nanogs.progress import Stage

    splats, count = inspect(original).splats, inspect(small).splats
    fit = refit_stages(parameters, splats, count)
    write = Stage("write", write_weight(target.suffix, count))
    return [Stage("read", read_weight(splats + count)), *fit, write]


def _print_report(run: dict[str, Any], *, verbose: bool) -> None:
    from nanogs.cli.console import arrow, err, say, show
    from nanogs.formatting import number_text, time_text

    if verbose:
        show(err, _round_table(run["rounds"]))
        show(err, _group_table(run["groups"]))
    before, after = number_text(run["psnr_before"]), number_text(run["psnr_after"])
    views = counted(len(run["validation_views"]), "view")
    say(
        f"{counted(run['count'], 'splat')} in {run['output']}, {before} {arrow()} {after} dB on"
        f" {views} kept apart of {run['parameters']['size']} pixels,"
        f" {time_text(run['total_seconds'])}"
    )


def _round_table(rounds: list[dict[str, Any]]) -> "Table":
    from rich.table import Table

    from nanogs.formatting import number_text

    table = Table("round", "PSNR", "", "seconds", box=None, pad_edge=False)
    for number, entry in enumerate(rounds, 1):
        kept = "" if entry["share"] == 1 else f"{entry['share']:.0%} kept"
        table.add_row(
            str(number), number_text(entry["psnr_after"]), kept, f"{entry['seconds']:.1f}"
        )
    return table


def _group_table(groups: list[dict[str, Any]]) -> "Table":
    from rich.table import Table

    from nanogs.formatting import number_text

    table = Table("views that decide", "", "before", "after", box=None, pad_edge=False)
    for entry in groups:
        psnrs = (number_text(entry[name]) for name in ("psnr_before", "psnr_after"))
        table.add_row(entry["name"], str(len(entry["views"])), *psnrs)
    return table
