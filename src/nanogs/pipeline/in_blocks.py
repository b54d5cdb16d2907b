"""Simplify files that do not fit into memory block by block, and write the results to a sink."""

import shutil
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nanogs.clock import StageClock
from nanogs.defaults import DEFAULT_MEMORY
from nanogs.errors import CrowdedError, ModelError, OptionError, OutputError
from nanogs.formatting import bytes_text
from nanogs.io import registry
from nanogs.io.format import options_text
from nanogs.io.urls import is_url
from nanogs.memory import LIBRARIES, allowed_memory, process_memory
from nanogs.memory_estimates import pictures_bytes
from nanogs.method.parameters import ForestParameters
from nanogs.paths import exists
from nanogs.pipeline.estimates.block_plan import BlockPlan, MemoryLimit, plan_blocks
from nanogs.pipeline.estimates.memory_blocks import rounding_bytes
from nanogs.pipeline.job.folder import read_manifest
from nanogs.pipeline.job.rows import (
    RUN_ROWS,
    count_filtered,
    describe_inputs,
    opened,
    refuse_large_whole,
    segments_of,
)
from nanogs.pipeline.options.presets import parameters, renders
from nanogs.pipeline.options.settings import SearchTarget, Settings
from nanogs.pipeline.options.target import rounds_for_file
from nanogs.pipeline.options.views import requested_views
from nanogs.pipeline.reading import open_parts
from nanogs.pipeline.tasks.unpack import cost_of
from nanogs.progress import Progress
from nanogs.protocol import PIXELS, VIEWS
from nanogs.report import SimplifyReport
from nanogs.sink import Sink, Written, held_splats
from nanogs.source import Joined, Layout
from nanogs.store.columns import no_splats, row_bytes
from nanogs.views.plan import budget_for_measuring

if TYPE_CHECKING:
    from nanogs.pipeline.request import Request
    from nanogs.pipeline.run import Done


def fill_in_blocks(
    request: "Request", sink: Sink, on_step: Progress | None, notes: tuple[str, ...] = ()
) -> tuple[list[Written], list[SimplifyReport]]:
    """Simplify files block by block, and write the results to a sink.

    Args:
        request: All arguments of the call.
        sink: Destination of the results.
        on_step: Progress callback, called with each step.
        notes: Further notes for the report of the first result, one sentence each.

    Returns:
        A description of each written result, and the report of each.

    Raises:
        NanogsError: As for `simplify_blocks`.
    """
    start, clock = time.perf_counter(), StageClock()
    folder, goals = request.folder, request.goals
    option = "block" if request.block else "max_memory"
    request = with_limit(request, elsewhere=request.executor is not None)
    settings, plan = plan_job(request)
    # Imported here because these import Numba, which `--help` and `info` do without.
    from nanogs.pipeline.job.report import report_of
    from nanogs.pipeline.job.result_writer import ResultWriter
    from nanogs.pipeline.job.stored import BlockJob, Execution

    if settings.search is None:
        most = request.counts(settings.splats, settings.result_layout)[0]
        sink.refuse_large(most, row_bytes(settings.layout), request.max_memory)
    else:
        registry.writer(request.output)
    if not request.resume:
        refuse_full_disk(plan, folder, request.scratch)

    def reports(done: "Done", written: Sequence[Written]) -> list[SimplifyReport]:
        first, *others = (
            report_of(request.preset, goal, done, each, clock, start, level)
            for goal, level, each in zip(goals, done.levels, written, strict=True)
        )
        return [replace(first, notes=(*first.notes, *notes)), *others]

    search = None
    if settings.search is not None:
        from nanogs.pipeline.search.in_blocks import find_in_blocks

        search = partial(
            find_in_blocks, request.output, request.format_options, folder, request.max_memory
        )
    measured = bool(request.measured) and request.goal.psnr is None
    costed = bool(request.measured) and request.goal.draw_cost is None
    writer = ResultWriter(sink, reports, measured, request.max_memory, costed)
    job = BlockJob(settings, folder, request.scratch, writer, search)
    execution = Execution(request.threads, request.executor, request.patience)
    try:
        done, written = job.run(execution, clock, on_step, resume=request.resume)
    except CrowdedError as error:
        raise CrowdedError(f"{error}; raise `{option}`.") from None
    return written, reports(done, written)


