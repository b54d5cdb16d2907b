"""A file as the shown command writes it."""

import os
from pathlib import Path
from typing import Any

import nanogs
from nanogs.formatting import plain
from nanogs.io import bytes_on_disk
from nanogs.pipeline.request import Request, plan_files
from nanogs.pipeline.target import Goal
from nanogs.progress import Progress
from nanogs.report import SimplifyReport
from nanogs.studio.held import Held
from nanogs.studio.orders import Order

Event = dict[str, Any]


def save(order: Order, held: Held, progress: Progress) -> Event:
    """Write what is ordered; the event that says so.

    Raises:
        NanogsError: It cannot be written.
    """
    replaced = os.path.lexists(order.path)
    _make_room(order, held)
    arguments = order.arguments()
    said: Event = {
        "type": "saved", "path": order.path.as_posix(), "command": order.command(),
        "replaced": replaced,
    }  # fmt: skip
    if order.choice.levels is None:
        report = nanogs.simplify_blocks(**arguments, progress=progress)
        size = bytes_on_disk(order.path)
        return said | {"bytes": size, "report": plain(report.to_dict()), "short": _short(report)}
    manifest, reports = nanogs.write_levels(**arguments, progress=progress)
    short = [sentence for report in reports if (sentence := _short(report))]
    size = _all_bytes(order.output.folder)
    told = {"levels": [report.to_dict() for report in reports], "notes": manifest.notes}
    return said | {"bytes": size, "report": plain(told), "short": " ".join(short) or None}


def _all_bytes(path: Path) -> int:
    """Bytes of a file, or of all files of a folder."""
    files = [path] if path.is_file() else [each for each in path.rglob("*") if each.is_file()]
    return sum(each.stat().st_size for each in files)


def _make_room(order: Order, held: Held) -> None:
    """Let go of the forest where there is too little memory for it beside what saving takes."""
    manner, goal = held.manner, order.choice.goal
    levels = order.choice.levels
    request = Request(
        inputs=(order.scene.path,), output=order.path, preset=order.choice.preset,
        goal=goal if levels is None else Goal(ratio=levels[0]), ratios=levels or (),
        max_memory=manner.max_memory, measured=None,
    )  # fmt: skip
    if manner.max_memory is not None or plan_files(request).divided:
        held.forget()


def _short(report: SimplifyReport) -> str | None:
    """A sentence about a result that is not what was asked for."""
    if report.stop.met:
        return None
    return f"It stopped before what was asked: {str(report.stop).replace('_', ' ')}."
