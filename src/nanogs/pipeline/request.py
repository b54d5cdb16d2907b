"""A request for smaller files, and the decision between a model in memory and blocks."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nanogs.block_layouts import Chunked, Linked
from nanogs.card.device import CPU, use_device
from nanogs.clock import StageClock
from nanogs.defaults import PATIENCE
from nanogs.errors import OptionError
from nanogs.filters import Filter, checked_filters
from nanogs.frames import checked_frames
from nanogs.io import registry
from nanogs.io.files import splat_bytes
from nanogs.io.format import Format, FormatOptions, Sharing, Sizer, given_options
from nanogs.io.retag import checked_mode
from nanogs.io.url_files import refuse_address
from nanogs.io.urls import Address, is_url
from nanogs.memory import allowed_memory
from nanogs.pipeline.checks import refuse_device, refuse_reduced, refuse_searches, refuse_small_size
from nanogs.pipeline.estimates.block_plan import MemoryLimit
from nanogs.pipeline.estimates.memory import (
    MemoryPlan,
    plan_levels,
    plan_memory,
    plan_search,
    plan_writing,
)
from nanogs.pipeline.in_memory import NanPolicy, check_nan
from nanogs.pipeline.job.folder import MANIFEST, job_folder, refuse_finished
from nanogs.pipeline.options.cameras import are_asked, refuse_unused_views
from nanogs.pipeline.options.presets import (
    DEFAULT_PRESET,
    Parameters,
    parameters,
    renders,
    with_longer_fit,
    with_usual_pixels,
)
from nanogs.pipeline.options.target import (
    Goal,
    chooses_packing,
    count_for_size,
    is_searched,
    shared_in_file,
    target_count,
)
from nanogs.pipeline.reading import Changes, open_parts
from nanogs.ranges import as_switch, is_number
from nanogs.source import Joined, Layout
from nanogs.splats import Splats, check_degree
from nanogs.store.columns import no_splats, row_bytes

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from distributed import Client

    from nanogs.views.cameras import Cameras


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Request:
    """A request for a smaller file; the fields are the arguments of `simplify_blocks`.

    Attributes:
        goal: The target: a ratio, count, size, PSNR or draw cost.
        overrides: Parameters of the preset to replace, by name.
        measured: Whether the result is compared with the input as `nanogs compare` does it; None
            to do so if the preset renders anyway and the model is in memory.
        limit: The reason for `max_memory`.
        ratios: Ratios of levels, the finest first, which `goal` has too; empty for one file.
        block_layout: How levels are divided or linked, or None for a file each.
        level_suffix: Format of the files of levels that are not divided or linked.
        environment: Text that identifies the environment written beside levels; empty for none.
        notes: Notes on the request itself, for the report.
    """

    goal: Goal
    inputs: tuple[Path, ...] = ()
    output: Path = Path()
    preset: str = DEFAULT_PRESET
    overrides: dict[str, Any] = field(default_factory=dict)
    measured: bool | None = False
    max_memory: int | None = None
    limit: MemoryLimit = MemoryLimit.GIVEN
    block: int | None = None
    job: Path | None = None
    scratch: str | None = None
    resume: bool = False
    overwrite: bool = False
    nan: NanPolicy = "drop"
    filters: Sequence[Filter] = ()
    sh_degree: int | None = None
    frame: tuple[str, str] | None = None
    render_mode: str | None = None
    cameras: "Cameras | None" = None
    up: Sequence[float] | None = None
    device: str | None = None
    threads: int | None = None
    executor: "Client | Executor | None" = None
    patience: float = PATIENCE
    format_options: FormatOptions | None = None
    ratios: Sequence[float] = ()
    block_layout: Chunked | Linked | None = None
    level_suffix: str = ".ply"
    environment: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse values that are not valid, before anything is read."""
        object.__setattr__(self, "filters", checked_filters(self.filters))
        object.__setattr__(self, "frame", checked_frames(self.frame))
        check_nan(self.nan)
        check_degree(self.sh_degree)
        for name in ("measured", "resume", "overwrite"):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, as_switch(f"`{name}`", value))
        if self.block is not None and not (is_number(self.block, whole=True) and self.block >= 1):
            raise OptionError(
                f"`block` must be a whole number of splats, 1 or more, not {self.block!r}."
            )
        if not is_number(self.patience) or not self.patience >= 0:
            raise OptionError(f"`patience` must be seconds, 0 or more, not {self.patience!r}.")
        self._refuse_files_in_output()
        object.__setattr__(self, "format_options", given_options(self.format_options))
        known = registry.find(self.output)
        if known is not None and chooses_packing(self.goal, known):
            object.__setattr__(self, "overrides", with_longer_fit(self.preset, self.overrides))
        if self.ratios:
            object.__setattr__(self, "overrides", with_usual_pixels(self.preset, self.overrides))
        # A job is stored as JSON, which has no NumPy integers.
        for name in ("block", "sh_degree"):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, int(value))

    def _refuse_files_in_output(self) -> None:
        """Refuse a place for the files of a job that is the output, or inside it."""
        if self.output == Path() or isinstance(self.output, Address):  # not known yet, or a URL
            return
        for name in ("job", "scratch"):
            place = getattr(self, name)
            if place is None or is_url(str(place)):
                continue
            if Path(os.path.realpath(place)).is_relative_to(os.path.realpath(self.output)):
                raise OptionError(
                    f"{place} is the output or in it, so it cannot hold the files of the job; name"
                    f" another folder with `{name}`."
                )

    @property
    def goals(self) -> tuple[Goal, ...]:
        """The goal of each result, the finest first."""
        return tuple(Goal(ratio=ratio) for ratio in self.ratios) or (self.goal,)

    @property
    def parameters(self) -> Parameters:
        """Parameters of the method.

        Raises:
            OptionError: There is no such preset or parameter.
        """
        return parameters(self.preset, self.overrides)

    @property
    def edits(self) -> Changes:
        """Changes to the model: splats and harmonics left out, render mode; results are turned.

        If results are fitted, `sh_degree` applies to them and not to the model, so that they are
        fitted to all that views show.
        """
        fitted, mode = renders(self.parameters), checked_mode(self.render_mode)
        return Changes(self.filters, None if fitted else self.sh_degree, mode)

    @property
    def suffix(self) -> str:
        """Suffix of the output's format."""
        known = registry.find(self.output)
        return known.suffix if known else self.output.suffix

    @property
    def sizer(self) -> Sizer | None:
        """Computes the size of the output for a count; None if a file must be written for it."""
        return None if self.ratios else registry.writable(self.output).file_bytes

    @property
    def file(self) -> Path:
        """The output, or for levels an example of the name of a file that holds splats."""
        suffix = self.block_layout.suffix if self.block_layout else self.level_suffix
        return Path(f"level_0{suffix}") if self.ratios else self.output

    @property
    def result_format(self) -> Format | None:
        """The format of the file that each result is; None if files hold parts of levels."""
        return None if self.block_layout else self.written_format

    @property
    def written_format(self) -> Format:
        """The format of `file`."""
        return registry.writable(self.file)

    @property
    def sharing(self) -> Sharing | None:
        """How splats share harmonics in each file; None if each has its own or files hold parts."""
        if self.block_layout is not None:
            return None
        return shared_in_file(self.goal, self.written_format, self.format_options or {})

    def searches(self, degree: int) -> bool:
        """Whether the count of a result, of a model of an SH degree, is found only by trying."""
        free = degree if self.sh_degree is None else 0
        known, looks = registry.writable(self.output), renders(self.parameters)
        return is_searched(self.goal, known, degree=free, looks=looks)

    def counts(self, splats: int, layout: Layout) -> list[int]:
        """Return the number of splats of each result, if a search is not needed to find it.

        Args:
            splats: Number of splats of the model.
            layout: Columns of the results.

        Raises:
            OptionError: Not even one splat fits, or the model has fewer splats than are asked for.
        """
        if self.goal.size is None or (sizer := self.sizer) is None:
            return [target_count(splats, goal.ratio, goal.count) for goal in self.goals]
        like = no_splats(layout)
        return [count_for_size(splats, self.goal.size, lambda count: sizer(like, count))]

    @property
    def is_compared(self) -> bool:
        """Whether the result of a model in memory is compared with the input.

        `Goal.is_measured` is something else: that the count is found by measuring results.
        """
        return renders(self.parameters) if self.measured is None else self.measured

    @property
    def folder(self) -> Path:
        """Folder of the job, if the request becomes one."""
        return job_folder(self.output, self.job)

    @property
    def begun(self) -> bool:
        """Whether there is a job to continue."""
        return self.resume and (self.folder / MANIFEST).exists()

    def check(self) -> None:
        """Refuse combinations that are not possible, before anything is read.

        Raises:
            OptionError: A search is asked of a preset that has none, or a PSNR of a model whose
                harmonics are left out first; or there is no such device or format to write, or the
                device or views would have nothing to do.
        """
        refuse_device(self.device, self.preset, self.parameters, self.goal)
        refuse_searches(self.goal, self.preset, self.output)
        refuse_reduced(self.goal, self.parameters, self.sh_degree)
        self.refuse_unused_views()

    def refuse_unused_views(self) -> None:
        """Refuse `cameras` and `up` for a preset that renders nothing.

        Raises:
            OptionError: One of them is given.
        """
        given = are_asked(self.cameras, self.up)
        refuse_unused_views(self.preset, self.parameters, given=given)

    def refuse_small_size(self, some: Splats) -> None:
        """Refuse a size that is far too small for any result.

        Args:
            some: Usable splats of the model, one at least.

        Raises:
            TooSmallError: It is.
        """
        if self.goal.size is None:
            return
        from nanogs.pipeline.search.files import HeldFiles
        from nanogs.pipeline.search.size_request import SizeRequest

        known, given = registry.writable(self.output), self.format_options or {}
        looks = renders(self.parameters)
        request = SizeRequest(self.goal.size, known, given, self.sh_degree, looks=looks)
        files = HeldFiles(self.output, given, some, StageClock(), self.frame)
        refuse_small_size(request, some, files)

    def refuse_device_in_blocks(self) -> None:
        """Refuse any device but the CPU for a model in blocks.

        Raises:
            OptionError: Another device is asked for; "auto" is the CPU if there is no card.
        """
        with use_device(self.device) as used:
            if used == CPU:
                return
            raise OptionError(
                'A model in blocks is rendered and fitted only on the CPU; use `device="cpu"`, or'
                " leave out the options for blocks and allow more memory with `max_memory`."
            )

    def check_addresses(self) -> None:
        """Refuse URLs of models in jobs that read them again, later or on other machines.

        Raises:
            OptionError: There is one.
        """
        asked = {"resume": self.resume, "job": self.job, "executor": self.executor}
        for name in (name for name, given in asked.items() if given):
            for path in (*self.inputs, self.output):
                refuse_address(
                    path, f"leave `{name}` out, or name a local file that stays where it is"
                )

    def continues_job(self) -> bool:
        """Whether there is a job to continue, which checks its output itself.

        Raises:
            OutputError: There is no job to continue, but the output exists.
        """
        if self.resume and not self.overwrite:
            refuse_finished(self.folder, self.output)
        return self.begun


