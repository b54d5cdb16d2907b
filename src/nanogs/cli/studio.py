"""`nanogs studio`."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from nanogs.cli import options, parsing
from nanogs.cli.groups import with_options
from nanogs.pipeline.options.presets import DEFAULT_PRESET, FORESTS


@with_options
def studio(
    *,
    model: Annotated[
        Path,
        typer.Argument(
            metavar="SCENE", parser=parsing.parse_model, help="Model to make smaller: a file."
        ),
    ],
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port to listen on.", show_default="any free one")
    ] = 0,
    open_page: Annotated[
        bool | None,
        typer.Option(
            "--open/--no-open", help="Open the page in a browser.", show_default="on a terminal"
        ),
    ] = None,
    idle: Annotated[
        float,
        typer.Option(
            min=0,
            help="Seconds for which the studio keeps running after its last page is closed; 0 is"
            " for ever.",
        ),
    ] = 60.0,
    preset: Annotated[
        str,
        typer.Option(help=f"Preset to start with: {', '.join(FORESTS)}.", metavar="NAME"),
    ] = DEFAULT_PRESET,
    up: options.Up = None,
    render_mode: options.AsMode = None,
    device: options.Device = "cpu",
    threads: options.Threads = None,
    max_memory: options.MaxMemory = None,
    reporting: options.Reporting,
) -> None:
    """Choose a smaller model in a browser: see every count, size and PSNR before it is saved.

    The page can be opened only on this machine. It reads and saves files below the folder in
    which the command was started. Ctrl-C ends it; so does closing the page, after the seconds of
    --idle.
    """
    # Imported here because `--help` does not need it.
    from nanogs.cli.browsing import show_page
    from nanogs.cli.console import say
    from nanogs.studio.scene import StudioSettings, refuse_small_memory, scene_of
    from nanogs.studio.server import Studio
    from nanogs.studio.turning import axis_of
    from nanogs.view.bundle import check_built

    check_built()
    settings = StudioSettings(
        preset=preset, render_mode=render_mode, up=None if up is None else axis_of(up),
        threads=threads, max_memory=max_memory, device=device,
    )  # fmt: skip
    scene = scene_of(model)
    refuse_small_memory(scene, settings)
    serving = Studio(scene, settings, folder=Path.cwd(), port=port, idle=idle)
    record = {"url": serving.url, "input": str(model), "folder": str(Path.cwd())}
    reporting.report(record, partial(say, f"{model}: {serving.url} (Ctrl-C ends it)"))
    show_page(serving.url, "the address", open_page, quiet=reporting.json)
    serving.run()
