"""`nanogs convert` of a file, and the report of it."""

import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from nanogs import memory, needs
from nanogs.cli.console import arrow, say, warn, with_file_seconds
from nanogs.cli.filtering import report_filters
from nanogs.cli.framing import Frames
from nanogs.clock import StageClock
from nanogs.filters import Filter, apply
from nanogs.formatting import counted, sizes_text, time_text
from nanogs.frames import change_frame
from nanogs.io import bytes_on_disk, inspect, load, losses, registry, save
from nanogs.io.collect import Pair
from nanogs.pipeline.stages import read_weight, write_weight
from nanogs.progress import Progress, Stage, Tracker
from nanogs.splats import RenderMode, Splats


def print_report(run: dict[str, Any]) -> None:
    """Show on stderr what became of a file, and what was lost."""
    report_filters(run)
    for note in (*run["notes"], *run["losses"]):
        warn(note)
    what = f"{counted(run['splats'], 'splat')} of SH degree {run['sh_degree']} in {run['output']}"
    sizes = sizes_text(run["input_bytes"], run["output_bytes"], arrow())
    say(f"{what}, {sizes}, {time_text(run['total_seconds'])}")


def refuse_too_large(pair: Pair, level: int, max_memory: int | None) -> None:
    """Refuse a conversion that takes more memory than there is.

    Args:
        pair: What is read and written.
        level: Of a streamed model.
        max_memory: Bytes that this process may take; None for what is free.

    Raises:
        NotEnoughMemoryError: It takes more.
    """
    info = inspect(pair.source, level=level)
    known = registry.find(pair.target)
    compiled = known is not None and known.suffix == ".sog"
    memory.refuse_too_large(
        f"Converting {pair.source}",
        needs.convert_bytes(info, pair.target),
        memory.allowed_memory(max_memory, compiled=compiled),
        "free some, or make a smaller model with `nanogs simplify` first, which works in blocks",
    )


def convert_file(
    pair: Pair,
    filters: Sequence[Filter],
    sh_degree: int | None,
    frames: Frames | None,
    *,
    level: int,
    saving: dict[str, Any],
    told: Progress,
) -> dict[str, Any]:
    """Read and write; the report."""
    source, target = pair.source, pair.target
    start, clock = time.perf_counter(), StageClock()
    typical = 1_000_000  # only how the two compare counts
    write = Stage("write", write_weight(target.suffix, typical))
    stages = [Stage("read", read_weight(typical)), write]
    progress = Tracker(told, stages)
    progress.begin("read")
    with clock.time("read"):
        splats = load(source, level=level)
    # Asked now, as the output may take the place of the input.
    read_bytes = inspect(source, level=level).file_bytes
    splats, took = apply(splats, filters)
    if sh_degree is not None:
        splats = splats.with_sh_degree(sh_degree)
    if frames:
        splats = change_frame(splats, *frames)
    progress.begin("write")
    with clock.time("write"):
        save(splats, target, progress=progress.passing(), **saving)
    progress.finish()
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
    """Describe the file that was written, by its own header where it can be read."""
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
