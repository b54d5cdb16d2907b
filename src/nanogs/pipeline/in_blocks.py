"""`nanogs.simplify_blocks`: from files that need not fit into memory to a smaller one."""

import shutil
import time
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nanogs.bar import drawn
from nanogs.clock import StageClock
from nanogs.defaults import DEFAULT_MEMORY, PATIENCE
from nanogs.errors import OptionError, OutputError
from nanogs.formatting import bytes_text
from nanogs.memory import allowed_memory, process_memory
from nanogs.method.parameters import ForestParameters
from nanogs.pipeline.asked import asked_views
from nanogs.pipeline.folder import job_folder, read_manifest
from nanogs.pipeline.job import NanPolicy
from nanogs.pipeline.plan import (
    ScalePlan,
    plan_blocks,
)
from nanogs.pipeline.presets import DEFAULT_PRESET, parameters
from nanogs.pipeline.rows import (
    NOTHING,
    Changes,
    look_at,
    refuse_large_whole,
    segments_of,
    sift,
)
from nanogs.pipeline.settings import Settings
from nanogs.pipeline.target import Goal, target_count
from nanogs.pipeline.unpack import cost_of
from nanogs.progress import Progress
from nanogs.quantities import as_bytes
from nanogs.report import SimplifyReport
from nanogs.sink import Chunked, OneFile, Sink, Written
from nanogs.store.columns import row_bytes
from nanogs.store.scratch import is_url

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from distributed import Client

    from nanogs.filters import Filter
    from nanogs.io.format import FormatOptions
    from nanogs.pipeline.run import Done
    from nanogs.pipeline.stored_job import Where
    from nanogs.views.cameras import Cameras


def simplify_blocks(
    inputs: str | PathLike[str] | Sequence[str | PathLike[str]],
    output: str | PathLike[str],
    *,
    ratio: float | None = None,
    count: int | None = None,
    preset: str = DEFAULT_PRESET,
    max_memory: int | str | None = None,
    block: int | None = None,
    job: str | PathLike[str] | None = None,
    scratch: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    nan: NanPolicy = "drop",
    filters: "Sequence[Filter]" = (),
    sh_degree: int | None = None,
    frame: tuple[str, str] | None = None,
    cameras: "Cameras | None" = None,
    up: Sequence[float] | None = None,
    threads: int | None = None,
    executor: "Client | Executor | None" = None,
    patience: float = PATIENCE,
    format_options: "FormatOptions | None" = None,
    progress: Progress | bool | None = None,
    **overrides: Any,  # noqa: ANN401 - checked against the preset's parameters
) -> SimplifyReport:
    """Simplify files block by block, in bounded memory, here or elsewhere.

    The result does not depend on where, in how many processes or in how many runs it was made; it
    does depend on the size of the blocks. Each block is looked at, chosen and fitted as a whole
    model is, a coarse level of all others around it, on views of the whole scene.

    Args:
        inputs: A file, or several that are parts of one scene.
        output: The file to write; .ply, .compressed.ply, .splat, .npz and .spz files are written
            block by block, others are held whole.
        ratio: Compaction ratio in (0, 1]; exactly one of both is given.
        count: Splats to deliver.
        preset: Name of a preset that grows a forest: any but `paper`.
        max_memory: Bytes that each process may take, a number or text like "4GB"; it decides the
            size of the blocks. By default what is free, less a tenth; 4 GB with an executor. A job
            that is resumed keeps its blocks.
        block: Splats of a block, in place of that.
        job: Folder for what has to survive a crash; by default the output's name with `.job`. It
            is removed when the run ends well.
        scratch: Folder or URL of the intermediate files, which all workers must see; by default in
            the job folder.
        resume: Continue the job in that folder; without one, begin it.
        overwrite: Replace the output if it exists.
        nan: "drop" splats that hold a NaN or an infinite value, or raise an "error".
        filters: What leaves out splats first, such as `nanogs.filters.box(low, high)`; the inputs
            are read once more for them. One that has to see the whole model is refused.
        sh_degree: The highest degree of spherical harmonics that stays; all by default.
        frame: From and to which the result is turned, such as ("rdf", "rub").
        cameras: Views that matter, for presets that look: "auto", "orbit", "inside", "roam", a file
            or folder of cameras, or cameras; by default automatic.
        up: Up direction of views that are found, scene coordinates.
        threads: Threads to use in a process; all of its machine by default.
        executor: Whose workers do the work: a Dask client, or a `concurrent.futures.Executor` such
            as a ProcessPoolExecutor. It is used as it is, and not closed.
        patience: Seconds to wait for workers where a Dask cluster has none, before the run ends.
        format_options: Of the output's format, as `save` takes them.
        progress: True for a bar, in a notebook or on a terminal, or a function that is called with
            each `nanogs.progress.Step`, its parts tasks; with "wait" in place of a stage
            while a cluster has no worker.
        **overrides: Parameters of the preset to replace.

    Returns:
        The report; its `blocks` say how the work was divided.

    Raises:
        NanogsError: Something in the inputs or options makes no sense, the output cannot be
            written, or workers were lost. The job folder is then kept for `resume`, unless nothing
            was begun.
    """
    paths = [inputs] if isinstance(inputs, str | PathLike) else inputs
    from nanogs.pipeline.stored_job import Where  # here, as `--help` and `info` do without Numba

    with drawn(progress) as tell:
        _, [report] = simplify_into(
            OneFile(Path(output), overwrite, format_options),
            [Path(path) for path in paths],
            (Goal(ratio=ratio, count=count),),
            Where(threads, executor, patience),
            tell,
            preset=preset,
            max_memory=None if max_memory is None else as_bytes(max_memory),
            block=block,
            job=job,
            scratch=scratch,
            resume=resume,
            nan=nan,
            changes=Changes(filters, sh_degree, frame, asked_views(cameras, up)),
            **overrides,
        )
    return report


