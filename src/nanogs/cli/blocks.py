"""Models that do not fit into the memory given: what `nanogs simplify` does with them."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from nanogs.cli import options
from nanogs.cli.console import err, key_value_table, show, stage_bar, warn
from nanogs.cli.simplify_report import Plan
from nanogs.cli.streams import DASH
from nanogs.errors import OptionError
from nanogs.formatting import bytes_text
from nanogs.io import FileInfo, bytes_on_disk
from nanogs.io.collect import Pair
from nanogs.io.files import splat_bytes
from nanogs.lod.in_blocks import chunks_of, plan_levels, write_levels_in_blocks
from nanogs.lod.layout import Output
from nanogs.scale.api import DEFAULT_MEMORY, block_parameters, job_folder, plan_job
from nanogs.scale.api import simplify_blocks as library_simplify_blocks
from nanogs.scale.encoding import Encoding, encoding_of
from nanogs.scale.folder import MANIFEST, refuse_finished
from nanogs.scale.plan import ScalePlan
from nanogs.scale.settings import WAITING
from nanogs.simplify.memory import LIBRARIES

Progress = Callable[[str, int, int], None]

_PANEL = "Models larger than memory, and several machines"

MaxMemory = Annotated[
    str | None,
    typer.Option(
        help="Memory that a process may take, e.g. 4GB: a model that needs more is simplified in"
        " blocks.",
        metavar="SIZE",
        rich_help_panel=_PANEL,
    ),
]
Join = Annotated[
    bool,
    typer.Option("--join", help="All inputs are parts of one scene.", rich_help_panel=_PANEL),
]
JobFolder = Annotated[
    Path | None,
    typer.Option(
        "--job",
        help="Folder for what survives a crash; removed at the end.",
        show_default="OUT.job",
        rich_help_panel=_PANEL,
    ),
]
Resume = Annotated[
    bool,
    typer.Option("--resume", help="Continue the job in that folder.", rich_help_panel=_PANEL),
]
Scratch = Annotated[
    str | None,
    typer.Option(
        help="Folder or URL of the intermediate files, which all workers see.",
        show_default="in the job folder",
        rich_help_panel=_PANEL,
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(min=1, help="Processes on this machine, by Dask.", rich_help_panel=_PANEL),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        help="Dask scheduler whose workers do the work, e.g. tcp://host:8786.",
        rich_help_panel=_PANEL,
    ),
]
Patience = Annotated[
    float,
    typer.Option(
        min=0,
        help="Seconds to wait for workers where a scheduler has none.",
        metavar="SECONDS",
        rich_help_panel=_PANEL,
    ),
]


@dataclass(frozen=True, slots=True)
class Blocks:
    """How models are treated that do not fit.

    Attributes:
        max_memory: Bytes of a process, or None where models are held whatever they take.
        joined: Inputs that are parts of one scene, or none.
        job: The job folder, or None for that beside the output.
        resume: Whether a job is continued.
        given: What the library takes beside.
    """

    max_memory: int | None
    joined: tuple[Path, ...]
    job: Path | None
    resume: bool
    given: dict[str, Any]

    def needed(self, plan: Plan) -> bool:
        """Whether a model takes more memory than there is."""
        return self.max_memory is not None and plan.memory().peak + LIBRARIES > self.max_memory

    def sources(self, pair: Pair) -> tuple[Path, ...]:
        """The files that make up the model."""
        return self.joined or (pair.source,)

    def is_begun(self, target: Path, *, overwrite: bool) -> bool:
        """Whether there is a job to continue, which sees to its output itself.

        Raises:
            OutputError: There is none to continue, but an output.
        """
        folder = job_folder(target, self.job)
        if self.resume and not overwrite:
            refuse_finished(folder, target)
        return self.resume and (folder / MANIFEST).exists()

    def refuse_fitting(self, target: Path) -> None:
        """Refuse to simplify in memory what was begun in blocks.

        Raises:
            OptionError: There is a job to continue.
        """
        folder = job_folder(target, self.job)
        if self.resume and (folder / MANIFEST).exists():
            raise OptionError(
                f"{folder} holds a job in blocks, and this model fits into the memory given; resume"
                " it with the --max-memory it was begun with, or remove the folder."
            )


def parse_blocks(
    paths: Sequence[Path],
    max_memory: str | None,
    *,
    join: bool,
    job: Path | None,
    resume: bool,
    scratch: str | None,
    workers: int | None,
    scheduler: str | None,
    patience: float,
) -> Blocks:
    """What was asked for, checked as far as it can be without the inputs.

    Raises:
        OptionError: The options do not go together.
    """
    far = workers is not None or scheduler is not None
    given = bool(job) or resume or scratch is not None or far
    memory = None if max_memory is None else options.parse_bytes(max_memory)
    if memory is None and given:
        memory = DEFAULT_MEMORY
    if workers is not None and scheduler is not None:
        raise OptionError("Give --workers or --scheduler, not both.")
    if (memory is not None or join) and DASH in paths:
        raise OptionError("With --max-memory or --join models are files; name them in place of -.")
    if join and len(paths) < 2:
        raise OptionError("--join takes the parts of a scene and OUT; this is one path.")
    rest: dict[str, Any] = {"scratch": scratch, "workers": workers, "scheduler": scheduler}
    rest["patience"] = patience
    return Blocks(memory, tuple(paths[:-1]) if join else (), job, resume, rest)


def refuse_whole_model_wishes(
    plan: Plan, *, filtered: bool, looks: bool, turned: bool = False
) -> None:
    """Refuse what only a model in memory can be asked.

    Args:
        plan: Of the run.
        filtered: Whether there are filters.
        looks: Whether views are asked for.
        turned: Whether the frame is changed.

    Raises:
        OptionError: Something asked for needs the whole model.
    """
    wishes = {
        "--size": plan.goal.size is not None,
        "--psnr": plan.goal.psnr is not None,
        "a filter": filtered,
        "--views, --cameras or --up": looks,
        "--frame": turned,
    }
    for wish, asked in wishes.items():
        if asked:
            raise OptionError(
                f"This model takes {bytes_text(plan.memory().peak)}, more than --max-memory, and"
                f" {wish} needs the whole of it; raise --max-memory, or leave that out."
            )


def plan_of(pair: Pair, plan: Plan, blocks: Blocks, nan: Any) -> ScalePlan:  # noqa: ANN401
    """How the model would be divided.

    Raises:
        NanogsError: It cannot be.
    """
    chosen = block_parameters(plan.preset, asdict(plan.parameters))
    return plan_job(
        blocks.sources(pair), (plan.goal,), chosen, blocks.max_memory, None, nan
    )[1]  # fmt: skip


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
    pair: Pair, plan: Plan, blocks: Blocks, given: dict[str, Any], *, quiet: bool
) -> dict[str, Any]:
    """Simplify a model that does not fit; its report with the files' names."""
    start, sources = time.perf_counter(), blocks.sources(pair)
    with stage_bar(quiet=quiet) as progress:
        report = library_simplify_blocks(
            sources, pair.target, ratio=plan.goal.ratio, count=plan.goal.count,
            max_memory=blocks.max_memory or DEFAULT_MEMORY, job=blocks.job, resume=blocks.resume,
            progress=_telling(progress, quiet=quiet), **blocks.given, **given,
        )  # fmt: skip
    run = report.to_dict() | {"total_seconds": time.perf_counter() - start}
    run |= {"read_count": report.input_count, "filters": []}
    run |= {"input": ", ".join(map(str, sources)), "output": str(pair.target)}
    run["input_bytes"] = sum(bytes_on_disk(path) for path in sources)
    return run | {"output_bytes": bytes_on_disk(pair.target)}