def with_limit(request: "Request", *, elsewhere: bool) -> "Request":
    """Return a request with what determines the block size: a number of splats, or memory.

    Args:
        request: The request; what it has already stays.
        elsewhere: Whether an executor does the work, on machines of unknown memory.
    """
    if request.block or request.max_memory is not None:
        return request
    begun = _begun_settings(request)
    if begun is not None:
        return replace(request, block=int(begun["block"]))
    if elsewhere:
        return replace(request, max_memory=DEFAULT_MEMORY, limit=MemoryLimit.DEFAULT)
    memory = process_memory(allowed_memory(None))
    return replace(request, max_memory=memory, limit=MemoryLimit.FREE)


def _begun_settings(request: "Request") -> dict[str, Any] | None:
    """Return the settings of the job that is resumed; None for a new one."""
    begun = read_manifest(request.folder) if request.resume else None
    return None if begun is None else begun[0]


def block_parameters(preset: str, overrides: dict[str, Any]) -> ForestParameters:
    """Return the parameters of a preset that can simplify blocks, which is one with a forest.

    Raises:
        OptionError: There is no such preset or parameter, or the preset cannot work in blocks.
    """
    chosen = parameters(preset, overrides)
    if not isinstance(chosen, ForestParameters):
        raise OptionError(
            f"The preset {preset} needs the whole model in memory; choose another one, or leave out"
            " the options for blocks and allow more memory with `max_memory`."
        )
    return chosen


def plan_job(request: "Request") -> tuple[Settings, BlockPlan]:
    """Plan the job and its memory and disk use; only headers are read, with filters all rows.

    Args:
        request: All arguments of the call; see `with_limit`.

    Raises:
        NanogsError: An input cannot be read, filters leave nothing or need the whole model, or
            there is not enough memory.
    """
    chosen = block_parameters(request.preset, request.overrides)
    edits, asked = request.edits, requested_views(request.cameras, request.up)
    edits.check()
    inputs, layout = describe_inputs(request.inputs, edits)
    sought = search_target(request, layout, sum(each.splats for each in inputs))
    seen = sought is not None and (sought.goal.is_measured or renders(chosen))
    if request.measured or seen:
        _refuse_no_room_to_measure(request, searched=seen)
    delivered = layout.reduced(request.sh_degree)

    def planned(splats: int) -> BlockPlan:
        # A search may try any count, and keeps the files of two results at a time.
        counts = [] if sought else request.counts(splats, delivered)
        shares = tuple(count / splats for count in counts) or (1.0, 1.0)
        return plan_blocks(
            splats, layout, chosen, shares, request.max_memory, request.block, request.block_layout,
            beside=pictures_bytes(PIXELS**2, VIEWS) if seen else 0,
            limit=request.limit, searched=sought is not None,
            shown=sought is not None or rounds_for_file(request.parameters, request.result_format),
        )  # fmt: skip

    plan = planned(sum(each.splats for each in inputs))
    refuse_large_whole(inputs, plan.segment)
    sieve = count_filtered(inputs, layout, edits.filters)
    if sieve:
        plan = planned(sieve.left[-1])
    counted = not sought and request.goal.ratio is None
    settings = Settings(
        inputs=inputs,
        layout=layout,
        segments=segments_of(plan.splats, plan.segment),
        ratios=tuple(goal.ratio for goal in request.goals if goal.ratio is not None),
        counts=tuple(request.counts(plan.splats, delivered)) if counted else (),
        nan=request.nan,
        block=plan.block,
        parameters=chosen,
        block_layout=request.block_layout,
        filters=sieve,
        frame=request.frame,
        sh_degree=request.sh_degree,
        asked=asked,
        sharing=request.sharing,
        search=sought,
        environment=request.environment,
        at_most=request.goal.size is not None,
        rounded=sought is None and _rounds(request, layout, plan.splats),
    )
    _refuse_small_size(request, settings)
    max_memory = None if request.block else request.max_memory
    return settings, plan.unpacking(cost_of(settings), max_memory, request.limit)


