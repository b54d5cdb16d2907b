"""`nanogs render`."""

from pathlib import Path
from typing import Annotated

import typer

from nanogs.cli import options


def render(
    source: Annotated[Path, typer.Argument(metavar="IN", help="Model to read.")],
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder for the PNG files.")],
    views: options.Views = 8,
    pixels: options.Pixels = "1280x720",
    cameras: options.Cameras = "auto",
    up: options.Up = None,
    background: options.BackgroundOption = "black",
    transparent: Annotated[
        bool, typer.Option(help="Keep alpha in the PNG files instead of a background.")
    ] = False,
    depth: Annotated[
        bool, typer.Option(help="Also write depth as 16-bit PNG, near is bright.")
    ] = False,
    overwrite: options.Overwrite = False,
    threads: options.Threads = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Render a model to PNG files."""
    # What only a run needs is imported here, and not for `--help`.
    from nanogs.cli.console import err, print_json, warn
    from nanogs.cli.progress import spinner
    from nanogs.io import load

    width, height = options.parse_pixels(pixels)
    # Straight alpha is taken from a rendering over black.
    color = options.parse_background("black" if transparent else background)
    direction = options.parse_direction(up)
    splats = load(source)
    from nanogs.render.images import render_images
    from nanogs.render.source import cameras_for
    from nanogs.threads import use_threads

    with spinner(quiet=quiet or json) as progress, use_threads(threads):
        progress("cameras")
        chosen = cameras_for(splats, cameras, count=views, width=width, height=height, up=direction)
        written, notes = render_images(
            splats, chosen, folder, background=color, transparent=transparent, depth=depth,
            overwrite=overwrite, progress=progress,
        )  # fmt: skip
    if json:
        print_json({"input": str(source), "images": written, "notes": notes})
        return
    for note in notes:
        warn(note)
    if not quiet:
        err.print(f"{folder}: {len(written)} images", markup=False, soft_wrap=True)
