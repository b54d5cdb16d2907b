"""`nanogs view`."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from nanogs.cli import options, parsing
from nanogs.cli.groups import with_options
from nanogs.cli.looking import Given, refuse_beside_file
from nanogs.defaults import PAGE_SPLATS
from nanogs.errors import OptionError
from nanogs.formatting import bytes_text
from nanogs.protocol import PIXELS, VIEWS


@with_options
def view(
    *,
    models: Annotated[
        list[str],
        typer.Argument(
            metavar="A [B]",
            help="Model to show, and optionally a second one to compare it with: both have the"
            " same camera, with a line to drag between them. name=path names a model. Each is"
            " a file, its folder or its URL.",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            parser=parsing.parse_page,
            metavar="PAGE",
            help="Page to write.",
            show_default="A.html, or A-B.html",
        ),
    ] = None,
    level: Annotated[
        int | None,
        typer.Option(
            min=0,
            help=f"Level of detail to show of {options.OF_LEVELS}; 0 is the finest.",
            show_default=f"the finest of at most {PAGE_SPLATS:,} splats",
        ),
    ] = None,
    psnr: Annotated[
        bool | None,
        typer.Option(
            "--psnr/--no-psnr",
            help="Measure the PSNR of B against A, as `nanogs compare` does.",
            show_default="psnr",
        ),
    ] = None,
    open_page: Annotated[
        bool | None,
        typer.Option(
            "--open/--no-open", help="Open the page in a browser.", show_default="on a terminal"
        ),
    ] = None,
    views: Annotated[int | None, options.views(VIEWS)] = None,
    pixels: Annotated[str | None, options.pixels(PIXELS)] = None,
    cameras: options.Cameras = "auto",
    up: options.Up = None,
    background: options.BackgroundOption = "black",
    render_mode: options.AsMode = None,
    run: options.Running,
) -> None:
    """Write a page that shows one or two models in 3D, offline; mouse, touch and keys move them."""
    # Imported here because `--help` does not need it.
    from nanogs.cli.browsing import show_page
    from nanogs.cli.console import say
    from nanogs.cli.fetching import fetched
    from nanogs.cli.progress import shown
    from nanogs.io.atomic import check_writable
    from nanogs.scoring.viewing import page_path, view_files
    from nanogs.view.bundle import check_built

    width, height = parsing.parse_pixels(str(PIXELS) if pixels is None else pixels)
    of_psnr: Given = {"--views": views, "--pixels": pixels}
    refuse_beside_file(cameras, of_psnr)
    color = parsing.parse_background(background)
    inputs = parsing.parse_named(models)
    pages = [path for _, path in inputs[1:] if path.suffix.lower() == ".html"]
    if pages and output is None:
        raise OptionError(f"{pages[0]} is a page, not a model; give -o {pages[0]} to write it.")
    if len(inputs) > 2:
        raise OptionError(
            f"A page shows one model or two, but {len(inputs)} were given; leave the others out."
        )
    measured = len(inputs) > 1 and psnr is not False
    if psnr and not measured:
        raise OptionError(
            "--psnr has no effect, because it compares two models; name a second one, or leave it"
            " out."
        )
    if cameras == "roam" and not measured:
        of_psnr = {"--cameras roam": cameras, **of_psnr}
    unused = [option for option, value in of_psnr.items() if value is not None]
    if unused and not measured:
        raise OptionError(
            f"{unused[0]} has no effect, because the PSNR of two models is not measured here;"
            " leave it out."
        )
    check_built()
    page = output or page_path([path for _, path in inputs])
    check_writable(page, overwrite=run.overwrite)
    with (
        fetched([path for _, path in inputs], quiet=run.hushed) as files,
        shown(quiet=run.hushed) as progress,
        _threads(run.threads, measured),
    ):
        named = [(name, file) for (name, _), file in zip(inputs, files, strict=True)]
        report = view_files(
            named, page, cameras=cameras, views=views or VIEWS, width=width, height=height, up=up,
            background=color, psnr=measured, level=level, render_mode=render_mode,
            overwrite=run.overwrite, progress=progress, max_memory=run.max_memory,
        )  # fmt: skip
    notes = [f"{model.name}: {note}" for model in report.models for note in model.notes]
    notes += report.notes
    judged = "" if report.judged is None else f"; {report.judged.text}"
    said = f"{page}: {bytes_text(report.output_bytes)}{judged}"
    run.report(report.to_dict(), partial(say, said), notes)
    show_page(page.resolve().as_uri(), str(page), open_page, quiet=run.json)


@contextmanager
def _threads(asked: int | None, measured: bool) -> Iterator[None]:
    """Set the number of threads; if it is not needed, Numba is not imported."""
    if asked is None and not measured:
        yield
        return
    from nanogs.threads import use_threads

    with use_threads(asked):
        yield
