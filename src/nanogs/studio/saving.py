"""Saving: writing the output that the shown command would write."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import nanogs
from nanogs.cleanup import cleaned_up
from nanogs.formatting import counted, number_text, plain, time_text
from nanogs.io import bytes_on_disk
from nanogs.pipeline.job.folder import job_folder
from nanogs.pipeline.options.target import Goal
from nanogs.pipeline.request import Request, plan_files
from nanogs.progress import Progress
from nanogs.report import SimplifyReport, stop_text
from nanogs.studio.cache import WorkerCache
from nanogs.studio.orders import SaveRequest

Event = dict[str, Any]


def save(order: SaveRequest, cache: WorkerCache, progress: Progress) -> Event:
    """Write the output of an order, and return the event that reports it.

    Raises:
        NanogsError: It cannot be written.
    """
    replaced = os.path.lexists(order.path)
    _make_room(order, cache)
    arguments = order.arguments()
    said: Event = {
        "type": "saved", "path": order.path.as_posix(), "command": order.command(),
        "replaced": replaced,
    }  # fmt: skip
    reports: tuple[SimplifyReport, ...]
    if order.choice.levels is None:
        with _no_job_left(order):
            report = nanogs.simplify_blocks(**arguments, progress=progress)
        said["bytes"], reports, entries = bytes_on_disk(order.path), (report,), report.to_dict()
    else:
        with _no_job_left(order):
            manifest, reports = nanogs.write_levels(**arguments, progress=progress)
        said["bytes"] = _all_bytes(order.output.folder)
        entries = {"levels": [each.to_dict() for each in reports], "notes": manifest.notes}
    short = [stop_text(each) for each in reports if not each.stop.met]
    said |= {"report": plain(entries), "short": " ".join(short) or None}
    return said | {"lines": [line for each in reports for line in _lines(each)]}


@contextmanager
def _no_job_left(order: SaveRequest) -> Iterator[None]:
    """Remove the job folder of a save in blocks that fails or is cancelled: nothing resumes it.

    One that was there before, as of a command that was interrupted, is left alone.
    """
    folder = job_folder(order.target, None)
    if os.path.lexists(folder):
        yield
        return
    with cleaned_up(partial(shutil.rmtree, folder, ignore_errors=True)):
        yield


def _lines(report: SimplifyReport) -> Iterator[tuple[str, str]]:
    """Yield the lines of a summary of a result, each as label and text."""
    yield "splats", f"{report.achieved_count:,} of {report.read_count or report.input_count:,}"
    for each in report.filters:
        yield each.name, f"took {counted(each.removed, 'splat')}"
    if report.judged is not None:
        judged = report.judged
        yield "PSNR", f"{number_text(judged.psnr)} dB, SSIM {number_text(judged.ssim, 4)}"
    yield from (("note", note) for note in report.notes)
    yield "time", time_text(report.total_seconds)


def _all_bytes(path: Path) -> int:
    """Return the bytes of a file, or of all files of a folder."""
    files = [path] if path.is_file() else [each for each in path.rglob("*") if each.is_file()]
    return sum(each.stat().st_size for each in files)


def _make_room(order: SaveRequest, cache: WorkerCache) -> None:
    """Free the scene and its forest if saving needs the memory.

    They are freed if a limit is set, or if the model would otherwise be simplified in blocks.
    """
    settings, goal = cache.settings, order.choice.goal
    levels = order.choice.levels
    request = Request(
        inputs=(order.scene.path,), output=order.path, preset=order.choice.preset,
        goal=goal if levels is None else Goal(ratio=levels[0]), ratios=levels or (),
        max_memory=settings.max_memory, measured=None,
    )  # fmt: skip
    if settings.max_memory is not None or plan_files(request).divided:
        cache.forget()
