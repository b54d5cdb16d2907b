"""The plan of a run of `simplify` or `lod`: printed with `--dry-run`, or executed."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from typing import Any, TypeVar

from nanogs.ahead import prepare_kernels
from nanogs.allocation import keep_freed_memory
from nanogs.cli.cancel import resumable
from nanogs.cli.console import err, key_value_table, show, value_text
from nanogs.cli.filtering import parse_filters
from nanogs.cli.importing import without_gc
from nanogs.cli.method import Method
from nanogs.defaults import PATIENCE
from nanogs.errors import NotEnoughMemoryError, OptionError
from nanogs.formatting import bytes_text, counted
from nanogs.io import FileInfo
from nanogs.memory import LIBRARIES, Memory, allowed_memory, process_memory
from nanogs.method.paper.parameters import PaperParameters
from nanogs.pipeline.estimates.block_plan import BlockPlan, MemoryLimit
from nanogs.pipeline.estimates.memory import MemoryPlan
from nanogs.pipeline.in_blocks import plan_job, with_limit
from nanogs.pipeline.in_memory import import_stages, usable_rows
from nanogs.pipeline.job.cluster import executor_of
from nanogs.pipeline.job.folder import MANIFEST
from nanogs.pipeline.options.presets import DEFAULT_PRESET, effective, renders
from nanogs.pipeline.options.settings import Settings
from nanogs.pipeline.options.target import Goal, target_of
from nanogs.pipeline.reading import changed, inspect_parts, read_parts
from nanogs.pipeline.request import Request, memory_of, plan_files
from nanogs.pipeline.search.file_size import first_two
from nanogs.threads import usual_threads

T = TypeVar("T")
_LIBRARIES = f"{bytes_text(LIBRARIES)} for Python and its libraries"


@dataclass(frozen=True, slots=True, kw_only=True)
class RunPlan:
    """A planned run.

    Attributes:
        request: The request to the library.
        method: Options of the method and of its execution.
        info: Metadata of the input; for several files that of the first, with the splats and bytes
            of all. The splats are those that filters leave, if planning counts them.
        read_count: Splats of all input files.
        count: Number of splats of the (first) result, or None if it is not known beforehand.
        usable: Number of the model's splats without a NaN or infinite value, or None if the splats
            were not read.
        free: Memory that the run may take.
        divided: Whether the model is simplified in blocks.
        blocks: The division into blocks, if it was computed to be printed.
    """

    request: Request
    method: Method
    info: FileInfo
    read_count: int
    count: int | None
    free: Memory
    divided: bool = False
    blocks: BlockPlan | None = None
    usable: int | None = None

    @property
    def name(self) -> str:
        """The names of the input files."""
        return ", ".join(map(str, self.request.inputs))

    @property
    def process_memory(self) -> int | None:
        """Bytes that each process may take in blocks; None to let the library decide."""
        blocks = self.method.blocks
        if blocks.max_memory is not None or blocks.scheduler or self.request.begun:
            return blocks.max_memory
        return process_memory(self.free, blocks.workers or 1)

    @property
    def found_free(self) -> bool:
        """Whether `process_memory` is what was found free, and nobody asked for it."""
        return self.method.blocks.max_memory is None

    @property
    def in_blocks(self) -> Request:
        """The request with the memory of each process."""
        limit = MemoryLimit.FREE if self.found_free else MemoryLimit.GIVEN
        return replace(self.request, max_memory=self.process_memory, limit=limit)

    @property
    def threads(self) -> int | None:
        """Number of threads of each process in blocks: workers share them if none was given."""
        asked, workers = self.request.threads, self.method.blocks.workers
        if asked is not None or workers is None:
            return asked
        return max(usual_threads() // workers, 1)

    def executor(self) -> AbstractContextManager[Any]:
        """Return the executor of the tasks of a model in blocks."""
        return executor_of(self.method.blocks.workers, self.method.blocks.scheduler)

    def memory(self) -> MemoryPlan:
        """Compute the memory of an undivided run; an unknown count is taken as all splats."""
        info, most = self.info, self.count or self.info.splats
        return memory_of(self.request, info.splats, info.sh_degree, info.extra_bytes(), most)

    @property
    def read(self) -> bool:
        """Whether planning reads the splats and counts the usable ones, or only headers."""
        return self.divided or self.request.goal.size is not None or bool(self.request.filters)

    @property
    def condition(self) -> str:
        """A clause on printed counts, which may follow from headers alone; empty if they do not."""
        return "" if self.read else ", if none holds a NaN or an infinite value"

    def shown(self) -> "RunPlan":
        """Complete the plan for printing by reading the splats: count after filters, and blocks.

        Raises:
            NanogsError: The run is not possible.
        """
        request = self.request
        if self.divided:
            settings, blocks = self._divide()
            left = None
            if settings.search is None:
                left = request.counts(blocks.splats, settings.result_layout)[0]
            info = replace(self.info, splats=blocks.splats)
            return replace(self, blocks=blocks, info=info, count=left, usable=blocks.splats)
        if not self.read:
            return self
        splats = changed(read_parts(request.inputs, request.render_mode), request.edits).splats
        rows, goal = usable_rows(splats, request.nan), request.goal
        request.refuse_small_size(splats.take(first_two(splats, rows)))
        count = target_of(
            goal, splats, len(rows), request.output, request.parameters, request.sh_degree
        )
        info = replace(self.info, splats=len(splats))
        return replace(self, info=info, count=count, usable=len(rows))

    def _divide(self) -> tuple[Settings, BlockPlan]:
        elsewhere = self.method.blocks.scheduler is not None
        return plan_job(with_limit(self.in_blocks, elsewhere=elsewhere))

    def notes(self) -> list[str]:
        """Return notes on the use of blocks and their options, one sentence each."""
        notes = self.method.blocks.unused(divided=self.divided)
        if not self.divided:
            return notes
        each = self.process_memory
        fits = self.memory().peak <= self.free.bytes
        if fits or each is None or not self.found_free:
            return notes
        how = f"it is simplified in blocks, as with --max-memory {each / 1e6:g}MB."
        return [*notes, f"{self._too_large()}: {how}"]

    def refuse_whole_model_wishes(self, *, piped: bool) -> None:
        """Refuse requests that need the whole model in memory.

        Args:
            piped: Whether a model comes from stdin or goes to stdout.

        Raises:
            NotEnoughMemoryError: There is such a request, and the model does not fit.
            OptionError: There is one, and the model would fit but for another option.
        """
        whole_only = {
            "--drop-floaters": any(each.whole for each in self.request.filters),
            "a model in a pipe, which blocks cannot read or write,": piped,
            f"the preset {self.method.preset}": isinstance(self.method.chosen, PaperParameters),
        }
        for option, asked in whole_only.items():
            if asked:
                needs = f"but {option} needs the whole model in memory"
                if self.memory().peak <= self.free.bytes:
                    divides = self.method.blocks.dividing
                    raise OptionError(
                        f"{divides} divides a model into blocks, {needs}; leave out one of the two."
                    )
                raise NotEnoughMemoryError(
                    f"{self._too_large()}; blocks would take less, {needs}: leave that out, or"
                    " provide more memory."
                )

    def _too_large(self) -> str:
        peak, parts = bytes_text(self.memory().peak), len(self.request.inputs)
        model = self.name if parts == 1 else f"The model of {parts:,} files"
        return f"{model} takes about {peak} of memory, and {self.free}"

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as plain values, for JSON."""
        return {
            "input": self.name,
            "input_count": self.info.splats,
            "read_count": self.read_count,
            "preset": self.method.preset,
            "parameters": asdict(self.request.parameters),
            "memory_bytes": asdict(self.memory()),
            "blocks": self.blocks and asdict(self.blocks),
        }


