"""`nanogs.simplify`: simplify a model in memory, and report what was done."""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from nanogs.bar import show_progress
from nanogs.card.device import device_notes, use_device
from nanogs.clock import StageClock
from nanogs.frames import checked_frames, turned
from nanogs.io import registry
from nanogs.io.format import FormatOptions, given_options
from nanogs.io.models import Model, as_splats
from nanogs.pipeline.checks import refuse_device, refuse_reduced, refuse_searches, refuse_small_size
from nanogs.pipeline.in_memory import CheckedModel, NanPolicy, check_model
from nanogs.pipeline.options.presets import (
    DEFAULT_PRESET,
    parameters,
    renders,
    with_longer_fit,
)
from nanogs.pipeline.options.target import Goal, chooses_packing, shared_in_file, target_of
from nanogs.pipeline.outcome import Outcome
from nanogs.progress import Progress, Tracker
from nanogs.quantities import as_bytes
from nanogs.report import SimplifyReport, StopReason
from nanogs.splats import Splats, check_degree, refuse_misaligned_elements

if TYPE_CHECKING:
    from nanogs.pipeline.search.files import HeldFiles
    from nanogs.views.cameras import Cameras


def simplify(
    model: Model,
    *,
    ratio: float | None = None,
    count: int | None = None,
    size: int | str | None = None,
    psnr: float | None = None,
    draw_cost: float | None = None,
    format: str = ".ply",  # noqa: A002 - the usual name
    format_options: FormatOptions | None = None,
    preset: str = DEFAULT_PRESET,
    sh_degree: int | None = None,
    frame: tuple[str, str] | None = None,
    cameras: "Cameras | None" = None,
    up: Sequence[float] | None = None,
    nan: NanPolicy = "drop",
    device: str | None = None,
    threads: int | None = None,
    max_memory: int | str | None = None,
    progress: Progress | bool | None = None,
    **overrides: Any,  # noqa: ANN401 - checked against the preset's parameters
) -> tuple[Splats, SimplifyReport]:
    """Simplify a model to a ratio, a count, a file size, a PSNR or a draw cost.

    Exactly one of the five is given. A ratio and a count are met exactly.

    Args:
        model: The model, which is not changed, or a path.
        ratio: Compaction ratio in (0, 1]: ceil(ratio x finite splats) are delivered.
        count: Number of splats to deliver.
        size: Largest allowed size of the saved file in bytes, a number or text like "20MB". Presets
            that render choose the degree of the harmonics by rendering, and for .sog and .spz the
            palette and the bits; as many splats as then fit are delivered. Where the size is only
            known by writing the file, results are written until one fits and takes at least 98 %
            of it. Save the result with the options given here and with those chosen,
            `format_options` of the report.
        psnr: PSNR in dB that the result must reach as `nanogs compare` measures it at its defaults,
            on held-out views. The count is searched for; the result, as read back from a file of
            the format, reaches this PSNR and exceeds it by at most 0.3 dB. Where the size of a file
            is only known by writing it, the degree, the palette and the bits are chosen as for
            `size`, for the smallest file.
        draw_cost: Highest allowed cost of drawing the result, as a share of the model's own splats
            per pixel (see `draw_cost`), on the views of `compare` at its defaults: the largest
            count that stays within it is searched for, until the cost is at most 2 % below it, or
            half a per cent more splats exceed it.
        format: Suffix of the file that the result will be saved as, to which `size`, `psnr` and
            `draw_cost` refer. If its splats share harmonics, as in .sog, presets that fit let them
            share as many before the fit, which makes good a part of the loss. Fitted values are
            rounded for .sog and .spz: those that hardly show so that the file is smaller.
        format_options: Options that the file will be saved with, as `save` takes them.
        preset: Name of a preset.
        sh_degree: Degree of the result's spherical harmonics, which are fitted for it; by default
            the model's, unless `size` or `psnr` chooses it.
        frame: Source and target frame to turn the result from and to, such as ("rdf", "rub"); a
            size and a PSNR are those of the turned file.
        cameras: Views that matter, for presets that render: "auto", "orbit", "inside", "roam", a
            file or folder of cameras, or cameras; by default automatic.
        up: (3,) up direction of views that are found; by default found from the model too.
        nan: What to do with splats that hold a NaN or an infinity (opacities of exactly 0 or 1 and
            scales of 0 are allowed): "drop" them and say so in the report, or raise an "error".
        device: Where presets that render look and fit: "cpu", which is the default; "cuda" for a
            graphics card; "auto" for a graphics card if there is one. Merging always runs on the
            CPU. Results differ in the last digits; the notes name a device other than the CPU.
        threads: Number of threads; all by default. The result does not depend on it.
        max_memory: Bytes that this process may take, a number or text like "4GB"; by default nine
            tenths of the free memory. If more is needed, an error is raised before anything is
            computed.
        progress: True for a bar, in a notebook or on a terminal, or a function that is called with
            each `nanogs.progress.Step`: the stage, its number and the number of stages, and the
            fraction of the whole that is done; the last step has the fraction 1.
        **overrides: Parameters of the preset to replace, such as `k=8`.

    Returns:
        The smaller model, its rows in the order of the input, and the report.

    Raises:
        FormatError: The path cannot be read as a model.
        OptionError: An option is out of range; the size is too small for one splat; the draw cost
            is too small for the fewest splats that the model can be merged to; or the device does
            not exist or has nothing to do.
        NotEnoughMemoryError: It takes more memory than is free or allowed.
        ModelError: No splat is usable; `nan="error"` and one is not; a PSNR or a draw cost is asked
            for and nothing is visible; or other elements of the file have a row for each splat,
            which would be lost.
    """
    start, clock = time.perf_counter(), StageClock()
    chosen = parameters(preset, overrides)  # first, so that a misspelt target is named
    size = None if size is None else as_bytes(size)
    goal = Goal(ratio, count, size, psnr, draw_cost)
    path, given = registry.file_of(format), given_options(format_options)
    known = registry.writable(path)
    registry.keywords(known, given)  # refuses options that the format does not have
    if chooses_packing(goal, known):
        overrides = with_longer_fit(preset, overrides)
        chosen = parameters(preset, overrides)
    refuse_searches(goal, preset, path)
    refuse_reduced(goal, chosen, sh_degree)
    refuse_device(device, preset, chosen, goal)
    check_degree(sh_degree)
    frame = checked_frames(frame)
    # Imported here because this imports Numba, which `--help` and `info` do without.
    from nanogs.pipeline.estimates.durations import simplify_stages
    from nanogs.pipeline.search.files import HeldFiles
    from nanogs.pipeline.size_ending import with_size_ending
    from nanogs.threads import use_threads

    with (
        use_device(device) as used,
        use_threads(threads) as threads_used,
        show_progress(progress) as on_step,
    ):
        splats = as_splats(model)
        with clock.time("check"):
            sharing = shared_in_file(goal, known, given)
            checked = check_model(splats, preset, overrides, cameras, up, nan, sh_degree, sharing)
            splats = checked.splats
            target = target_of(goal, splats, len(checked.rows), path, checked.parameters, sh_degree)
            refuse_misaligned_elements(splats, 1 if target is None else target)
            search = (goal, known) if target is None else None
            checked.refuse_too_large(target, max_memory, judged=target is None, search=search)
        tracker = Tracker(
            on_step,
            simplify_stages(checked.parameters, goal, len(checked.rows), target, known),
        )
        files = HeldFiles(path, given, checked.splats, clock, frame, by_psnr=psnr is not None)
        if target is None:
            outcome = _searched(checked, goal, files, threads_used, tracker)
            target = len(outcome.splats)
        else:
            outcome = _delivered(checked, target, files, threads_used, tracker)
            if size is not None:
                achieved = registry.sizer(path)(outcome.splats, target)
                outcome = replace(outcome, fields={"achieved_size": achieved})
        tracker.finish()
    if size is not None:
        counts, degree = (len(outcome.splats), len(checked.rows)), checked.splats.sh_degree
        outcome = with_size_ending(
            outcome, size, known.file_bytes, counts, lambda: outcome.splats, degree=degree
        )
    small = turned(outcome.splats, frame)
    report = checked.report(goal, target, outcome, threads_used, clock, start)
    ignored = known.without_effect(given, small.sh_degree)
    return small, replace(report, notes=(*report.notes, *ignored, *device_notes(device, used)))