def _refuse_no_room_to_measure(request: "Request", *, searched: bool) -> None:
    """Refuse to measure results on renders of the original if there is no memory for these.

    Args:
        request: All arguments of the call.
        searched: Whether they are measured to find the count.

    Raises:
        NotEnoughMemoryError: There is not.
    """
    remedy = "ask for a ratio or a count" if searched else "leave out the measurement"
    # The default of workers says nothing about this machine, where results are measured.
    allowed = None if request.limit is MemoryLimit.DEFAULT else request.max_memory
    with Joined(open_parts(request.inputs, request.render_mode)) as source:
        budget_for_measuring(source, allowed, remedy)


def _refuse_small_size(request: "Request", settings: Settings) -> None:
    """Refuse a size that is far too small, by the first rows; not if these are unpacked only later.

    Raises:
        TooSmallError: It is.
    """
    if settings.search is None or settings.search.size is None or settings.unpacked:
        return
    with opened(settings) as source:
        some = source.read(0, min(RUN_ROWS, source.count))
    if some := some.take(some.finite()):
        with suppress(ModelError):  # a page cannot show these rows, but perhaps others
            request.refuse_small_size(some)


def search_target(request: "Request", layout: Layout, splats: int) -> SearchTarget | None:
    """Return the target of the search for a count; None if the count is known beforehand.

    Args:
        request: All arguments of the call.
        layout: Columns of the model.
        splats: Number of splats of the model.

    Raises:
        TooSmallError: It is known beforehand that not even one splat fits.
    """
    goal = request.goal
    if request.ratios or not request.searches(layout.sh_degree):
        return None
    if goal.size is not None and request.sizer is not None:
        if request.sizer(no_splats(layout), splats) <= goal.size:
            return None
        request.counts(1, layout.reduced(0))
    options = options_text(request.format_options)
    most = _held_whole(request, layout)
    return SearchTarget(goal.size, goal.psnr, request.suffix, options, goal.draw_cost, most)


def _rounds(request: "Request", layout: Layout, splats: int) -> bool:
    """Whether results of known counts are rounded, for which each is held whole when written.

    Like `_held_whole`, a job that is resumed does as it began.
    """
    if not rounds_for_file(request.parameters, request.result_format):
        return False
    begun = _begun_settings(request)
    if begun is not None:
        return bool(begun.get("rounded"))
    most = _most_held(request, layout)
    return most is None or request.counts(splats, layout.reduced(request.sh_degree))[0] <= most


def _held_whole(request: "Request", layout: Layout) -> int | None:
    """Return `SearchTarget.most`; a job that is resumed keeps its own, to pack as it began."""
    begun = _begun_settings(request)
    if begun is None:
        return _most_held(request, layout)
    most: int | None = (begun.get("search") or {}).get("most")
    return most


def _most_held(request: "Request", layout: Layout) -> int | None:
    """Return the splats of the largest result that may be held whole; None for any number."""
    row, allowed = row_bytes(layout), request.max_memory
    most = held_splats(request.file, row, allowed)
    if most is None or allowed is None or request.written_format.quantisation is None:
        return most
    return max(min(most, (allowed - LIBRARIES) // rounding_bytes(row)), 0)


def refuse_full_disk(plan: BlockPlan, folder: Path, scratch: str | None) -> None:
    """Raise if the disk has no room for the intermediate files; a URL is not checked.

    Args:
        plan: The plan, which has the bytes of the intermediate files.
        folder: The job's folder.
        scratch: As `simplify_blocks` takes it.

    Raises:
        OutputError: There is not enough free space.
    """
    if scratch is not None and is_url(scratch):
        return
    place = (folder if scratch is None else Path(scratch)).absolute()
    while not exists(place) and place != place.parent:
        place = place.parent
    free = shutil.disk_usage(place).free
    if plan.scratch > free:
        raise OutputError(
            f"The job takes about {bytes_text(plan.scratch)} of disk, and {place} has"
            f" {bytes_text(free)} free; free some space, or name another place with `scratch`."
        )
