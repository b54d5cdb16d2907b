"""`nanogs render`."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from nanogs.cli import options, parsing
from nanogs.cli.groups import with_options
from nanogs.cli.looking import refuse_beside_file
from nanogs.errors import OptionError
from nanogs.formatting import counted

_PIXELS = "1280x720"
_OTHERS = (".gif", ".tif", ".tiff", ".bmp", ".exr", ".avif")


@with_options
def render(
    *,
    source: Annotated[
        Path,
        typer.Argument(
            metavar="IN",
            parser=parsing.parse_model,
            help="Model to read: a file, its folder or its URL.",
        ),
    ],
    target: Annotated[
        Path,
        typer.Argument(
            metavar="OUT",
            parser=parsing.parse_output,
            help="Folder for PNG files; or one .png, .jpg or .webp file, for one view.",
        ),
    ],
    views: Annotated[int | None, options.views("8, or 1 for one file")] = None,
    pixels: Annotated[str | None, options.pixels(_PIXELS)] = None,
    cameras: options.Cameras = "auto",
    up: options.Up = None,
    background: options.GivenBackground = None,
    transparent: Annotated[
        bool, typer.Option(help="Keep alpha in the files instead of a background.")
    ] = False,
    depth: Annotated[
        bool, typer.Option(help="Also write depth as 16-bit PNG, near is bright.")
    ] = False,
    level: options.Level = 0,
    render_mode: options.AsMode = None,
    device: options.Device = "cpu",
    run: options.Running,
) -> None:
    """Render a model to pictures."""
    # Imported here because `--help` does not need it.
    from nanogs.cli.console import say
    from nanogs.cli.fetching import fetched
    from nanogs.cli.progress import shown
    from nanogs.io import open as open_model
    from nanogs.io.url_files import refuse_address

    one = _is_picture(target)  # refuses names of other formats, whatever the number of views
    count = views or (1 if one else 8)
    width, height = parsing.parse_pixels(_PIXELS if pixels is None else pixels)
    refuse_beside_file(cameras, {"--views": views, "--pixels": pixels, "--up": up})
    if transparent and background is not None:
        raise OptionError(
            "--background cannot be combined with --transparent, which keeps alpha in place of a"
            " background; leave one of them out."
        )
    if background == "transparent":
        raise OptionError(
            "--background is black, white or #rrggbb; for no background give --transparent in its"
            " place."
        )
    # Straight alpha needs it black.
    color = parsing.parse_background("black" if background is None else background)
    from nanogs.card.device import device_notes, use_device
    from nanogs.progress import Stage, Tracker
    from nanogs.source import Noted
    from nanogs.threads import use_threads
    from nanogs.views.cameras import chosen_cameras, known_cameras
    from nanogs.views.costing import pictures_of
    from nanogs.views.pictures import render_images
    from nanogs.views.plan import budget_for_pictures, rendering_remedy

    refuse_address(target, "pictures are written to a folder or file: name one")
    wanted = known_cameras(cameras)
    largest, count = pictures_of(wanted, count, (width, height))
    stages = [Stage("read", 1.0), Stage("cameras", 0.5), Stage("render", 0.3 * count)]
    with (
        use_device(device) as used,
        fetched([source], quiet=run.hushed) as [file],
        open_model(file, level=level, render_mode=render_mode) as opened,
    ):
        remedy = rendering_remedy(wanted)
        budget = budget_for_pictures(opened, largest, 0, run.max_memory, remedy=remedy)
        with shown(quiet=run.hushed) as watch, use_threads(run.threads):
            progress = Tracker(watch, stages)
            progress.begin("read")
            model = opened.load() if budget is None else Noted(opened)
            progress.begin("cameras")
            chosen, _ = chosen_cameras(model, wanted, count, (width, height), up)
            written, notes = render_images(
                model, chosen, target, background=color, transparent=transparent, depth=depth,
                overwrite=run.overwrite, budget=budget, progress=progress.passing(),
            )  # fmt: skip
            progress.finish()
    said = f"{target}: {counted(len(written), 'image')}"
    report = {"input": str(source), "images": written, "device": used}
    report["notes"] = [*model.notes, *notes, *device_notes(device, used)]
    run.report(report, partial(say, said), report["notes"])


def _is_picture(target: Path) -> bool:
    """Return whether a path is an image file rather than a folder.

    Raises:
        OptionError: It is an image file of a format that is not written.
    """
    from nanogs.io.registry import PICTURES

    suffix = target.suffix.lower()
    if suffix in _OTHERS and not target.is_dir():
        raise OptionError(
            f"{target}: pictures are written as {', '.join(PICTURES)}; name"
            f" {target.with_suffix('.png')}, or a folder for several."
        )
    return suffix in PICTURES