def _delivered(
    checked: CheckedModel, target: int, files: "HeldFiles", threads: int, progress: Tracker
) -> Outcome:
    """Make the result of a known count, with values that pack well in its file."""
    from nanogs.pipeline.rounded import rounded_for_file

    clock = files.clock
    deliver = checked.deliverer(target, threads, clock, progress)
    outcome = deliver(target, clock, progress)
    return rounded_for_file(
        outcome, checked.parameters, files.output, files.given, files.frame, clock, progress
    )


def _searched(
    checked: CheckedModel, goal: Goal, files: "HeldFiles", threads: int, progress: Tracker
) -> Outcome:
    """Search for the result that meets a size, a PSNR or a draw cost."""
    from nanogs.pipeline.search.find import find_result
    from nanogs.pipeline.search.results import HeldResults
    from nanogs.pipeline.search.size_request import SizeRequest

    some, looks = _sample(checked), renders(checked.parameters)
    request = SizeRequest(goal.size or 0, files.known, files.given, checked.sh_degree, looks=looks)

    def grown() -> HeldResults:
        return HeldResults(checked.build(threads, files.clock, progress), files.clock)

    if goal.size is not None:
        refuse_small_size(request, some, files)
    found = find_result(goal, request, grown, lambda: some, files, progress)
    outcome, fields, notes = found
    stop = fields.pop("stop")
    if goal.size is not None and outcome.stop is not StopReason.TARGET:
        stop = outcome.stop
    return replace(outcome, stop=stop, fields=fields, notes=(*outcome.notes, *notes))


def _sample(checked: CheckedModel) -> Splats:
    """Return evenly spread usable splats, all that are encoded to guess the size of files."""
    from nanogs.pipeline.search.file_size import SIZE_SAMPLE

    every = -(-len(checked.rows) // SIZE_SAMPLE)
    return checked.splats.take(checked.rows[::every])