def levels_encoding(
    info: FileInfo, ratios: Sequence[float], output: Output, chunk: int | None, *, spz: bool
) -> Encoding:
    """What the chunks of the levels of a model take; nothing for plain files."""
    row = splat_bytes(info.sh_degree) + info.extra_bytes()
    chunks = chunks_of(output.layout, chunk, spz=spz)
    return encoding_of(row, info.sh_degree, chunks, info.splats, ratios)


def levels_plan(
    source: Path, ratios: Sequence[float], blocks: Blocks, given: dict[str, Any]
) -> ScalePlan:
    """How a model would be divided of which levels are to be made.

    Raises:
        NanogsError: It cannot be.
    """
    return plan_levels([source], ratios, max_memory=blocks.max_memory, **given)[1]


def levels_in_blocks(
    source: Path,
    output: Output,
    ratios: Sequence[float],
    blocks: Blocks,
    threads: int | None,
    given: dict[str, Any],
    *,
    quiet: bool,
) -> dict[str, Any]:
    """Make levels of a model that does not fit; the manifest with the reports."""
    from nanogs.scale.job import Where

    start, rest = time.perf_counter(), blocks.given
    where = Where(threads, None, rest["scheduler"], rest["workers"], rest["patience"])
    with stage_bar(quiet=quiet) as progress:
        manifest, reports = write_levels_in_blocks(
            [source], output.folder, ratios, max_memory=blocks.max_memory, job=blocks.job,
            scratch=rest["scratch"], resume=blocks.resume, where=where,
            progress=_telling(progress, quiet=quiet), **given,
        )  # fmt: skip
    run = manifest.to_dict() | {"input": str(source), "output": str(output.path)}
    run |= {"layout": output.layout.value, "dropped_nonfinite": reports[0].dropped_nonfinite}
    run["reports"] = [report.to_dict() for report in reports]
    return run | {"total_seconds": time.perf_counter() - start}


def _telling(progress: Progress, *, quiet: bool) -> Progress:
    """A progress bar that also says, once in a while without any, that workers are waited for."""
    told = False

    def update(stage: str, done: int, total: int) -> None:
        nonlocal told
        if stage == WAITING and not told and not quiet:
            warn("The cluster has no worker; waiting for one.")
        told = stage == WAITING
        progress(stage, done, total)

    return update
