"""`nanogs demo`."""

from pathlib import Path
from typing import Annotated

import typer

from nanogs.cli import options, parsing
from nanogs.formatting import counted


def demo(
    target: Annotated[
        Path, typer.Argument(metavar="OUT", parser=parsing.parse_output, help="File to write.")
    ],
    count: Annotated[
        int | None,
        options.count("Generate a scene with this many splats instead, e.g. 50000 or 100k."),
    ] = None,
    seed: Annotated[
        int,
        typer.Option(min=0, help="Seed of the generated scene; another seed gives another scene."),
    ] = 0,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """Write a real scene to try things on: a potted plant of 113,648 splats."""
    from nanogs.cli.console import say, warn
    from nanogs.errors import OptionError
    from nanogs.io import check_writable, save

    if seed and count is None:
        raise OptionError(
            "--seed works only with --count, which generates a scene; give both, or leave it out."
        )
    check_writable(target, overwrite=overwrite)
    if count is None:
        from nanogs.datasets.plant import CREDIT, load_plant

        scene, about = load_plant(), CREDIT
    else:
        from nanogs.datasets.synthetic import make_scene

        scene, about = make_scene(count, seed=seed), "made up"
    left_out = save(scene, target, overwrite=overwrite)
    if not quiet:
        for note in left_out:
            warn(note)
        say(f"{target}: {counted(len(scene), 'splat')}, {about}")
