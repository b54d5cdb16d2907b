"""The contents of a folder of levels, as `levels.json` in a folder of plain files has them."""

import hashlib
import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from nanogs.protocol import Judged, Protocol
from nanogs.report import SimplifyReport, StopReason

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
    """

    file: str
    ratio: float
    count: int
    bytes: int
    sha256: str
    psnr: float | None
    ssim: float | None
    stop: StopReason


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
    """

    files: tuple[str, ...]
    ratio: float
    count: int
    bytes: int
    psnr: float | None
    ssim: float | None
    stop: StopReason


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
    """

    generator: str
    source: str
    source_count: int
    preset: str
    parameters: dict[str, float | int | str | bool]
    levels: tuple[Level | ChunkedLevel, ...]
    notes: tuple[str, ...]
    protocol: Protocol | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionaries, lists, numbers and strings."""
        return {"format": FORMAT, "version": VERSION, **asdict(self)}


def describe_level(file: Path, ratio: float, report: SimplifyReport) -> Level:
    """One entry, from the file as it was written."""
    return Level(
        file=file.name,
        ratio=ratio,
        count=report.achieved_count,
        bytes=file.stat().st_size,
        sha256=_sha256(file),
        psnr=None,
        ssim=None,
        stop=report.stop,
    )


def describe_chunks(
    files: tuple[str, ...], size: int, ratio: float, report: SimplifyReport
) -> ChunkedLevel:
    """One entry of a level in chunks, whose files take `size` bytes."""
    return ChunkedLevel(files, ratio, report.achieved_count, size, None, None, report.stop)


def judged_level(entry: Level | ChunkedLevel, judged: Judged) -> Level | ChunkedLevel:
    """The entry with what was measured; JSON has no infinity."""
    psnr = judged.psnr if math.isfinite(judged.psnr) else None
    return replace(entry, psnr=psnr, ssim=judged.ssim)


def made_files(folder: Path) -> frozenset[str] | None:
    """Names of the files of a folder of levels, its manifest among them; None for other folders."""
    try:
        data = json.loads((folder / NAME).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        return None
    names = {NAME, *_files(data.get("levels"))}
    # Plain names only: a manifest that someone changed must not lead out of its folder.
    return frozenset(name for name in names if Path(name).name == name)


def level_counts(folder: Path) -> tuple[int, ...]:
    """Splats of each level as `levels.json` has them, the finest first; none in other folders."""
    if made_files(folder) is None:
        return ()
    entries = json.loads((folder / NAME).read_text(encoding="utf-8")).get("levels")
    counts = [entry.get("count") for entry in entries if isinstance(entry, dict)]
    return tuple(count for count in counts if isinstance(count, int))


def _files(levels: object) -> Iterable[str]:
    entries = levels if isinstance(levels, list) else []
    files = (entry.get("file") for entry in entries if isinstance(entry, dict))
    return (name for name in files if isinstance(name, str))


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
