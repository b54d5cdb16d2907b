"""`nanogs refit`."""

import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from nanogs.cli import options, parsing
from nanogs.cli.groups import Fields, with_options
from nanogs.cli.looking import refuse_beside_file
from nanogs.fit.parameters import RefitParameters
from nanogs.ranges import known_parameters

if TYPE_CHECKING:
    from nanogs.fit.report import RefitReport
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
    original: Annotated[
        Path,
        typer.Argument(
            metavar="ORIGINAL",
            parser=parsing.parse_model,
            help="The original model, which the result should look like; each of the three is a"
            " file or its URL; a model that is read may be its folder.",
        ),
    ],
    small: Annotated[
        Path,
        typer.Argument(
            metavar="SMALL", parser=parsing.parse_model, help="The model to fit, from any tool."
        ),
    ],
    target: Annotated[
        Path, typer.Argument(metavar="OUT", parser=parsing.parse_output, help="File to write.")
    ],
    cameras: options.Cameras = "auto",
    up: options.FitUp = None,
    given: Annotated[dict[str, Any], _PARAMETERS],
    render_mode: options.AsMode = None,
    device: options.Device = "cpu",
    run: options.Running,
    verbose: Annotated[
        bool,
        typer.Option(
            "--verbose", "-v", help="Show every round and what each group of views gained."
        ),
    ] = False,
) -> None:
    """Fit a small model to renders of the original: no photographs, no training data."""
    # Imported here because `--help` does not need it.
    from nanogs.card.device import check_device
    from nanogs.cli.fetching import DOWNLOAD, transfer_bar
    from nanogs.io import check_writable, inspect
    from nanogs.io.collect import model_in
    from nanogs.io.url_files import local_copies
    from nanogs.memory import allowed_memory, refuse_too_large
    from nanogs.memory_estimates import refit_bytes

    chosen = RefitParameters(**given)
    refuse_beside_file(cameras, {"--up": up})
    check_writable(target, overwrite=run.overwrite)
    check_device(device)
    bar = transfer_bar(quiet=run.hushed)
    with local_copies(
        [original, small], target, overwrite=run.overwrite, transfer=bar, remedy=DOWNLOAD
    ) as near:
        inputs, made = near
        first, second = (model_in(file) for file in inputs)
        views = chosen.kept + chosen.held
        refuse_too_large(
            f"Fitting {small}",
            refit_bytes(inspect(first), inspect(second), made or target, chosen.size**2, views),
            allowed_memory(run.max_memory),
            "take fewer or smaller views (--views, --pixels)",
        )
        report = _refit_files(
            first, second, made or target, cameras, up, chosen, render_mode, device, run
        )
    files = {"original": str(original), "input": str(small), "output": str(target)}
    show = partial(_print_report, report, target, verbose=verbose)
    run.report(report.to_dict() | files, show, report.notes)


def _refit_files(
    original: Path,
    small: Path,
    target: Path,
    cameras: str,
    up: parsing.Direction | None,
    parameters: RefitParameters,
    mode: str | None,
    device: str,
    run: options.Running,
) -> "RefitReport":
    """Read, fit and write; return the report with the seconds of I/O."""
    from nanogs.cli.progress import shown
    from nanogs.clock import StageClock
    from nanogs.fit.api import refit as library_refit
    from nanogs.io import open as open_model
    from nanogs.io import registry, save
    from nanogs.io.frames import other_frames
    from nanogs.pipeline.options.cameras import fit_cameras
    from nanogs.progress import Tracker
    from nanogs.threads import use_threads

    start, clock = time.perf_counter(), StageClock()
    with shown(quiet=run.hushed) as watch, use_threads(run.threads):
        progress = Tracker(watch, _stages(original, small, target, parameters))
        progress.begin("read")
        with (
            clock.time("read"),
            open_model(original, render_mode=mode) as large,
            open_model(small, render_mode=mode) as given,
        ):
            reference, model = large.load(), given.load()
            loaded = ((large.name, reference), (given.name, model))
            remarks = [f"{name}: {note}" for name, each in loaded for note in each.notes]
            remarks += other_frames([(file.name, file) for file in (large, given)])
        count = parameters.views + parameters.held
        views = fit_cameras(reference, cameras, up, count, parameters.size)
        fitted, report = library_refit(
            reference,
            model,
            cameras=views,
            parameters=parameters,
            format=registry.writable(target).suffix,
            device=device,
            threads=run.threads,
            progress=progress.passing(),
        )
        progress.begin("write")
        with clock.time("write"):
            left_out = save(fitted, target, overwrite=run.overwrite, progress=progress.passing())
        progress.finish()
    return replace(
        report,
        notes=(*remarks, *report.notes, *left_out),
        seconds={"read": clock.seconds["read"]} | report.seconds | clock.seconds,
        total_seconds=time.perf_counter() - start,
    )


def _stages(
    original: Path, small: Path, target: Path, parameters: RefitParameters
) -> "list[Stage]":
    """Return the stages: reading, those of the fit, writing."""
    from nanogs.fit.stages import refit_stages
    from nanogs.io import inspect
    from nanogs.pipeline.estimates.stage_weights import read_weight, write_weight
    from nanogs.progress import Stage

    splats, count = inspect(original).splats, inspect(small).splats
    fit = refit_stages(parameters, splats, count)
    write = Stage("write", write_weight(target.suffix, count))
    return [Stage("read", read_weight(splats + count)), *fit, write]


def _print_report(report: "RefitReport", target: Path, *, verbose: bool) -> None:
    from nanogs.cli.console import arrow, say, show_report
    from nanogs.formatting import counted, listed, number_text, time_text

    if verbose:
        show_report(report)
    before, after = number_text(report.psnr_before), number_text(report.psnr_after)
    views = counted(len(report.validation_views), "view")
    # Given cameras may have several sizes.
    sizes = listed(dict.fromkeys(group.pixels for group in report.groups), "and")
    say(
        f"{counted(report.count, 'splat')} in {target}, {before} {arrow()} {after} dB on {views}"
        f" held out for validation, of {sizes} pixels, {time_text(report.total_seconds)}"
    )
