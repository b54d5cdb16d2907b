"""`nanogs.packing_cost`: the loss of quality due to packed formats alone.

A small file differs from the original for two reasons: it has fewer splats, and the format
quantises their values. This module measures the second alone. Numba is not imported until something
is rendered.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nanogs.bar import show_progress
from nanogs.cleanup import temporary_folder
from nanogs.formatting import bytes_text, number_text
from nanogs.io import open as open_model
from nanogs.io.collect import model_in
from nanogs.io.format import FormatOptions
from nanogs.io.models import Model, opened
from nanogs.io.registry import META
from nanogs.io.urls import as_path
from nanogs.memory import allowed_memory
from nanogs.memory_estimates import pictures_bytes
from nanogs.progress import Progress, Stage, Tracker
from nanogs.protocol import PIXELS, VIEWS, Judged
from nanogs.quantities import as_bytes
from nanogs.scoring.needed import needed_bytes
from nanogs.scoring.packing import (
    PackingFormats,
    notes_on,
    packing_of,
    refuse_packed,
    refuse_too_large_to_pack,
    write_packed,
)
from nanogs.source import Source, source_of
from nanogs.splats import Splats

if TYPE_CHECKING:
    from nanogs.scoring.held_out import HeldOut

_SLOW = {".sog": 8.0, META: 8.0}  # time to write relative to reading; 1 for others


@dataclass(frozen=True, slots=True)
class PackedFile:
    """A model written in one format: size and quality.

    Attributes:
        format: Suffix of the format.
        file_bytes: Size of the file, or of all files of a folder, bytes.
        splats: Number of splats in it.
        judged: Scores of the model read back from the file, against the model itself.
    """

    format: str
    file_bytes: int
    splats: int
    judged: Judged

    @property
    def splat_bytes(self) -> float:
        """Bytes per splat."""
        return self.file_bytes / self.splats

    @property
    def text(self) -> str:
        """Size and scores: "1.2 MB, 14.3 bytes a splat; 41.20 dB / 0.9912 of the model ..."."""
        size = f"{bytes_text(self.file_bytes)}, {number_text(self.splat_bytes, 1)} bytes a splat"
        scores = f"{number_text(self.judged.psnr)} dB / {number_text(self.judged.ssim, 4)}"
        return f"{size}; {scores} of the model unpacked"

    def to_dict(self) -> dict[str, Any]:
        """Return plain dictionaries, lists, numbers and strings."""
        return {**asdict(self), "splat_bytes": self.splat_bytes}


@dataclass(frozen=True, slots=True)
class PackingCost:
    """The result of `packing_cost`.

    Attributes:
        files: One for each format, in the given order.
        notes: Remarks that matter for reading the numbers, one sentence each.
    """

    files: tuple[PackedFile, ...]
    notes: tuple[str, ...]


def packing_cost(
    model: Model,
    formats: str | Sequence[str],
    *,
    format_options: FormatOptions | None = None,
    threads: int | None = None,
    max_memory: int | str | None = None,
    progress: Progress | bool | None = None,
) -> PackingCost:
    """Measure the loss due to packing: write a model, read it back, and compare their renders.

    The views are those of `compare` at its defaults. Only one temporary file exists at a time.

    Args:
        model: The model, or its path.
        formats: Suffix of a format, or several, such as [".sog", ".spz"].
        format_options: As for `save`; each format gets those that it supports.
        threads: Threads to use; all by default. The result does not depend on it.
        max_memory: Bytes that this process may take, a number or a text such as "4GB"; by default
            the free memory, less a tenth. A model that does not fit is read some rows at a time:
            the numbers are the same.
        progress: True for a bar, in a notebook or on a terminal, or a function that is called with
            each `nanogs.progress.Step`.

    Returns:
        For each format the size of the file, and PSNR and SSIM of the model read back from it,
        against the model itself.

    Raises:
        FormatError: The model cannot be read.
        ModelError: Nothing of the model is visible, or a format cannot hold it at all.
        NotEnoughMemoryError: It takes more memory than is free or allowed, even row by row.
        OptionError: nanogs cannot write or read a format, no format supports an option, or the
            model's file already has the format.
        OutputError: A file cannot be written.
    """
    packing = packing_of(formats, format_options)
    limit = None if max_memory is None else as_bytes(max_memory)
    with ExitStack() as stack:
        given = model_in(as_path(model)) if isinstance(model, str | PathLike) else model
        source = stack.enter_context(opened(given))
        refuse_packed(source, packing)
        tracker = Tracker(stack.enter_context(show_progress(progress)), _stages(packing))
        from nanogs.threads import use_threads  # imported here because it imports Numba

        with use_threads(threads):
            files = _measured(source, packing, limit, tracker)
        tracker.finish()
    return PackingCost(files, notes_on(source))


def _stages(packing: PackingFormats) -> list[Stage]:
    stages = [Stage("read", 1.0), Stage("render", 4.0)]
    for suffix in packing:
        stages += [Stage("write", _SLOW.get(suffix, 1.0)), Stage("score", 4.0)]
    return stages


def _measured(
    source: Splats | Source,
    packing: PackingFormats,
    limit: int | None,
    tracker: Tracker,
) -> tuple[PackedFile, ...]:
    """Write and score the files; the model is loaded if it fits in memory twice."""
    from nanogs.scoring.held_out import held_out

    tracker.begin("read")
    both = [source, source_of(source)]
    needed = needed_bytes(both, PIXELS**2, VIEWS, all_of_it=limit is not None)
    held = needed <= allowed_memory(limit).bytes
    refuse_too_large_to_pack(source, packing, limit, pictures_bytes(PIXELS**2, VIEWS))
    model = source_of(source).load() if held else source
    tracker.begin("render")
    views = held_out(model, tracker.part, limit)
    files = []
    for suffix, options in packing.items():
        with temporary_folder("nanogs-") as folder:
            tracker.begin("write")
            path = write_packed(model, suffix, options, folder, tracker.passing())
            tracker.begin("score")
            files.append(PackedFile(suffix, *_read_back(path, views, held)))
    return tuple(files)


def _read_back(path: Path, views: "HeldOut", held: bool) -> tuple[int, int, Judged]:
    """Return size, number of splats and scores of a file."""
    with open_model(path) as file:
        judged = views.judge(file.load() if held else file)
        return file.info.file_bytes, file.count, judged
