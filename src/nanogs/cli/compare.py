"""`nanogs compare`."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nanogs.cli import options, parsing
from nanogs.cli.groups import with_options
from nanogs.cli.looking import Given, refuse_beside_file, refuse_beside_photos
from nanogs.errors import OptionError
from nanogs.formatting import NONE, bytes_text, number_text
from nanogs.protocol import BLACK, PIXELS, Background
from nanogs.view.bundle import is_built

if TYPE_CHECKING:
    from rich.table import Table

    from nanogs.scoring.comparison import Comparison
    from nanogs.scoring.scores import ModelScore


@with_options
def compare(
    *,
    reference: Annotated[
        str,
        typer.Argument(metavar="REF", help="The original model: a file, its folder or its URL."),
    ],
    tests: Annotated[
        list[str],
        typer.Argument(
            metavar="TEST...",
            help="Models to score: files, their folders or URLs; name=path names a model, and"
            " models with the same name form a line in the plot.",
        ),
    ],
    report: Annotated[
        Path | None,
        typer.Option(
            parser=parsing.parse_page,
            metavar="PAGE",
            help="Write a page with pictures: one .html file.",
        ),
    ] = None,
    interactive: Annotated[
        bool | None,
        typer.Option(
            help="Put the models into the page, so that they can be viewed in 3D there.",
            show_default="interactive",
        ),
    ] = None,
    photos: Annotated[
        Path | None,
        typer.Option(
            parser=parsing.parse_local,
            metavar="FOLDER",
            help="Score REF and all TESTs against the photographs of this data set "
            "(folder of NeRF-Synthetic, nerfstudio or COLMAP).",
            rich_help_panel=options.VIEWS,
        ),
    ] = None,
    images: options.PhotoImages = None,
    split: options.PhotoSplit = None,
    views: options.ViewsOfKinds = None,
    sizes: options.Sizes = None,
    cameras: options.Kinds = "auto",
    up: options.Up = None,
    background: options.PhotoBackground = None,
    metrics: Annotated[
        str | None, typer.Option(help="Further metrics: flip, lpips (each needs its extra).")
    ] = None,
    render_mode: options.AsMode = None,
    packed: options.Packed = None,
    of_format: options.OfFormat,
    mixed: Annotated[
        bool,
        typer.Option(
            "--mixed",
            help="Draw each TEST, a lod-meta.json or .ssog, as a viewer does: near chunks fine, far"
            " ones coarse.",
        ),
    ] = False,
    budget: Annotated[
        int | None,
        typer.Option(
            parser=lambda text: parsing.parse_count(text, "--budget"),
            metavar="COUNT",
            help="Most splats that this viewer draws at once, e.g. 1M.",
            show_default="no limit, levels by distance alone",
        ),
    ] = None,
    device: options.Device = "cpu",
    run: options.Running,
) -> None:
    """Score models against the original, on views that no method has used."""
    # Imported here because `--help` does not need it.
    from nanogs.cli.console import warn
    from nanogs.cli.fetching import fetched
    from nanogs.cli.progress import shown
    from nanogs.io.atomic import check_writable

    formats = parsing.parse_packed(packed, of_format)
    pixels = parsing.parse_sizes(str(PIXELS) if sizes is None else sizes)
    color = None if background is None else parsing.parse_background(background)
    extras = parsing.parse_metrics(metrics)
    if interactive is not None and not report:
        option = "--interactive" if interactive else "--no-interactive"
        raise OptionError(f"{option} works only with --report; give both, or leave it out.")
    interactive = interactive is not False
    # --up is allowed beside photographs if there is an interactive page, whose models it orients.
    found: Given = {"--views": views, "--sizes": sizes}
    found["--up"] = None if report and interactive else up
    if not mixed:
        kinds = None if cameras == "auto" else cameras
        of_photos: Given = {"--images": images, "--split": split}
        refuse_beside_photos(photos, of_photos, {"--cameras": kinds, **found})
    refuse_beside_file(cameras, found)
    if report:
        check_writable(report, overwrite=run.overwrite)
    if report and interactive and not is_built():
        if not run.quiet:
            warn(
                "The page has no interactive part, because this installation was built without a"
                " viewer."
            )
        interactive = False
    from nanogs.card.device import device_notes, use_device
    from nanogs.scoring.run import compare_files
    from nanogs.threads import use_threads

    named = parsing.parse_named([reference, *tests])
    if budget is not None and not mixed:
        raise OptionError("--budget works only with --mixed; give both, or leave it out.")
    if mixed:
        _compare_mixed(
            named, run, budget=budget, cameras=cameras, views=views, pixels=pixels, up=up,
            background=color or BLACK, report=report, photos=photos, images=images,
            split=split, metrics=metrics, packed=packed, render_mode=render_mode,
            device="" if device == "cpu" else device,
        )  # fmt: skip
        return
    with (
        use_device(device) as used,
        fetched([path for _, path in named], quiet=run.hushed) as files,
        shown(quiet=run.hushed) as progress,
        use_threads(run.threads),
    ):
        first, *others = ((name, file) for (name, _), file in zip(named, files, strict=True))
        comparison = compare_files(
            first, others,
            cameras=cameras, views=views, sizes=pixels, up=up,
            background=color, extras=extras, photos=photos, images=images,
            split="test" if split is None else split, report=report, interactive=interactive,
            overwrite=run.overwrite, progress=progress, packed=formats, format_options=of_format,
            render_mode=render_mode, max_memory=run.max_memory,
        )  # fmt: skip
    comparison = replace(comparison, notes=(*comparison.notes, *device_notes(device, used)))
    run.report(comparison.to_dict(), partial(_show, comparison, report), comparison.all_notes)


def _compare_mixed(
    named: list[tuple[str, Path]],
    run: options.Running,
    *,
    budget: int | None,
    cameras: str,
    views: int | None,
    pixels: list[tuple[int, int]],
    up: tuple[float, float, float] | None,
    background: Background,
    **others: object,
) -> None:
    """Score streams as a viewer draws them; options that do not apply to --mixed are refused."""
    from nanogs.cli.fetching import fetched
    from nanogs.cli.mixed import refuse_others, show_mixed
    from nanogs.cli.progress import shown
    from nanogs.scoring.mixed import compare_mixed

    refuse_others(**others)
    with (
        fetched([path for _, path in named], quiet=run.hushed) as files,
        shown(quiet=run.hushed) as progress,
    ):
        found = compare_mixed(
            *files, names=[name for name, _ in named], budget=budget, cameras=cameras, views=views,
            pixels=pixels, up=up, background=background, threads=run.threads,
            max_memory=run.max_memory, progress=progress,
        )  # fmt: skip
    run.report(found.to_dict(), partial(show_mixed, found), found.notes)


def _show(comparison: "Comparison", report: Path | None) -> None:
    from nanogs.cli.console import out, say, show

    show(out, _table(comparison))
    means = ", ".join(comparison.protocol_texts)
    say(f"PSNR in dB; means over {means}; worst: the view with the lowest PSNR")
    if any(model.cost for model in comparison.models):
        first, share = comparison.reference_cost, ""
        if first:
            # With several sets each has its own.
            whole = " on the same views" if comparison.further else f", {first.pixel_text}"
            share = f"; draws: that mean as a share of the original's{whole}"
        say(f"a pixel: number of splats that cover a pixel, mean and 99th percentile{share}")
    if any(model.packed for model in comparison.models):
        show(out, _packing_table(comparison))
        say(
            "costs: PSNR and SSIM of the model minus those of its file, which is what packing"
            " alone costs; to model: PSNR of the file against the same model unpacked"
        )
    if report:
        say(f"report: {report} ({bytes_text(report.stat().st_size)})")


def _table(comparison: "Comparison") -> "Table":
    from rich.table import Table
    from rich.text import Text

    against = comparison.reference_splats
    extras = sorted({name for model in comparison.models for name in model.extras})
    table = Table("model", *(["views"] if comparison.further else []), box=None, pad_edge=False)
    headings = ["splats", *(["kept"] if against else []), "file", "PSNR", "worst", "SSIM"]
    headings += ["depth", "draws"] if against else []
    for heading in (*headings, "a pixel", *extras):
        table.add_column(heading, justify="right")
    for place in range(len(comparison.models)):
        for one in comparison.each:
            model = one.models[place]
            cells: list[str | Text] = [Text(model.name)]
            cells += [one.protocol.label] if comparison.further else []
            cells += [f"{model.splats:,}", *([f"{model.splats / against:.2%}"] if against else [])]
            cells += [bytes_text(model.file_bytes), number_text(model.psnr)]
            cells += [number_text(model.least_psnr), number_text(model.ssim, 4)]
            if against:
                cells += [number_text(model.depth, 4), _drawn_text(one, model)]
            cells.append(model.cost.pixel_text if model.cost else NONE)
            table.add_row(*cells, *(number_text(model.extras[name], 4) for name in extras))
    return table


def _drawn_text(one: "Comparison", model: "ModelScore") -> str:
    """Format the splats per pixel as a share of the original's."""
    if one.reference_cost is None or model.cost is None:
        return NONE
    return f"{model.cost.share_of(one.reference_cost):.1%}"


def _packing_table(comparison: "Comparison") -> "Table":
    """Return a table of the losses due to packing, with a row for each packed file."""
    from rich.table import Table
    from rich.text import Text

    table = Table("model", *(["views"] if comparison.further else []), box=None, pad_edge=False)
    for heading in ("bytes a splat", "costs dB", "SSIM", "to model, dB", "SSIM"):
        table.add_column(heading, justify="right")
    for place in range(len(comparison.models)):
        for one in comparison.each:
            model, packed = one.models[place], one.models[place].packed
            if packed:
                cells: list[str | Text] = [Text(model.name)]
                cells += [one.protocol.label] if comparison.further else []
                cells += [number_text((model.file_bytes or 0) / model.splats, 1)]
                cells += [number_text(packed.psnr_cost), number_text(packed.ssim_cost, 4)]
                table.add_row(*cells, number_text(packed.psnr), number_text(packed.ssim, 4))
    return table