def request_of(method: Method, goal: Goal, **given: Any) -> Request:  # noqa: ANN401 - its fields
    """Build the request to the library from the options.

    Args:
        method: Options of the method and of its execution.
        goal: The requested count, size or quality.
        **given: Other fields of the request.

    Raises:
        OptionError: An option is invalid.
    """
    edits, blocks = method.edits, method.blocks
    patience = PATIENCE if blocks.patience is None else blocks.patience
    return Request(
        goal=goal, preset=method.preset, overrides=method.overrides, measured=method.measure,
        max_memory=blocks.max_memory, job=blocks.job, scratch=blocks.scratch,
        resume=blocks.resume, nan=method.nan, filters=parse_filters(edits),
        sh_degree=edits.sh_degree, render_mode=edits.render_mode, cameras=method.cameras,
        up=method.up, threads=method.threads, patience=patience, **given,
    )  # fmt: skip


def plan_run(
    request: Request,
    method: Method,
    *,
    piped: bool = False,
) -> RunPlan:
    """Plan a run, and decide whether it is divided into blocks; only headers are read.

    Args:
        request: The request to the library.
        method: Options of the method and of its execution.
        piped: Whether a model comes from stdin or goes to stdout.

    Raises:
        NanogsError: The run is not possible.
    """
    info, goal = inspect_parts(request.inputs), request.goal
    count, free = goal.known_count(info.splats), allowed_memory(request.max_memory)
    plan = RunPlan(
        request=request, method=method, info=info, read_count=info.splats, count=count, free=free
    )  # fmt: skip
    if plan_files(request).divided:
        plan.refuse_whole_model_wishes(piped=piped)
        return replace(plan, divided=True)
    return plan


def execute(plan: RunPlan, do: Callable[[Request], T]) -> T:
    """Execute a plan by calling `do` with its request; blocks are done by the plan's executor."""
    request = plan.request
    if not plan.divided:
        keep_freed_memory()
        prepare_kernels(_preset_of_kernels(request))
    with without_gc():
        import_stages(request.parameters)
    if plan.divided:
        with plan.executor() as executor, resumable(request.folder / MANIFEST):
            return do(replace(plan.in_blocks, executor=executor, threads=plan.threads))
    return do(request)


def _preset_of_kernels(request: Request) -> str:
    """Return a preset that needs the kernels of a run."""
    if renders(request.parameters) or request.is_compared:
        return DEFAULT_PRESET
    return "paper" if isinstance(request.parameters, PaperParameters) else "fast"


def show_plan(plan: RunPlan, text: str) -> None:
    """Print a plan on stderr; `text` describes the output."""
    info, memory, splats = plan.info, plan.memory(), counted(plan.read_count, "splat")
    if info.splats < plan.read_count:
        splats += f", of which {info.splats:,} remain"
    rows = {
        "would read": f"{plan.name} ({splats}, SH degree {info.sh_degree})",
        "would write": text,
        "preset": plan.method.preset,
        "parameters": value_text(effective(plan.request.parameters)),
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
            "scratch": f"{bytes_text(blocks.scratch)} on the disk, including the result",
            "time": f"about {blocks.seconds:,.0f} s of one processor",
        }
    show(err, key_value_table(rows))
