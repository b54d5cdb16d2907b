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
from nanogs.filters import Filter, FilterReport, apply
from nanogs.findings import join_findings
from nanogs.formatting import counted, sizes_text, time_text
from nanogs.io import bytes_on_disk, inspect, registry, save
from nanogs.io import open as open_model
from nanogs.io.collect import Pair
from nanogs.pipeline.weights import read_weight, write_weight
from nanogs.progress import Progress, Stage, Tracker
from nanogs.source import Filtered, InMemory, Reduced, Source, Turned
from nanogs.splats import RenderMode


def print_report(run: dict[str, Any]) -> None:
    """Show on stderr what became of a file, and what was lost."""
    report_filters(run)
    for note in (*run["notes"], *run["losses"]):
        warn(note)
    what = f"{counted(run['splats'], 'splat')} of SH degree {run['sh_degree']} in {run['output']}"
    sizes = sizes_text(run["input_bytes"], run["output_bytes"], arrow())
    say(f"{what}, {sizes}, {time_text(run['total_seconds'])}")


def refuse_too_large(
    pair: Pair, level: int, filters: Sequence[Filter], max_memory: int | None
) -> None:
    """Refuse a conversion that takes more memory than there is.

    Args:
        pair: What is read and written.
        level: Of a streamed model.
        filters: What leaves out splats.
        max_memory: Bytes that this process may take; None for what is free.

    Raises:
        NotEnoughMemoryError: It takes more.
    """
    known = registry.find(pair.target)
    compiled = known is not None and known.suffix == ".sog"
    with open_model(pair.source, level=level) as source:
        needed = needs.convert_bytes(source, pair.target, whole=_need_whole(filters))
    memory.refuse_too_large(
        f"Converting {pair.source}",
        needed,
        memory.allowed_memory(max_memory, compiled=compiled),
        "free some, name a .ply file, which is written in parts, or make a smaller model with"
        " `nanogs simplify` first, which works in blocks",
    )


def _need_whole(filters: Sequence[Filter]) -> bool:
    return any(each.whole for each in filters)


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
    """Read and write, some rows at a time where the formats let that be; the report."""
    source, target = pair.source, pair.target
    start, clock = time.perf_counter(), StageClock()
    typical = 1_000_000  # only how the two compare counts
    write = Stage("write", write_weight(target.suffix, typical))
    stages = [Stage("read", read_weight(typical)), write]
    progress = Tracker(told, stages)
    with open_model(source, level=level) as file:
        progress.begin("read")
        with clock.time("read"):
            model, took = _changed(file, target, filters, sh_degree, frames)
            # Asked now, as the output may take the place of the input.
            notes, lost = _said(model, target)
            count, degree, read_bytes = model.count, model.columns.sh_degree, file.info.file_bytes
        progress.begin("write")
        with clock.time("write"):
            save(model, target, progress=progress.passing(), **saving)
    progress.finish()
    run = {
        "input": str(source),
        "output": str(target),
        "filters": [asdict(report) for report in took],
        "frames": frames,
        "input_bytes": read_bytes,
        "output_bytes": bytes_on_disk(target),
        **_written(target, count, degree),
        "notes": notes,
        "losses": lost,
        "seconds": {},
    }
    return with_file_seconds(run, clock, start)


def _changed(
    source: Source,
    target: Path,
    filters: Sequence[Filter],
    sh_degree: int | None,
    frames: Frames | None,
) -> tuple[Source, tuple[FilterReport, ...]]:
    """The model as it is written, and what filters took; held whole where something needs that."""
    took: tuple[FilterReport, ...] = ()
    if _need_whole(filters):
        splats, took = apply(source.load(), filters)
        source = InMemory(splats)
    elif filters:
        source = Filtered(source, filters)
        took = source.reports
    if sh_degree is not None:
        source = Reduced(source, sh_degree)
    if frames:
        source = Turned(source, *frames)
    return source if registry.writable(target).streams else InMemory(source.load()), took


def _said(model: Source, target: Path) -> tuple[list[str], list[str]]:
    """Notes on the reading, and what the target leaves out, from one pass."""
    losses, notes, lost = registry.writable(target).losses, [model.columns.notes], []
    for block in model.blocks():
        notes.append(tuple(block.notes))
        lost.append(losses(block))
    return list(join_findings(notes)), list(join_findings(lost))


def _written(target: Path, count: int, degree: int) -> dict[str, Any]:
    """Describe the file that was written, by its own header where it can be read."""
    known = registry.find(target)
    if known is None or not known.readable:
        return {
            "format": target.suffix.lstrip("."),
            "splats": count,
            "sh_degree": degree,
            "render_mode": RenderMode.DEFAULT.value,
        }
    info = inspect(target)
    return {
        "format": info.format,
        "splats": info.splats,
        "sh_degree": info.sh_degree,
        "render_mode": info.render_mode.value,
    }
