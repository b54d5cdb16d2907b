"""The request to `nanogs lod`, once its options have been read: plan it, and do it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from nanogs.cli import in_blocks
from nanogs.cli.console import warn
from nanogs.cli.lod_run import print_levels_plan, write_whole
from nanogs.cli.reading import Reading, inspect_parts, read_parts
from nanogs.cli.simplify_report import Plan
from nanogs.cli.too_large import Blocks, refuse_other_files, refuse_whole_model_wishes
from nanogs.io.folder import check_folder_writable
from nanogs.lod.layout import Output, made_files
from nanogs.pipeline.asked import asked_views
from nanogs.pipeline.presets import Parameters, renders
from nanogs.pipeline.rows import Changes
from nanogs.pipeline.target import Goal, target_count


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """A request, as the options make it.

    Attributes:
        parts: The files of the model.
        output: Where the levels go.
        ratios: From the finest level to the coarsest.
        preset: Name of the preset.
        chosen: Parameters of the method.
        reading: What is done to the model first.
        blocks: How a model is treated that does not fit into memory.
        given: What `write_levels` takes beside, in blocks too.
        turn: Frames from and to which the levels are turned, or None.
        measure: Whether levels are held against the model; None for where the preset renders.
        cameras: As `requested_cameras` takes it.
        up: Up direction of automatic views, or None.
        threads: Threads to use, or None for all.
        overwrite: Replace the folder if nanogs lod made it.
        json: Whether the result is said as JSON alone.
        quiet: Whether nothing is said but errors.
    """

    parts: Sequence[Path]
    output: Output
    ratios: tuple[float, ...]
    preset: str
    chosen: Parameters
    reading: Reading
    blocks: Blocks
    given: dict[str, Any]
    turn: tuple[str, str] | None
    measure: bool | None
    cameras: str
    up: tuple[float, float, float] | None
    threads: int | None
    overwrite: bool
    json: bool
    quiet: bool

    @property
    def changes(self) -> Changes:
        """Changes to a model in blocks besides making it smaller."""
        asked = asked_views(self.cameras, self.up)
        return Changes(self.reading.filters, self.reading.sh_degree, self.turn, asked)

    @property
    def hushed(self) -> bool:
        """Whether nothing is said on the way."""
        return self.quiet or self.json


def plan_levels(request: Request) -> Plan:
    """Check what can be checked without the splats, and say what is going to be done.

    Raises:
        NanogsError: It cannot be done.
    """
    output, blocks, chunk = request.output, request.blocks, request.given["chunk"]
    info = inspect_parts(request.parts)
    # A job sees to its output itself.
    if not blocks.is_begun(output.folder, overwrite=request.overwrite):
        check_folder_writable(output.folder, made_files, overwrite=request.overwrite)
    finest = target_count(info.splats, request.ratios[0], None)
    plain = request.given["plain"]
    encoding = in_blocks.levels_encoding(info, request.ratios, output, chunk, plain=plain)
    measured = renders(request.chosen) if request.measure is None else request.measure
    plan = Plan(
        info, Goal(ratio=request.ratios[0]), finest, request.preset, request.chosen, encoding,
        measured=measured, joined=blocks.joined,
    )  # fmt: skip
    if not blocks.needed(plan, output.folder):
        return plan
    plan = replace(plan, divided=True)
    refuse_other_files(output.suffix)
    refuse_whole_model_wishes(
        plan, blocks, filters=request.reading.filters,
        measured=bool(request.measure),
    )  # fmt: skip
    in_blocks.warn_of_blocks(plan, blocks, output.folder, quiet=request.hushed)
    return plan


def show_levels_plan(request: Request, plan: Plan) -> None:
    """Say what would be done.

    Raises:
        NanogsError: It cannot be done.
    """
    parts, output, ratios, blocks = request.parts, request.output, request.ratios, request.blocks
    divided = None
    if plan.divided:
        given = request.given | {"changes": request.changes}
        divided = in_blocks.levels_plan(parts, output, ratios, blocks, given)
        plan = _of_so_many(plan, divided.splats)
    elif request.reading.filters:
        plan = _of_so_many(plan, len(request.reading.prepare(read_parts(parts)).splats))
    for note in () if plan.divided or request.hushed else blocks.unused():
        warn(note)
    print_levels_plan(plan, output, ratios, divided, json=request.json)


def make_levels(request: Request, plan: Plan) -> dict[str, Any]:
    """Make the levels, whole or in blocks; the manifest with the files' names and the reports.

    Raises:
        NanogsError: It cannot be done.
    """
    parts, output, ratios, blocks = request.parts, request.output, request.ratios, request.blocks
    if plan.divided:
        return in_blocks.levels_in_blocks(
            parts, output, ratios, blocks, request.threads,
            request.given | {"overwrite": request.overwrite, "changes": request.changes},
            quiet=request.hushed,
        )  # fmt: skip
    blocks.refuse_fitting(output.folder)
    given = request.given | {"threads": request.threads, "frame": request.turn}
    given |= {"max_memory": blocks.max_memory, "measured": plan.measured}
    run = write_whole(
        plan, parts, request.reading, output, ratios, request.overwrite, request.cameras,
        request.up, given, request.hushed,
    )  # fmt: skip
    return run | {"notes": [*blocks.unused(), *run["notes"]]}


def _of_so_many(plan: Plan, splats: int) -> Plan:
    """The plan for what filters leave, which only the splats tell."""
    count = target_count(splats, plan.goal.ratio, None)
    return replace(plan, info=replace(plan.info, splats=splats), count=count)