@dataclass(frozen=True, slots=True)
class RequestPlan:
    """The way in which a request is going to be met.

    Attributes:
        splats: Number of splats of the inputs.
        sh_degree: Of their harmonics.
        divided: Whether it is met in blocks.
    """

    splats: int
    sh_degree: int
    divided: bool


def plan_files(request: Request) -> RequestPlan:
    """Decide between a model in memory and blocks, for every caller; no row is read.

    The model is held in memory if it fits, unless the request has something that only jobs have: a
    block size, a job or scratch folder, an executor, or that it can be resumed.

    Raises:
        NanogsError: An input cannot be read, or there is no such preset or parameter.
    """
    with Joined(open_parts(request.inputs, request.render_mode)) as source:
        splats, layout = source.count, source.columns
    target = _most(request.goal, splats)
    extra = row_bytes(layout) - splat_bytes(layout.sh_degree)
    memory = memory_of(request, splats, layout.sh_degree, extra, target)
    asked = request.block or request.job or request.scratch or request.executor or request.resume
    divided = bool(asked or memory.peak > allowed_memory(request.max_memory).bytes)
    return RequestPlan(splats, layout.sh_degree, divided)


def _most(goal: Goal, splats: int) -> int:
    """Return the largest number of splats that a result can have."""
    if goal.size is not None or goal.is_measured or (goal.count or 0) > splats:
        return splats
    return target_count(splats, goal.ratio, goal.count)


def memory_of(request: Request, splats: int, degree: int, extra: int, target: int) -> MemoryPlan:
    """Compute the memory that a request takes with the model in memory.

    Args:
        request: What is asked for.
        splats: Of the model.
        degree: Of the spherical harmonics.
        extra: Bytes of extra columns for each splat.
        target: Splats of the largest result.
    """
    # A preset that renders takes as much memory before as measuring one result does.
    compared = request.is_compared and (bool(request.ratios) or not renders(request.parameters))
    searched = not request.ratios and request.searches(degree)
    judged = compared or searched
    plan = plan_memory(splats, degree, extra, request.parameters, target, judged=judged)
    if searched:
        plan = plan_search(plan, splats, request.goal, registry.writable(request.output))
    if request.block_layout is None:
        known = request.written_format
        if known.needs_whole_model(request.format_options or {}):
            return plan_writing(plan, splats, target, known)
        return plan
    return plan_levels(plan, splats, degree, target, request.ratios, request.block_layout)