def simplify_into(
    sink: Sink,
    inputs: Sequence[Path],
    goals: Sequence[Goal],
    where: "Where",
    progress: Progress | None = None,
    *,
    preset: str = DEFAULT_PRESET,
    max_memory: int | None = None,
    block: int | None = None,
    job: str | PathLike[str] | None = None,
    scratch: str | None = None,
    resume: bool = False,
    nan: NanPolicy = "drop",
    changes: Changes = NOTHING,
    **overrides: Any,  # noqa: ANN401 - checked against the preset's parameters
) -> tuple[list[Written], list[SimplifyReport]]:
    """Simplify files block by block, and give the results to a sink.

    Inputs are parts of one scene; goals are ratios, the finest first, or one count. `where` the
    tasks are done and `changes` to the model stand for what `simplify_blocks` takes one by one, and
    all else is as there.

    Returns:
        Each result as it was written, and its report.

    Raises:
        NanogsError: As for `simplify_blocks`.
    """
    start, clock = time.perf_counter(), StageClock()
    folder, chosen = job_folder(sink.place, job), block_parameters(preset, overrides)
    max_memory, block = block_memory(
        max_memory, block, folder if resume else None, elsewhere=where.executor is not None
    )
    settings, plan = plan_job(inputs, goals, chosen, max_memory, block, nan, sink.chunks, changes)
    # Here and not above: these bring Numba, which `--help` and `info` do without.
    from nanogs.pipeline.ending import Ending
    from nanogs.pipeline.job_report import report_of
    from nanogs.pipeline.stored_job import BlockJob

    most = target_count(settings.splats, goals[0].ratio, goals[0].count)
    sink.refuse_large(most, row_bytes(settings.layout), max_memory)
    if not resume:
        refuse_full_disk(plan, folder, scratch)

    def reports(done: "Done", written: Sequence[Written]) -> list[SimplifyReport]:
        return [
            report_of(preset, goal, done, written[level].splats, clock, start, level)
            for level, goal in enumerate(goals)
        ]

    ending = Ending(sink, reports)
    made = BlockJob(settings, folder, scratch, ending).run(where, clock, progress, resume=resume)
    return made[1], reports(*made)


