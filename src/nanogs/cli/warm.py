"""`nanogs warm`."""

from typing import Annotated

import typer

from nanogs.cli import options
from nanogs.formatting import counted, time_text


def warm(
    workers: Annotated[
        int | None,
        typer.Option(
            "--workers",
            min=1,
            max=options.MOST_PROCESSES,
            metavar="N",
            help="Number of processes, by default one for each processor.",
        ),
    ] = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Compile everything that runs need, so that the first is as fast as later ones."""
    from dataclasses import asdict

    from nanogs.cli.console import err, print_json
    from nanogs.cli.progress import shown
    from nanogs.warming import warm as warm_up

    with shown(quiet=quiet or json) as watch:
        found = warm_up(workers, progress=watch)
    if json:
        print_json(asdict(found))
    elif not quiet:
        took = f"{found.compiled} of them compiled in {time_text(found.seconds)}"
        text = f"{counted(found.kernels, 'kernel')} for {found.processor} in {found.folders[0]}"
        err.print(
            f"{text}, {took if found.compiled else 'all compiled already'}",
            markup=False,
            soft_wrap=True,
        )
