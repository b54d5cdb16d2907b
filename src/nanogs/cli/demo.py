"""`nanogs demo`."""

from pathlib import Path
from typing import Annotated

import typer


def demo(
    target: Annotated[Path, typer.Argument(metavar="OUT", help="File to write.")],
    count: Annotated[int, typer.Option("--count", "-n", min=1, help="Number of splats.")] = 200_000,
    seed: Annotated[int, typer.Option(min=0, help="Another seed, another scene.")] = 0,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", "-w", help="Replace OUT if it exists.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")] = False,
) -> None:
    """Write a made-up scene to try things on."""
    from nanogs.cli.console import err
    from nanogs.datasets.synthetic import make_scene
    from nanogs.io import check_writable, save

    check_writable(target, overwrite=overwrite)
    save(make_scene(count, seed=seed), target, overwrite=overwrite)
    if not quiet:
        err.print(f"{target}: {count:,} splats", markup=False, soft_wrap=True)