def block_memory(
    max_memory: int | None,
    block: int | None,
    begun: Path | None,
    *,
    elsewhere: bool,
) -> tuple[int | None, int | None]:
    """The limit that decides the size of the blocks: memory of a process, or a number of splats.

    Args:
        max_memory: Bytes that each process may take, or None.
        block: Splats of a block, or None.
        begun: Folder of a job to continue, or None.
        elsewhere: Whether the work is done by processes whose machines are not known.

    Returns:
        Bytes that each process may take, or splats of a block; the other is None.
    """
    if block or max_memory is not None:
        return (None, block) if block else (max_memory, None)
    found = read_manifest(begun) if begun else None
    if found is not None:
        return None, int(found[0]["block"])
    if elsewhere:
        return DEFAULT_MEMORY, None
    return process_memory(allowed_memory(None)), None


def block_parameters(preset: str, overrides: dict[str, Any]) -> ForestParameters:
    """The parameters of a preset that can do without renders.

    Raises:
        OptionError: There is no such preset or parameter, or blocks cannot be simplified so.
    """
    chosen = parameters(preset, overrides)
    if not isinstance(chosen, ForestParameters):
        raise OptionError(
            f"The preset {preset} needs the whole model in memory; take another one, or give it"
            " more memory."
        )
    return chosen


def plan_job(
    paths: Sequence[Path],
    goals: Sequence[Goal],
    chosen: ForestParameters,
    max_memory: int | None,
    block: int | None,
    nan: NanPolicy,
    chunks: Chunked | None = None,
    changes: Changes = NOTHING,
) -> tuple[Settings, ScalePlan]:
    """Plan the job, and what it takes; only headers are read, but for filters all rows.

    Args:
        paths: The inputs.
        goals: What is asked, finest first: ratios, or one count.
        chosen: Parameters of the method.
        max_memory: Bytes that a process may take; not needed where `block` is given.
        block: Splats of a block, in place of what memory allows.
        nan: "drop" or "error".
        chunks: Of the results, or None where each is one file.
        changes: What else is done to the model.

    Raises:
        NanogsError: An input cannot be read, filters leave nothing or need the whole model, or the
            memory is too little.
    """
    changes.check()
    inputs, layout = look_at(paths, changes)

    def planned(splats: int) -> ScalePlan:
        shares = tuple(target_count(splats, g.ratio, g.count) / splats for g in goals)
        return plan_blocks(splats, layout, chosen, shares, max_memory, block, chunks)

    plan = planned(sum(each.splats for each in inputs))
    refuse_large_whole(inputs, plan.segment)
    sieve = sift(inputs, layout, changes.filters)
    if sieve:
        plan = planned(sieve.left[-1])
    settings = Settings(
        inputs=inputs,
        layout=layout,
        segments=segments_of(plan.splats, plan.segment),
        ratios=tuple(goal.ratio for goal in goals if goal.ratio is not None),
        counts=tuple(goal.count for goal in goals if goal.count is not None),
        nan=nan,
        block=plan.block,
        parameters=chosen,
        chunks=chunks,
        filters=sieve,
        frame=changes.frame,
        asked=changes.asked,
    )
    return settings, plan.unpacking(cost_of(settings), None if block else max_memory)


def refuse_full_disk(plan: ScalePlan, folder: Path, scratch: str | None) -> None:
    """Refuse a job whose intermediate files would not fit; what a URL has room for is not known.

    Args:
        plan: What it takes.
        folder: Of the job.
        scratch: As `simplify_blocks` takes it.

    Raises:
        OutputError: There is too little room.
    """
    place = folder.absolute() if scratch is None else Path(scratch).absolute()
    if scratch is not None and is_url(scratch):
        return
    while not place.exists() and place != place.parent:
        place = place.parent
    free = shutil.disk_usage(place).free
    if plan.scratch > free:
        raise OutputError(
            f"The job takes about {bytes_text(plan.scratch)} of disk, and {place} has"
            f" {bytes_text(free)} free; free some space, or name another place with `scratch`."
        )
