"""What `simplify` and `lod` are going to do, for the plan that is shown and for the run."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from os import cpu_count
from pathlib import Path
from typing import Any

from nanogs.cli.console import err, key_value_table, show
from nanogs.cli.method import Method
from nanogs.errors import NotEnoughMemoryError
from nanogs.formatting import bytes_text, counted
from nanogs.io import FileInfo
from nanogs.memory import LIBRARIES, Memory, allowed_memory, process_memory
from nanogs.method.paper.parameters import PaperParameters
from nanogs.pipeline.api import target_of
from nanogs.pipeline.asked import asked_views
from nanogs.pipeline.cluster import executor_of
from nanogs.pipeline.files import Request, plan_files
from nanogs.pipeline.folder import MANIFEST, job_folder, refuse_finished
from nanogs.pipeline.in_blocks import block_memory, block_parameters, plan_job
from nanogs.pipeline.job import usable_rows
from nanogs.pipeline.memory import MemoryPlan, plan_file
from nanogs.pipeline.plan import ScalePlan
from nanogs.pipeline.presets import effective, renders
from nanogs.pipeline.reading import inspect_parts, prepare, read_parts
from nanogs.pipeline.rows import Changes
from nanogs.pipeline.target import Goal
from nanogs.sink import Chunked

_LIBRARIES = f"{bytes_text(LIBRARIES)} for Python and its libraries"


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """A run before it begins.

    Attributes:
        parts: The files of the model, parts of one scene.
        target: The file or folder that is written.
        method: What the options say of how.
        changes: What else is done to the model, and to results.
        goals: What is asked: of one result, or of each level, the finest first.
        chunks: Of levels that lie in some, or None.
        levels: Whether results are levels, which are measured one by one: views are held meanwhile.
        info: The input; of several files the first, with the splats and bytes of all.
        count: What the first goal comes to, or None where it is not known beforehand.
        free: Memory that the work may take.
        divided: Whether the model is simplified in blocks.
        blocks: How it would be divided, where that is shown.
    """

    parts: Sequence[Path]
    target: Path
    method: Method
    changes: Changes
    goals: Sequence[Goal]
    chunks: Chunked | None
    levels: bool
    info: FileInfo
    count: int | None
    free: Memory
    divided: bool = False
    blocks: ScalePlan | None = None

    @property
    def goal(self) -> Goal:
        """What is asked; of levels the finest."""
        return self.goals[0]

    @property
    def name(self) -> str:
        """Name the input."""
        return ", ".join(map(str, self.parts))

    @property
    def begun(self) -> bool:
        """Whether there is a job in blocks to continue."""
        return is_begun(self.method, self.target)

    @property
    def process_memory(self) -> int | None:
        """Bytes that each process may take in blocks; None where the library finds it."""
        blocks = self.method.blocks
        if blocks.max_memory is not None or blocks.scheduler or self.begun:
            return blocks.max_memory
        return process_memory(self.free, blocks.workers or 1)

    @property
    def threads(self) -> int | None:
        """Threads of each process: by default those of the machine, shared by its workers."""
        workers = self.method.blocks.workers
        if self.method.threads is None and workers is not None:
            return max((cpu_count() or 1) // workers, 1)
        return self.method.threads

    def block_changes(self) -> Changes:
        """The changes, with the views to look from: a file of cameras is read for them."""
        return replace(self.changes, asked=asked_views(self.method.cameras, self.method.up))

    def executor(self) -> AbstractContextManager[Any]:
        """Who does the tasks of a model in blocks."""
        return executor_of(self.method.blocks.workers, self.method.blocks.scheduler)

    def memory(self) -> MemoryPlan:
        """The memory it takes whole; an unknown count takes that of the whole model."""
        chosen, most = self.method.chosen, self.count or self.info.splats
        # Where the preset looks, it has taken as much before as measuring one result does.
        measured = self.method.measured and (self.levels or not renders(chosen))
        judged = measured or self.goal.psnr is not None
        ratios = [goal.ratio or 0.0 for goal in self.goals]
        return plan_file(self.info, chosen, most, ratios, self.chunks, judged=judged)

    def shown(self) -> "Plan":
        """The plan with what only the splats tell: a count, what filters leave, and blocks.

        Raises:
            NanogsError: It cannot be done.
        """
        if self.divided:
            blocks = self._divide()
            count = self.goal.target(blocks.splats, lambda _count: 0)
            info = replace(self.info, splats=blocks.splats)
            return replace(self, blocks=blocks, info=info, count=count)
        if self.goal.size is None and not self.changes.filters:
            return self
        splats = prepare(read_parts(self.parts), self.changes).splats
        usable = usable_rows(splats, self.method.nan)
        count = target_of(self.goal, splats, len(usable), self.target)
        return replace(self, info=replace(self.info, splats=len(splats)), count=count)

    def _divide(self) -> ScalePlan:
        method, blocks = self.method, self.method.blocks
        folder = job_folder(self.target, blocks.job) if blocks.resume else None
        elsewhere = blocks.scheduler is not None
        size = block_memory(self.process_memory, None, folder, elsewhere=elsewhere)
        chosen = block_parameters(method.preset, method.overrides)
        plan = plan_job(
            self.parts, self.goals, chosen, *size, method.nan, self.chunks, self.block_changes()
        )
        return plan[1]

    def notes(self) -> list[str]:
        """What the user should know of how it is done, one sentence each."""
        if not self.divided:
            return self.method.blocks.unused()
        if self.method.blocks.max_memory is not None or self.process_memory is None:
            return []
        allowed = self.process_memory / 1e6
        how = f"it is simplified in blocks, as with --max-memory {allowed:g}MB."
        return [f"{self._too_large()}: {how}"]

    def refuse_whole_model_wishes(self, *, piped: bool) -> None:
        """Refuse what only a model in memory can be asked.

        Args:
            piped: Whether a model comes from stdin or goes to stdout.

        Raises:
            NotEnoughMemoryError: Something asked for needs the whole model.
        """
        wishes = {
            "--size": self.goal.size is not None,
            "--psnr": self.goal.psnr is not None,
            "--drop-floaters": any(each.whole for each in self.changes.filters),
            "--measure": bool(self.method.measure),
            "a model in a pipe, which blocks cannot read or write,": piped,
            f"the preset {self.method.preset}": isinstance(self.method.chosen, PaperParameters),
        }
        for wish, asked in wishes.items():
            if asked:
                raise NotEnoughMemoryError(
                    f"{self._too_large()}; blocks would take less, but {wish} needs the whole"
                    " model: leave that out, or give it more memory."
                )

    def _too_large(self) -> str:
        peak = bytes_text(self.memory().peak)
        return f"{self.name} takes about {peak} of memory, and {self.free}"

    def to_dict(self) -> dict[str, Any]:
        """What would be done, for JSON."""
        return {
            "input": self.name,
            "input_count": self.info.splats,
            "preset": self.method.preset,
            "parameters": asdict(self.method.chosen),
            "memory_bytes": asdict(self.memory()),
            "blocks": self.blocks and asdict(self.blocks),
        }


def is_begun(method: Method, target: Path) -> bool:
    """Whether there is a job in blocks to continue, for the file or folder that is written."""
    return method.blocks.resume and (job_folder(target, method.blocks.job) / MANIFEST).exists()


def sees_to_output(method: Method, target: Path, *, overwrite: bool) -> bool:
    """Whether there is a job to continue, which sees to its output itself.

    Raises:
        OutputError: There is none to continue, but an output.
    """
    if method.blocks.resume and not overwrite:
        refuse_finished(job_folder(target, method.blocks.job), target)
    return is_begun(method, target)


def plan_run(
    parts: Sequence[Path],
    target: Path,
    goals: Sequence[Goal],
    method: Method,
    changes: Changes,
    chunks: Chunked | None = None,
    *,
    levels: bool = False,
    piped: bool = False,
    saving: dict[str, Any] | None = None,
) -> Plan:
    """Plan a run, and decide whether the model is held whole; only headers are read.

    Args:
        parts: As `Plan` has them, and so are all others but the last.
        target: See there.
        goals: See there.
        method: See there.
        changes: See there.
        chunks: See there.
        levels: See there.
        piped: Whether a model comes from stdin or goes to stdout.
        saving: What `save` takes, of one result; the library then decides.

    Raises:
        NanogsError: It cannot be done.
    """
    info, limit = inspect_parts(parts), method.blocks.max_memory
    count = None
    if goals[0].size is None:
        count = goals[0].target(info.splats, lambda _count: 0)
    plan = Plan(
        parts=parts, target=target, method=method, changes=changes, goals=goals,
        chunks=chunks, levels=levels, info=info, count=count, free=allowed_memory(limit),
    )  # fmt: skip
    if saving is not None:
        divided = plan_files(asked(plan, saving)).divided
    else:
        divided = plan.begun or plan.memory().peak > plan.free.bytes
    if divided:
        plan.refuse_whole_model_wishes(piped=piped)
    return replace(plan, divided=divided)


def asked(plan: Plan, saving: dict[str, Any]) -> Request:
    """What is asked of the library.

    Args:
        plan: Of one result.
        saving: What `save` takes.
    """
    method, blocks = plan.method, plan.method.blocks
    return Request(
        inputs=tuple(plan.parts), output=plan.target, goal=plan.goal, preset=method.preset,
        overrides=method.overrides, measured=method.measure, max_memory=blocks.max_memory,
        job=blocks.job, scratch=blocks.scratch, resume=blocks.resume, nan=method.nan,
        filters=plan.changes.filters, sh_degree=plan.changes.sh_degree, frame=plan.changes.frame,
        cameras=method.cameras, up=method.up, threads=plan.threads, patience=blocks.patience,
        **saving,
    )  # fmt: skip


def show_plan(plan: Plan, text: str) -> None:
    """Show on stderr what a run would do, with words for what it would write."""
    info, memory = plan.info, plan.memory()
    known = effective(plan.method.chosen).items()
    rows = {
        "would read": f"{plan.name} ({counted(info.splats, 'splat')}, SH degree {info.sh_degree})",
        "would write": text,
        "preset": plan.method.preset,
        "parameters": ", ".join(f"{name} {value}" for name, value in known),
        "peak memory": f"about {bytes_text(memory.peak)}, and {_LIBRARIES}",
    }
    if plan.blocks is None:
        rows |= {f"  {stage}": bytes_text(held) for stage, held in memory.stages.items()}
    else:
        blocks = plan.blocks
        rows |= {
            "peak memory": f"{bytes_text(memory.peak)} if whole, and {_LIBRARIES}",
            "blocks": f"about {blocks.blocks:,}, of at most {blocks.block:,} splats",
            "memory": f"{bytes_text(blocks.memory)} for each process",
            "scratch": f"{bytes_text(blocks.scratch)} on the disk, the result among it",
            "time": f"about {blocks.seconds:,.0f} s of one processor",
        }
    show(err, key_value_table(rows))
