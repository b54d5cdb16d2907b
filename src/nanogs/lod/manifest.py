"""The manifest of levels, which is written as `levels.json` in a folder with one file per level."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from nanogs.formatting import counted
from nanogs.io.generator import GENERATOR
from nanogs.io.json_fields import is_plain
from nanogs.io.registry import LEVEL_LIST
from nanogs.protocol import Protocol
from nanogs.report import SimplifyReport, StopReason
from nanogs.sink import EnvironmentWritten, Written
from nanogs.switches import GOOD_PSNR, GOOD_SSIM, SwitchQuality

NAME = LEVEL_LIST
FORMAT = "nanogs-levels"
VERSION = 1
_WHAT_HELPS = (
    f"A switch is visible below {GOOD_PSNR:g} dB or {GOOD_SSIM:g}, where a difference is more than"
    " slight; give more levels or larger ratios, or use the preset `best`."
)


@dataclass(frozen=True, slots=True)
class Level:
    """A level of detail in a file of its own.

    Attributes:
        file: Name of its file in the folder.
        ratio: The requested compaction ratio.
        count: Number of splats.
        bytes: Size of its file.
        sha256: Hash of its file, hexadecimal.
        psnr: PSNR in dB, as `nanogs compare` measures the file; None if not measured.
        ssim: SSIM over the same views, or None.
        stop: Why its merging stopped.
        draws: Splats per pixel over the same views, as a share of the original's; None if not
            measured.
    """

    file: str
    ratio: float
    count: int
    bytes: int
    sha256: str
    psnr: float | None
    ssim: float | None
    stop: StopReason
    draws: float | None = None


@dataclass(frozen=True, slots=True)
class ChunkedLevel:
    """A level of detail in chunks.

    Attributes:
        files: The chunks' files in the folder, in the order of their cells.
        ratio: The requested compaction ratio.
        count: Number of splats in all of them.
        bytes: Size of these files and of those that they refer to.
        psnr: As in `Level`.
        ssim: As in `Level`.
        stop: Why its merging stopped.
        draws: As in `Level`.
        requests: Number of all these files, each of which a viewer requests.
        switch: Quality at the distance where a viewer switches to it; None for the finest level,
            and if not measured.
    """

    files: tuple[str, ...]
    ratio: float
    count: int
    bytes: int
    psnr: float | None
    ssim: float | None
    stop: StopReason
    draws: float | None = None
    requests: int = 0
    switch: SwitchQuality | None = None


@dataclass(frozen=True, slots=True)
class EnvironmentFile:
    """The environment that is drawn with every level, as an entry of the manifest.

    Attributes:
        source: The name of its file, or "auto" if it was found in the model.
        count: Number of splats.
        bytes: Size of its files.
        requests: Number of these files, each of which a viewer requests.
    """

    source: str
    count: int
    bytes: int
    requests: int


@dataclass(frozen=True, slots=True)
class Manifest:
    """The contents of `levels.json`, besides its format and version.

    Attributes:
        generator: The program and its version.
        source: Name of the model's file, without its folder.
        source_count: Number of its splats.
        preset: Name of the preset.
        parameters: Every parameter of the method by name.
        levels: From the finest to the coarsest.
        notes: Further information for the user, one sentence each.
        protocol: How PSNR and SSIM were measured, or None.
        environment: The environment drawn with every level, or None.
    """

    generator: str
    source: str
    source_count: int
    preset: str
    parameters: dict[str, float | int | str | bool]
    levels: tuple[Level | ChunkedLevel, ...]
    notes: tuple[str, ...]
    protocol: Protocol | None = None
    environment: EnvironmentFile | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of `levels.json` as dictionaries, lists, numbers and strings."""
        return {"format": FORMAT, "version": VERSION, **asdict(self)}


def describe_levels(
    source: str, reports: Sequence[SimplifyReport], written: Sequence[Written]
) -> Manifest:
    """Make the manifest of levels, the finest first.

    Args:
        source: Name of the model.
        reports: The report of each level.
        written: The record of each level's files.
    """
    first = reports[0]
    notes = [note for report in reports for note in report.notes]
    notes += _equal_levels([report.achieved_count for report in reports])
    for level, each in enumerate(written):
        # Losses of coarser levels are listed only if a finer one does not have the same.
        prefix = f"Level {level}: " if level else ""
        notes += [prefix + loss for loss in each.losses if loss not in notes]
        notes += each.notes
    notes += _seen_switches(written)
    beside = written[0].beside
    return Manifest(
        generator=GENERATOR,
        source=source,
        source_count=first.input_count + (beside.moved if beside else 0),
        preset=first.preset,
        parameters=first.parameters,
        levels=tuple(map(_entry, reports, written)),
        notes=tuple(dict.fromkeys(notes)),
        protocol=next((each.scores.protocol for each in written if each.scores), None),
        environment=None if beside is None else _environment_of(beside),
    )


def _environment_of(written: EnvironmentWritten) -> EnvironmentFile:
    return EnvironmentFile(written.source, written.splats, written.bytes, written.requests)


def _equal_levels(counts: Sequence[int]) -> list[str]:
    """Return a note for each run of levels of one count, as a model of very few splats has."""
    notes, first = [], 0
    for count, run in groupby(counts):
        last = first + len(list(run)) - 1
        if last > first:
            each = counted(count, "splat")
            notes.append(f"Levels {first} to {last} have {each} each; fewer levels would do.")
        first = last + 1
    return notes


def _seen_switches(written: Sequence[Written]) -> list[str]:
    """Return a note for each level whose switch is visible, and one on what helps, if any is."""
    notes = [
        f"Level {level}: the switch to it is visible in a viewer ({each.switched.text})."
        for level, each in enumerate(written)
        if each.switched and each.switched.seen
    ]
    return [*notes, _WHAT_HELPS] if notes else []


def _entry(report: SimplifyReport, written: Written) -> Level | ChunkedLevel:
    ratio = report.asked_ratio
    assert ratio is not None, "levels are asked for by their ratios"  # noqa: S101
    psnr, ssim, _ = written.judged or (None, None, 0)
    draws = written.drawn[0].share_of(written.drawn[1]) if written.drawn else None
    if not written.sha256:
        return ChunkedLevel(
            tuple(written.files), ratio, report.achieved_count, written.bytes, psnr, ssim,
            report.stop, draws, written.requests, written.switched,
        )  # fmt: skip
    return Level(
        written.files[0], ratio, report.achieved_count, written.bytes, written.sha256, psnr, ssim,
        report.stop, draws,
    )  # fmt: skip


def made_files(folder: Path) -> frozenset[str] | None:
    """Return the files of a folder of levels, its manifest included; None for other folders."""
    entries = _entries(folder)
    if entries is None:
        return None
    names = {name for entry in entries if isinstance(name := entry.get("file"), str)}
    # Plain names only: an edited manifest must not lead out of its folder.
    return frozenset({NAME, *filter(is_plain, names)})


def level_counts(folder: Path) -> tuple[int, ...]:
    """Return each level's number of splats from `levels.json`, the finest first; () if none."""
    counts = [entry.get("count") for entry in _entries(folder) or ()]
    return tuple(count for count in counts if isinstance(count, int))


def _entries(folder: Path) -> list[dict[str, Any]] | None:
    """Read the entries of levels in `levels.json`, unchecked; None for other folders."""
    try:
        data = json.loads((folder / NAME).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        return None
    levels = data.get("levels")
    return [each for each in levels if isinstance(each, dict)] if isinstance(levels, list) else []
