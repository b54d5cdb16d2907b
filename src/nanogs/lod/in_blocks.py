"""Levels of a model that does not fit into memory, as a folder of `.ply` files."""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nanogs._version import __version__
from nanogs.io.folder import atomic_folder
from nanogs.lod.layout import made_files
from nanogs.lod.levels import check_ratios
from nanogs.lod.manifest import Manifest, describe_level
from nanogs.lod.ply_levels import PlyLevels, level_name
from nanogs.report import SimplifyReport, StageClock
from nanogs.scale.api import block_parameters, job_folder, plan_job
from nanogs.simplify.job import NanPolicy
from nanogs.simplify.target import Goal

if TYPE_CHECKING:
    from nanogs.scale.job import Where
    from nanogs.scale.run import Progress


def write_levels_in_blocks(
    inputs: Sequence[Path],
    folder: Path,
    ratios: Sequence[float],
    *,
    preset: str,
    max_memory: int | None,
    block: int | None = None,
    job: Path | None = None,
    scratch: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    nan: NanPolicy = "drop",
    where: "Where",
    progress: "Progress",
    **overrides: Any,  # noqa: ANN401 - checked against the preset's parameters
) -> tuple[Manifest, tuple[SimplifyReport, ...]]:
    """Make the levels from one forest of each block; all of the folder appears or nothing.

    Args:
        inputs: The parts of one scene.
        folder: The folder to make.
        ratios: As `levels` takes them.
        preset: `default` or `fast`.
        max_memory: As `simplify_blocks` takes it, and so are `block`, `job`, `scratch`, `resume`,
            `nan` and the overrides.
        block: See there.
        job: See there.
        scratch: See there.
        resume: See there.
        overwrite: Replace the folder if it holds nothing but earlier levels.
        nan: See there.
        where: The tasks are done.
        progress: Told of each stage.
        **overrides: See there.

    Returns:
        What the manifest says, and the report of each level.

    Raises:
        NanogsError: As for `simplify_blocks`, or the folder may not be replaced.
    """
    from nanogs.scale.job import BlockJob
    from nanogs.scale.outcome import report_of

    start, clock = time.perf_counter(), StageClock()
    check_ratios(ratios)
    goals = [Goal(ratio=ratio) for ratio in ratios]
    chosen = block_parameters(preset, overrides)
    settings, _ = plan_job(inputs, goals, chosen, max_memory, block, nan)
    with atomic_folder(folder, made_files, overwrite=overwrite) as temporary:
        files = tuple(temporary / level_name(level) for level in range(len(ratios)))
        kept = job_folder(folder, job)
        done, counts = BlockJob(settings, kept, scratch, files, {}, overwrite=False).run(
            where, clock, progress, resume=resume
        )
        reports = tuple(
            report_of(preset, goal, done, counts[level], clock, start, level)
            for level, goal in enumerate(goals)
        )
        first = reports[0]
        manifest = Manifest(
            generator=f"nanogs {__version__}",
            source=inputs[0].name,
            source_count=first.input_count,
            preset=preset,
            parameters=first.parameters,
            levels=tuple(
                describe_level(file, goal.ratio or 1, report, first.total_seconds if not i else 0)
                for i, (file, goal, report) in enumerate(zip(files, goals, reports, strict=True))
            ),
            notes=first.notes,
        )
        PlyLevels(temporary).finish(manifest)
    return manifest, tuple(replace(report, seconds=clock.seconds) for report in reports)
