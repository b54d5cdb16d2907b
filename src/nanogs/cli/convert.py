"""`nanogs convert`."""

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from nanogs.cli import options
from nanogs.cli.console import err, print_json, spinner, warn, with_file_seconds
from nanogs.formatting import bytes_text
from nanogs.frames import half_turn
from nanogs.io import check_writable, inspect, load, losses, save
from nanogs.report import StageClock

_PATIENCE = 2.0  # seconds without a sign of life


def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="Model to read.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="File to write.")],
    sh_degree: Annotated[
        int | None,
        typer.Option(help="Drop the spherical harmonics above this degree, 0 to 4."),
    ] = None,
    turn: Annotated[
        bool,
        typer.Option(
            "--turn",
            help="Turn by 180 degrees about x: from y up (SPZ by its specification) to y down"
            " (3DGS), or back.",
        ),
    ] = False,
    overwrite: options.Overwrite = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Write a model in another format; the suffixes of the names say which."""
    check_writable(target, overwrite=overwrite)
    run = _convert_file(
        source, target, sh_degree, turn=turn, overwrite=overwrite, quiet=quiet or json
    )
    if json:
        print_json(run)
        return
    if quiet:
        return
    for note in (*run["notes"], *run["losses"]):
        warn(note)
    sizes = f"{bytes_text(run['input_bytes'])} became {bytes_text(run['output_bytes'])}"
    text = f"{target}: {run['splats']:,} splats of SH degree {run['sh_degree']}; {sizes}"
    err.print(text, markup=False, soft_wrap=True)


def _convert_file(
    source: Path,
    target: Path,
    sh_degree: int | None,
    *,
    turn: bool,
    overwrite: bool,
    quiet: bool,
) -> dict[str, Any]:
    """Read and write; the report."""
    start, clock = time.perf_counter(), StageClock()
    with spinner(quiet=quiet, after=_PATIENCE) as progress:
        progress(f"reading {source.name}")
        with clock.time("read"):
            splats = load(source)
        read_bytes = inspect(source).file_bytes  # now: the output may take the input's place
        if sh_degree is not None:
            splats = splats.with_sh_degree(sh_degree)
        if turn:
            splats = half_turn(splats)
        progress(f"writing {target.name}")
        with clock.time("write"):
            save(splats, target, overwrite=overwrite)
    written = inspect(target)
    run = {
        "input": str(source),
        "output": str(target),
        "format": written.format,
        "splats": written.splats,
        "sh_degree": written.sh_degree,
        "turned": turn,
        "render_mode": written.render_mode.value,
        "input_bytes": read_bytes,
        "output_bytes": written.file_bytes,
        "notes": list(splats.notes),
        "losses": list(losses(splats, target)),
        "seconds": {},
    }
    return with_file_seconds(run, clock, start)
