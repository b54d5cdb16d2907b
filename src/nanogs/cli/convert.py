"""`nanogs convert`."""

import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from nanogs.cli import filtering, framing, many, options, streams
from nanogs.cli.console import err, spinner, warn, with_file_seconds
from nanogs.errors import OptionError
from nanogs.filters import Filter, apply
from nanogs.formatting import bytes_text
from nanogs.frames import TRAINED, Y_UP, change_frame
from nanogs.io import bytes_on_disk, check_writable, inspect, load, losses, registry, save
from nanogs.io.collect import Pair
from nanogs.report import StageClock
from nanogs.splats import RenderMode, Splats

_PATIENCE = 2.0  # seconds without a sign of life


def convert(
    paths: many.Paths,
    level: Annotated[
        int,
        typer.Option(min=0, help="Level of detail to read of a lod-meta.json; 0 is the finest."),
    ] = 0,
    sh_degree: Annotated[
        int | None,
        typer.Option(help="Drop the spherical harmonics above this degree, 0 to 4."),
    ] = None,
    turn: Annotated[
        bool,
        typer.Option(
            "--turn",
            help="Turn by 180 degrees about x: from y up (SPZ by its specification) to y down"
            " (3DGS), or back. The same as --frame rub:rdf.",
        ),
    ] = False,
    frame: framing.FrameOption = None,
    spz_version: options.SpzVersion = None,
    overwrite: options.Overwrite = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
    out_dir: many.OutDir = None,
    out_format: many.FormatOption = None,
    read_as: streams.From = None,
    write_as: streams.To = None,
    crop: filtering.Crop = None,
    min_opacity: filtering.MinOpacity = None,
    drop_floaters: filtering.DropFloaters = False,
) -> None:
    """Write a model in another format; the suffixes of the names say which."""
    saving: dict[str, Any] = {"overwrite": overwrite, "spz_version": spz_version}
    filters = filtering.parse_filters(crop, min_opacity, drop_floaters=drop_floaters)
    if turn and frame:
        raise OptionError("--turn and --frame both turn the model; give one of them.")
    asked = framing.parse_frames(frame)

    def run_one(pair: Pair) -> dict[str, Any]:
        frames = (Y_UP, TRAINED) if turn else framing.frames_of(pair, asked)
        check_writable(pair.target, **saving)
        return _convert_file(
            pair, filters, sh_degree, frames, level=level, saving=saving, quiet=hushed
        )

    hushed = quiet or json
    pairs = many.plan_pairs(paths, out_dir, out_format)
    pipes = streams.Streams(read_as, write_as)
    many.run_all(pairs, run_one, _print_report, out_dir, pipes, json=json, quiet=quiet)


def _print_report(run: dict[str, Any]) -> None:
    filtering.report_filters(run)
    for note in (*run["notes"], *run["losses"]):
        warn(note)
    sizes = f"{bytes_text(run['input_bytes'])} became {bytes_text(run['output_bytes'])}"
    what = f"{run['splats']:,} splats of SH degree {run['sh_degree']}"
    err.print(f"{run['output']}: {what}; {sizes}", markup=False, soft_wrap=True)


def _convert_file(
    pair: Pair,
    filters: Sequence[Filter],
    sh_degree: int | None,
    frames: framing.Frames | None,
    *,
    level: int,
    saving: dict[str, Any],
    quiet: bool,
) -> dict[str, Any]:
    """Read and write; the report."""
    source, target = pair.source, pair.target
    start, clock = time.perf_counter(), StageClock()
    with spinner(quiet=quiet, after=_PATIENCE) as progress:
        progress(f"reading {source.name}")
        with clock.time("read"):
            splats = load(source, level=level)
        read_bytes = inspect(source).file_bytes  # now, as the output may take the input's place
        splats, took = apply(splats, filters)
        if sh_degree is not None:
            splats = splats.with_sh_degree(sh_degree)
        if frames:
            splats = change_frame(splats, *frames)
        progress(f"writing {target.name}")
        with clock.time("write"):
            save(splats, target, **saving)
    run = {
        "input": str(source),
        "output": str(target),
        "filters": [asdict(report) for report in took],
        "frames": frames,
        "input_bytes": read_bytes,
        "output_bytes": bytes_on_disk(target),
        **_written(target, splats),
        "notes": list(splats.notes),
        "losses": list(losses(splats, target)),
        "seconds": {},
    }
    return with_file_seconds(run, clock, start)


def _written(target: Path, splats: Splats) -> dict[str, Any]:
    """What the file holds, as it says itself where it can be read."""
    known = registry.find(target)
    if known is None or not known.readable:
        return {
            "format": target.suffix.lstrip("."),
            "splats": len(splats),
            "sh_degree": splats.sh_degree,
            "render_mode": RenderMode.DEFAULT.value,
        }
    info = inspect(target)
    return {
        "format": info.format,
        "splats": info.splats,
        "sh_degree": info.sh_degree,
        "render_mode": info.render_mode.value,
    }
