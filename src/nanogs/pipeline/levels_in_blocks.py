"""Levels of a model that does not fit into memory, in any layout."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nanogs._version import __version__
from nanogs.clock import StageClock
from nanogs.defaults import CHUNK
from nanogs.findings import join_findings
from nanogs.lod.file_levels import FileLevels, level_name
from nanogs.lod.layout import Layout, check_options
from nanogs.lod.manifest import (
    ChunkedLevel,
    Level,
    Manifest,
    describe_chunks,
    describe_level,
)
from nanogs.pipeline.folder import job_folder
from nanogs.pipeline.in_blocks import block_memory, block_parameters, plan_job, refuse_full_disk
from nanogs.pipeline.job import NanPolicy
from nanogs.pipeline.levels import check_ratios
from nanogs.pipeline.plan import ScalePlan
from nanogs.pipeline.rows import NOTHING, Changes
from nanogs.pipeline.settings import Chunks, Settings
from nanogs.pipeline.target import Goal
from nanogs.progress import Progress
from nanogs.report import SimplifyReport

if TYPE_CHECKING:
    from nanogs.pipeline.run import Done
    from nanogs.pipeline.stored_job import Where


def plan_levels(
    inputs: Sequence[Path],
    ratios: Sequence[float],
    *,
    layout: Layout = Layout.FILES,
    chunk: int | None = None,
    plain: bool = False,
    preset: str,
    max_memory: int | None,
    block: int | None = None,
    nan: NanPolicy = "drop",
    changes: Changes = NOTHING,
    **overrides: Any,  # noqa: ANN401 - checked against the preset's parameters
) -> tuple[Settings, ScalePlan]:
    """Plan the job, and what it takes; only headers are read, but for filters all rows.

    Args:
        inputs: As `write_levels_in_blocks` takes them, and all others too.
        ratios: See there.
        layout: See there.
        chunk: See there.
        plain: See there.
        preset: See there.
        max_memory: See there.
        block: See there.
        nan: See there.
        changes: See there.
        **overrides: See there.

    Raises:
        NanogsError: An input cannot be read, options make no sense, or the memory is too little.
    """
    check_ratios(ratios)
    check_options(layout, chunk, plain=plain)
    goals = [Goal(ratio=ratio) for ratio in ratios]
    chosen = block_parameters(preset, overrides)
    chunks = chunks_of(layout, chunk, plain=plain)
    return plan_job(inputs, goals, chosen, max_memory, block, nan, chunks, changes)


def chunks_of(layout: Layout, chunk: int | None, *, plain: bool) -> Chunks | None:
    """The chunks of a layout; None where levels are plain files."""
    packed = layout is Layout.TILES and not plain
    return None if layout is Layout.FILES else Chunks(layout.value, chunk or CHUNK, packed)


def write_levels_in_blocks(
    inputs: Sequence[Path],
    folder: Path,
    ratios: Sequence[float],
    *,
    layout: Layout = Layout.FILES,
    chunk: int | None = None,
    plain: bool = False,
    preset: str,
    max_memory: int | None,
    block: int | None = None,
    job: Path | None = None,
    scratch: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    nan: NanPolicy = "drop",
    changes: Changes = NOTHING,
    where: "Where",
    progress: Progress | None = None,
    **overrides: Any,  # noqa: ANN401 - checked against the preset's parameters
) -> tuple[Manifest, tuple[SimplifyReport, ...]]:
    """Make the levels from one forest of each block; all of the folder appears or nothing.

    Args:
        inputs: The parts of one scene.
        folder: The folder to make.
        ratios: As `levels` takes them.
        layout: `.ply` files, streamed SOG, or 3D Tiles; in chunks, each block has a tree of its
            own, and what describes the folder joins them.
        chunk: As `write_levels` takes it, and so is `plain`.
        plain: See there.
        preset: `default` or `fast`.
        max_memory: As `simplify_blocks` takes it, and so are `block`, `job`, `scratch`, `resume`,
            `nan` and the overrides.
        block: See there.
        job: See there.
        scratch: See there.
        resume: See there.
        overwrite: Replace the folder if it holds nothing but earlier levels.
        nan: See there.
        changes: What else is done to the model; levels are turned as results are.
        where: The tasks are done.
        progress: As `simplify_blocks` takes it.
        **overrides: See there.

    Returns:
        What the manifest says, and the report of each level.

    Raises:
        NanogsError: As for `simplify_blocks`, or the folder may not be replaced.
    """
    from nanogs.pipeline.levels_folder import LevelsFolder
    from nanogs.pipeline.stored_job import BlockJob

    kept = job_folder(folder, job)
    max_memory, block = block_memory(
        max_memory, block, kept if resume else None, elsewhere=where.executor is not None
    )
    settings, plan = plan_levels(
        inputs, ratios, layout=layout, chunk=chunk, plain=plain, preset=preset,
        max_memory=max_memory, block=block, nan=nan, changes=changes, **overrides,
    )  # fmt: skip
    source, start = ", ".join(part.name for part in inputs), time.perf_counter()
    told = _Telling(source, preset, tuple(ratios), StageClock(), start)
    if not resume:
        refuse_full_disk(plan, kept, scratch)
    ending = LevelsFolder(folder, layout, told.write_plain, overwrite)
    done, counts = BlockJob(settings, kept, scratch, ending).run(
        where, told.clock, progress, resume=resume
    )
    manifest, reports = told.of(done, counts, folder)
    return manifest, tuple(replace(report, seconds=told.clock.seconds) for report in reports)


@dataclass(frozen=True, slots=True)
class _Telling:
    """Describes the levels once they are made."""

    source: str
    preset: str
    ratios: tuple[float, ...]
    clock: StageClock
    start: float

    def write_plain(self, done: "Done", counts: list[int], folder: Path) -> None:
        """Write the manifest of plain levels beside them."""
        FileLevels(folder).finish(self.of(done, counts, folder)[0])

    def of(
        self, done: "Done", counts: list[int], folder: Path
    ) -> tuple[Manifest, list[SimplifyReport]]:
        """The manifest and the report of each level, all of whose files are in a folder."""
        from nanogs.pipeline.job_report import report_of

        reports = [
            report_of(self.preset, Goal(ratio=r), done, counts[n], self.clock, self.start, n)
            for n, r in enumerate(self.ratios)
        ]
        manifest = Manifest(
            generator=f"nanogs {__version__}",
            source=self.source,
            source_count=reports[0].input_count,
            preset=self.preset,
            parameters=reports[0].parameters,
            levels=tuple(
                _entry(done, folder, level, ratio, report)
                for level, (ratio, report) in enumerate(zip(self.ratios, reports, strict=True))
            ),
            notes=(*reports[0].notes, *_left_out(done)),
        )
        return manifest, reports


def _entry(
    done: "Done", folder: Path, level: int, ratio: float, report: SimplifyReport
) -> Level | ChunkedLevel:
    """The manifest's entry of a level."""
    if done.work.settings.chunks is None:
        return describe_level(folder / level_name(level), ratio, report)
    records = done.work.of_blocks("chunk", level)
    # A model in a folder of its own is named by what describes it.
    files = [name for record in records for name in record.columns]
    named = [name for name in files if "/" not in name or name.endswith("/meta.json")]
    size = sum(file.nbytes for record in records for file in record.columns.values())
    return describe_chunks(tuple(named), size, ratio, report)


def _left_out(done: "Done") -> list[str]:
    """Name what the files leave out of the finest level, and of others where it differs."""
    from nanogs.pipeline.chunked import losses_of

    found: list[str] = []
    settings = done.work.settings
    for level in range(settings.levels if settings.chunks else 0):
        prefix = f"Level {level}: " if level else ""
        losses = join_findings(losses_of(each) for each in done.work.of_blocks("chunk", level))
        found += [prefix + loss for loss in losses if loss not in found]
    return found
