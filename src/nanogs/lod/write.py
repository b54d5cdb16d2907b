"""Write the levels of a model into a folder, one at a time, with their `levels.json`."""

import json
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from nanogs._version import __version__
from nanogs.io import save
from nanogs.io.folder import atomic_folder
from nanogs.lod.levels import levels
from nanogs.lod.manifest import NAME, Level, Manifest, describe_level, made_files
from nanogs.report import SimplifyReport
from nanogs.splats import Splats


def write_levels(
    splats: Splats,
    folder: Path,
    ratios: Sequence[float],
    *,
    source: str,
    overwrite: bool = False,
    progress: Callable[[str, int], None] | None = None,
    **options: Any,  # noqa: ANN401 - as `levels` takes them
) -> tuple[Manifest, tuple[SimplifyReport, ...]]:
    """Make `level_0.ply`, the finest, and so on, and `levels.json`; all of it or nothing.

    Args:
        splats: The model.
        folder: The folder to make.
        ratios: As `levels` takes them.
        source: Name of the model for the manifest.
        overwrite: Replace the folder if it holds nothing but earlier levels.
        progress: Called before each stage with its name and the number of splats left.
        **options: As `levels` takes them.

    Returns:
        What the manifest says, and the report of each level.

    Raises:
        OptionError: As for `levels`.
        ModelError: As for `levels`.
        OutputError: The folder may not be replaced, or it cannot be written.
    """
    entries: list[Level] = []
    reports: list[SimplifyReport] = []
    made = levels(splats, ratios, progress=progress, **options)
    with atomic_folder(folder, made_files, overwrite=overwrite) as temporary:
        for ratio in ratios:
            start = time.perf_counter()
            path = temporary / level_name(len(entries))
            reports.append(_write_next(made, path, progress))
            seconds = time.perf_counter() - start
            entries.append(describe_level(path, ratio, reports[-1], seconds))
        manifest = _manifest(source, entries, reports)
        text = json.dumps(manifest.to_dict(), indent=2, allow_nan=False)
        (temporary / NAME).write_text(text + "\n", encoding="utf-8")
    return manifest, tuple(reports)


def level_name(level: int) -> str:
    """The file of a level; 0 is the finest."""
    return f"level_{level}.ply"


def _write_next(
    made: Iterator[tuple[Splats, SimplifyReport]],
    path: Path,
    progress: Callable[[str, int], None] | None,
) -> SimplifyReport:
    """Make and write one level; nothing of it is kept but its report."""
    small, report = next(made)
    if progress:
        progress("write", len(small))
    save(small, path)
    return report


def _manifest(source: str, entries: list[Level], reports: list[SimplifyReport]) -> Manifest:
    first = reports[0]
    return Manifest(
        generator=f"nanogs {__version__}",
        source=source,
        source_count=first.input_count,
        preset=first.preset,
        parameters=first.parameters,
        levels=tuple(entries),
        notes=tuple(dict.fromkeys(note for report in reports for note in report.notes)),
    )
