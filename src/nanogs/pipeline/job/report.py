"""The report of a job in blocks."""

import time
from dataclasses import asdict
from itertools import pairwise

from nanogs.clock import StageClock
from nanogs.filters import FilterReport, filter_of
from nanogs.findings import join_findings, of_plain
from nanogs.pipeline.options.presets import idle_notes
from nanogs.pipeline.options.settings import Settings
from nanogs.pipeline.options.target import Goal
from nanogs.pipeline.outcome import report_fields
from nanogs.pipeline.run import Done
from nanogs.report import BlocksReport, SimplifyReport, StopReason
from nanogs.sink import Written
from nanogs.store.columns import count_of


def report_of(
    preset: str,
    goal: Goal,
    done: Done,
    written: Written,
    clock: StageClock,
    start: float,
    level: int = 0,
) -> SimplifyReport:
    """Make the report of a result: the goal, the result, and the time taken.

    Args:
        preset: Name of the preset.
        goal: The target of the simplification.
        done: The job, whose tasks are done.
        written: The result as it was written.
        clock: The seconds of the job's stages.
        start: `time.perf_counter()` at the start.
        level: Number of the level.
    """
    work = done.work
    settings, target, segments = work.settings, work.target(level), work.segments()
    own_notes = join_findings(map(of_plain, record.facts["notes"]) for record in segments)
    # Few splats are merged from blocks that have more; and a tree may have fewer than all blocks,
    # because it repeats a block's finer level that has fewer splats.
    made = work.delivered_count(level)
    stop = StopReason.TARGET if target in (written.splats, made) else StopReason.NO_PROGRESS
    reported = {
        "stop": stop,
        **written.measured,
        **report_fields(work, level),
        **done.fields,
    }
    notes = (*settings.layout.notes, *own_notes, *reported["notes"], *done.notes, *written.notes)
    notes += idle_notes(preset, settings.parameters)
    return SimplifyReport(
        preset=preset,
        parameters=asdict(settings.parameters),
        input_count=settings.splats,
        asked_count=target,
        **goal.reported,
        dropped_nonfinite=sum(int(record.facts["dropped"]) for record in segments),
        pruned=0,
        prune_threshold=0.0,
        prune_limited=False,
        achieved_count=written.splats,
        seconds=clock.seconds,
        total_seconds=time.perf_counter() - start,
        threads=work.threads,
        **{**reported, "notes": tuple(dict.fromkeys(notes))},
        blocks=_blocks_report(done, level),
        read_count=settings.read_count,
        filters=_filter_reports(settings),
    )


def _blocks_report(done: Done, level: int) -> BlocksReport:
    """Report how the model was divided, and what the blocks of a result told each other."""
    work = done.work
    partition, settings = work.partition, work.settings
    reassigns = work.merges(level) and settings.parameters.rounds
    reassigned = work.of_blocks("reassign", level) if reassigns else []
    return BlocksReport(
        blocks=partition.blocks,
        largest=partition.largest,
        allowed=settings.block,
        segments=len(work.segments()),
        seen=sum(int(record.facts["seen"]) for record in reassigned),
        handed=sum(count_of(record) for record in reassigned),
        resumed=done.kept,
    )


def _filter_reports(settings: Settings) -> tuple[FilterReport, ...]:
    """Report the number of splats that each filter of a job removed."""
    if settings.filters is None:
        return ()
    filters = [filter_of(*plain) for plain in settings.filters.plain]
    counts = pairwise((settings.read_count, *settings.filters.left))
    return tuple(
        FilterReport(each.name, each.argument, before - left, left)
        for each, (before, left) in zip(filters, counts, strict=True)
    )
