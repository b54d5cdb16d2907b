"""Models that do not fit into the memory given: what `nanogs simplify` and `lod` do with them."""

import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from nanogs.cli.console import err, key_value_table, show, warn
from nanogs.cli.progress import shown
from nanogs.cli.simplify_report import Plan
from nanogs.cli.too_large import Blocks
from nanogs.formatting import bytes_text
from nanogs.io import FileInfo, bytes_on_disk
from nanogs.io.collect import Pair
from nanogs.io.files import splat_bytes
from nanogs.lod.layout import Output
from nanogs.pipeline.cluster import executor_of
from nanogs.pipeline.encoding import Encoding, encoding_of
from nanogs.pipeline.in_blocks import block_parameters, plan_job
from nanogs.pipeline.in_blocks import simplify_blocks as library_simplify_blocks
from nanogs.pipeline.job import NanPolicy
from nanogs.pipeline.levels_in_blocks import chunks_of, plan_levels, write_levels_in_blocks
from nanogs.pipeline.plan import ScalePlan
from nanogs.pipeline.rows import Changes
from nanogs.progress import Progress


def plan_of(pair: Pair, plan: Plan, blocks: Blocks, nan: NanPolicy, changes: Changes) -> ScalePlan:
    """How the model would be divided.

    Raises:
        NanogsError: It cannot be.
    """
    chosen = block_parameters(plan.preset, asdict(plan.parameters))
    size = blocks.size_of_blocks(pair.target)
    sources = blocks.sources(pair)
    return plan_job(sources, (plan.goal,), chosen, *size, nan, changes=changes)[1]


def warn_of_blocks(plan: Plan, blocks: Blocks, target: Path, *, quiet: bool) -> None:
    """Say why a model is simplified in blocks where nobody asked for it.

    Args:
        plan: What is going to be done.
        blocks: How models are treated that do not fit.
        target: What is written.
        quiet: Whether nothing is said.
    """
    reason = blocks.reason(plan, target)
    if reason and not quiet:
        warn(reason)


def plan_rows(plan: ScalePlan) -> None:
    """Show on stderr how a model would be divided."""
    rows = {
        "blocks": f"about {plan.blocks:,}, of at most {plan.block:,} splats",
        "memory": f"{bytes_text(plan.memory)} for each process",
        "scratch": f"{bytes_text(plan.scratch)} on the disk, the result among it",
        "time": f"about {plan.seconds:,.0f} s of one processor",
    }
    show(err, key_value_table(rows))


def simplify_in_blocks(
    pair: Pair,
    plan: Plan,
    blocks: Blocks,
    changes: Changes,
    given: dict[str, Any],
    progress: Progress,
) -> dict[str, Any]:
    """Simplify a model that does not fit; its report with the files' names."""
    start, sources = time.perf_counter(), blocks.sources(pair)
    threads = blocks.threads(given.pop("threads"))
    with executor_of(blocks.workers, blocks.scheduler) as executor:
        report = library_simplify_blocks(
            sources, pair.target, ratio=plan.goal.ratio, count=plan.goal.count,
            max_memory=blocks.process_memory(pair.target), job=blocks.job, resume=blocks.resume,
            filters=changes.filters, sh_degree=changes.sh_degree, frame=changes.frame,
            executor=executor, threads=threads, progress=progress, **blocks.given, **given,
        )  # fmt: skip
    run = report.to_dict() | {"total_seconds": time.perf_counter() - start}
    assert report.blocks is not None  # noqa: S101 - of a model in blocks
    run |= {"read_count": report.blocks.read, "frames": changes.frame}
    run["filters"] = [asdict(each) for each in report.blocks.filters]
    run |= {"input": plan.name, "output": str(pair.target)}
    run["input_bytes"] = sum(bytes_on_disk(path) for path in sources)
    return run | {"output_bytes": bytes_on_disk(pair.target)}


def levels_encoding(
    info: FileInfo, ratios: Sequence[float], output: Output, chunk: int | None, *, plain: bool
) -> Encoding:
    """Memory and time for the chunks of a model's levels; none for plain files."""
    row = splat_bytes(info.sh_degree) + info.extra_bytes()
    chunks = chunks_of(output.layout, chunk, plain=plain)
    return encoding_of(row, info.sh_degree, chunks, info.splats, ratios)


def levels_plan(
    sources: Sequence[Path],
    output: Output,
    ratios: Sequence[float],
    blocks: Blocks,
    given: dict[str, Any],
) -> ScalePlan:
    """How a model would be divided of which levels are to be made.

    Raises:
        NanogsError: It cannot be.
    """
    max_memory, block = blocks.size_of_blocks(output.folder)
    return plan_levels(sources, ratios, max_memory=max_memory, block=block, **given)[1]


def levels_in_blocks(
    sources: Sequence[Path],
    output: Output,
    ratios: Sequence[float],
    blocks: Blocks,
    threads: int | None,
    given: dict[str, Any],
    *,
    quiet: bool,
) -> dict[str, Any]:
    """Make levels of a model that does not fit; the manifest with the reports."""
    from nanogs.pipeline.stored_job import Where

    start = time.perf_counter()
    with (
        shown(quiet=quiet) as progress,
        executor_of(blocks.workers, blocks.scheduler) as executor,
    ):
        where = Where(blocks.threads(threads), executor, blocks.given["patience"])
        manifest, reports = write_levels_in_blocks(
            sources, output.folder, ratios, job=blocks.job,
            max_memory=blocks.process_memory(output.folder), scratch=blocks.given["scratch"],
            resume=blocks.resume, where=where,
            progress=progress, **given,
        )  # fmt: skip
    run = manifest.to_dict() | {"input": ", ".join(map(str, sources))}
    run["reports"] = [report.to_dict() for report in reports]
    run |= {
        "output": str(output.path),
        "filters": run["reports"][0]["blocks"]["filters"],
        "layout": output.layout.value,
        "dropped_nonfinite": reports[0].dropped_nonfinite,
    }
    return run | {"total_seconds": time.perf_counter() - start}
