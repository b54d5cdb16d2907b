"""The contents of a folder of levels, as `levels.json` in a folder of plain files has them."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from nanogs._version import __version__
from nanogs.io.json_fields import is_plain
from nanogs.protocol import Protocol
from nanogs.report import SimplifyReport, StopReason
from nanogs.sink import Written
from nanogs.switches import GOOD_PSNR, GOOD_SSIM, Switch

NAME = "levels.json"
FORMAT = "nanogs-levels"
VERSION = 1


@dataclass(frozen=True, slots=True)
class Level:
    """One level of detail in a file of its own.

    Attributes:
        file: Name of its file in the folder.
        ratio: The compaction ratio asked for.
        count: Splats in it.
        bytes: Size of its file.
        sha256: Of its file, hexadecimal.
        psnr: As `nanogs compare` measures its file, dB; None where that was not measured or where
            every view equals the original's.
        ssim: Over the same views, or None.
        stop: Why its merging stopped.
        draws: Splats a pixel over the same views, as a share of the original's; None where that was
            not measured.
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
    """One level of detail in chunks.

    Attributes:
        files: The chunks' files in the folder, in the order of their cells.
        ratio: The compaction ratio asked for.
        count: Splats in all of them.
        bytes: Size of these files and of those that they name.
        psnr: As in `Level`.
        ssim: As in `Level`.
        stop: Why its merging stopped.
        draws: As in `Level`.
        requests: All these files, each of which a viewer asks for.
        switch: How it looks where a viewer begins to draw it; None of the finest, and where that
            was not measured.
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
    switch: Switch | None = None


@dataclass(frozen=True, slots=True)
class EnvironmentFile:
    """The environment that is drawn with every level, as the manifest lists it.

    Attributes:
        source: Where it is from: the name of its file, or "auto" where it was found in the model.
        count: Splats in it.
        bytes: Size of its files.
        requests: These files, each of which a viewer asks for.
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
        source_count: Splats in it.
        preset: Name of the preset.
        parameters: Every parameter of the method by name.
        levels: From the finest to the coarsest.
        notes: What else the user should know, one sentence each.
        protocol: How PSNR and SSIM were measured, or None.
        environment: What belongs to every level beside them, or None.
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
        """Plain dictionaries, lists, numbers and strings."""
        return {"format": FORMAT, "version": VERSION, **asdict(self)}


def describe_levels(
    source: str, reports: Sequence[SimplifyReport], written: Sequence[Written]
) -> Manifest:
    """Describe levels, the finest first, as they were made and written.

    Args:
        source: Name of the model.
        reports: Of each level.
        written: Files of each level.
    """
    first = reports[0]
    notes = [note for report in reports for note in report.notes]
    for level, each in enumerate(written):
        # Said once of the finest level, and of others where it is not the same.
        prefix = f"Level {level}: " if level else ""
        notes += [prefix + loss for loss in each.losses if loss not in notes]
        notes += each.notes
        if each.switched and each.switched.seen:
            notes.append(_seen_note(level, each.switched))
    *beside, taken = written[0].environment or (0,)
    return Manifest(
        generator=f"nanogs {__version__}",
        source=source,
        source_count=first.input_count + taken,
        preset=first.preset,
        parameters=first.parameters,
        levels=tuple(map(_entry, reports, written)),
        notes=tuple(dict.fromkeys(notes)),
        protocol=next((each.marks.protocol for each in written if each.marks), None),
        environment=EnvironmentFile(*beside) if beside else None,
    )


def _seen_note(level: int, switch: Switch) -> str:
    return (
        f"Level {level}: one sees a viewer switch to it ({switch.text}; below {GOOD_PSNR:g} dB or"
        f" {GOOD_SSIM:g} a difference is more than slight). Give more levels or larger ratios, or"
        " the preset `best`."
    )


def _entry(report: SimplifyReport, written: Written) -> Level | ChunkedLevel:
    ratio = report.asked_ratio
    assert ratio is not None, "levels are asked for by their ratios"  # noqa: S101
    psnr, ssim, _ = written.judged or (None, None, 0)
    if psnr == math.inf:  # of which JSON has none
        psnr = None
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
    """Names of the files of a folder of levels, its manifest among them; None for other folders."""
    entries = _entries(folder)
    if entries is None:
        return None
    names = {name for entry in entries if isinstance(name := entry.get("file"), str)}
    # Plain names only: a manifest that someone changed must not lead out of its folder.
    return frozenset({NAME, *filter(is_plain, names)})


def level_counts(folder: Path) -> tuple[int, ...]:
    """Splats of each level as `levels.json` has them, the finest first; none in other folders."""
    counts = [entry.get("count") for entry in _entries(folder) or ()]
    return tuple(count for count in counts if isinstance(count, int))


def _entries(folder: Path) -> list[dict[str, Any]] | None:
    """The levels that `levels.json` lists, unchecked; None in other folders."""
    try:
        data = json.loads((folder / NAME).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        return None
    levels = data.get("levels")
    return [each for each in levels if isinstance(each, dict)] if isinstance(levels, list) else []
