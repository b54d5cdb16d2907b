"""`nanogs.simplify`: from a model and a wish to a smaller model and a report."""

import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nanogs.bar import drawn
from nanogs.card.device import AUTO, CPU, check_device, device_notes, use_device
from nanogs.clock import StageClock
from nanogs.errors import OptionError
from nanogs.frames import change_frame, checked_frames
from nanogs.io import registry
from nanogs.io.format import FormatOptions
from nanogs.io.models import Model, as_splats
from nanogs.pipeline.job import Job, NanPolicy, prepare_job
from nanogs.pipeline.outcome import Outcome
from nanogs.pipeline.presets import (
    DEFAULT_PRESET,
    Parameters,
    parameters,
    refuse_search,
    renders,
)
from nanogs.pipeline.target import Goal, count_for_size, is_searched
from nanogs.progress import Progress, Tracker
from nanogs.quantities import as_bytes
from nanogs.report import SimplifyReport, StopReason
from nanogs.splats import Splats, check_degree, refuse_misaligned_elements

if TYPE_CHECKING:
    from nanogs.pipeline.held_files import HeldFiles
    from nanogs.pipeline.wish import Wish
    from nanogs.views.cameras import Cameras


def simplify(
    model: Model,
    *,
    ratio: float | None = None,
    count: int | None = None,
    size: int | str | None = None,
    psnr: float | None = None,
    draw_cost: float | None = None,
    format: str = ".ply",  # noqa: A002 - what it is called everywhere
    format_options: FormatOptions | None = None,
    preset: str = DEFAULT_PRESET,
    sh_degree: int | None = None,
    frame: tuple[str, str] | None = None,
    cameras: "Cameras | None" = None,
    nan: NanPolicy = "drop",
    device: str | None = None,
    threads: int | None = None,
    max_memory: int | str | None = None,
    progress: Progress | bool | None = None,
    **overrides: Any,  # noqa: ANN401 - checked against the preset's parameters
) -> tuple[Splats, SimplifyReport]:
    """A smaller model of the same scene: of the ratio, count, size, PSNR or draw cost asked for.

    Exactly one of the five is given. A ratio and a count are met exactly.

    Args:
        model: The model, which is not changed, or a path.
        ratio: Compaction ratio in (0, 1]: ceil(ratio x finite splats) are delivered.
        count: Splats to deliver.
        size: Bytes that the saved file may have, a number or text like "20MB": as many splats as
            fit are delivered. Where only writing a file tells its size, results are written until
            one fits that takes 98 % of it or more; presets that render choose by looking how many
            harmonics and how large a palette are written, too, and `format_options` of the report
            has what to save the result with.
        psnr: dB that the result must reach as `nanogs compare` measures it at its defaults, on
            views that nothing is learnt from. A count is searched whose result lies from there to
            0.3 dB above, as a file of the format gives it back.
        draw_cost: Most that the result may take to draw, as a share of the model's own splats a
            pixel (see `draw_cost`), on the views of `compare` at its defaults: the largest count
            is searched that takes so much, to 2 % below it.
        format: Suffix of the file that `size`, `psnr` and `draw_cost` are about.
        format_options: What that file will be saved with, as `save` takes it.
        preset: Name of a preset.
        sh_degree: Of the result's harmonics, which are fitted for it; by default the model's, or
            where `size` is searched for and the preset renders, whichever shows most.
        frame: From and to which the result is turned, such as ("rdf", "rub"); a size and a PSNR are
            of the file of what is turned.
        cameras: Views that matter, for presets that render: "auto", "orbit", "inside", "roam", a
            file or folder of cameras, or cameras; by default automatic.
        nan: What to do with splats that hold a NaN or an infinity (an infinite opacity logit is
            data and does not count): "drop" them and say so in the report, or raise.
        device: Where presets that render look and fit: "cpu", which is the default; "cuda" for a
            graphics card, "auto" for one where there is one. What is merged is merged on the CPU.
            Results differ in the last digits; the notes name another device than the CPU.
        threads: Threads to use; all by default. The result does not depend on it.
        max_memory: Bytes that this process may take, a number or text like "4GB"; by default what
            is free, less a tenth. More is refused before anything is computed.
        progress: True for a bar, in a notebook or on a terminal, or a function that is called with
            each `nanogs.progress.Step`: the stage, which of how many it is, and the
            fraction of the whole that is done; the last step has the fraction 1.
        **overrides: Parameters of the preset to replace, such as `k=8`.

    Returns:
        The smaller model, its rows in the order of the input, and the report.

    Raises:
        FormatError: The path cannot be read as a model.
        OptionError: An option is out of range, or the size is less than one splat takes, or the
            draw cost less than the fewest splats that the model can be made of; or there is no such
            device, or nothing for it to do.
        NotEnoughMemoryError: It takes more memory than is free or allowed.
        ModelError: No splat is usable, `nan="error"` and one is not, or a PSNR or a draw cost is
            asked for and nothing is visible.
    """
    start, clock = time.perf_counter(), StageClock()
    size = None if size is None else as_bytes(size)
    goal = Goal(ratio, count, size, psnr, draw_cost)
    chosen, given = parameters(preset, overrides), format_options or {}
    path = registry.file_of(format)
    refuse_searches(goal, preset, path)
    refuse_device(device, preset, chosen, goal)
    check_degree(sh_degree)
    frame = checked_frames(frame)
    # Here and not above: this brings Numba, which `--help` and `info` do without.
    from nanogs.pipeline.foreseen import simplify_stages
    from nanogs.pipeline.held_files import HeldFiles
    from nanogs.threads import use_threads

    with use_device(device) as used, use_threads(threads) as threads_used, drawn(progress) as tell:
        splats = as_splats(model)
        with clock.time("check"):
            job = prepare_job(splats, preset, overrides, cameras, nan, sh_degree)
            splats = job.splats
            target = target_of(goal, splats, len(job.rows), path, job.parameters, sh_degree)
            refuse_misaligned_elements(splats, 1 if target is None else target)
            job.refuse_too_large(target, max_memory, judged=target is None)
        tracker = Tracker(
            tell,
            simplify_stages(job.parameters, goal, len(job.rows), target, path.suffix),
        )
        files = HeldFiles(path, given, job.splats, clock, frame, by_psnr=psnr is not None)
        if target is not None:
            outcome = job.deliverer(target, threads_used, clock, tracker)(target, clock, tracker)
            if size is not None:
                achieved = registry.sizer(path)(outcome.splats, target)
                outcome = replace(outcome, achieved_size=achieved)
        elif size is not None:
            outcome = _fit(job, size, files, threads_used, tracker)
        elif draw_cost is not None:
            outcome = _lighten(job, draw_cost, files, threads_used, tracker)
        else:
            outcome = _reach(job, goal.psnr or 0.0, files, threads_used, tracker)
        target = len(outcome.splats) if target is None else target
        tracker.finish()
    if size is not None:
        outcome = _with_size_notes(outcome, size, len(job.rows), path)
    small = change_frame(outcome.splats, *frame) if frame else outcome.splats
    report = job.report(goal, target, outcome, threads_used, clock, start)
    return small, replace(report, notes=(*report.notes, *device_notes(device, used)))


def _with_size_notes(outcome: Outcome, size: int, available: int, path: Path) -> Outcome:
    """The outcome that says, where it is so, why much of the size is not used."""
    from nanogs.pipeline.fit_size import WHOLE_FITS, notes_on_known

    small, file_bytes = outcome.splats, registry.writable(path).file_bytes
    notes: tuple[str, ...] = (WHOLE_FITS,) if len(small) == available else ()
    if file_bytes is not None:
        known = file_bytes
        notes = notes_on_known(size, len(small), available, lambda count: known(small, count))
    return replace(outcome, notes=(*outcome.notes, *notes))


def refuse_device(device: str | None, preset: str, chosen: Parameters, goal: Goal) -> None:
    """Refuse a device that cannot be had, or a card where nothing is rendered, for nothing to do.

    Args:
        device: What was asked for; "auto" asks for none where there is none.
        preset: Name of the preset.
        chosen: Its parameters.
        goal: What is asked.

    Raises:
        OptionError: It is one of these.
    """
    looks = renders(chosen) or goal.psnr is not None
    if device not in (None, CPU, AUTO) and not looks:
        raise OptionError(
            f"The preset {preset} renders nothing, so that a card has nothing to do; take"
            ' `device="cpu"`, or another preset.'
        )
    check_device(device)


def refuse_searches(goal: Goal, preset: str, path: Path) -> None:
    """Refuse, before anything is read, a wish that only a search can meet and a preset cannot.

    Args:
        goal: What is asked.
        preset: Name of a preset.
        path: What will be written; only its suffix counts.

    Raises:
        OptionError: The preset runs anew for every count, or the format is not written, or not as
            one file, which a size or a PSNR is of.
    """
    if goal.psnr is not None:
        refuse_search(preset, "a PSNR")
    elif goal.draw_cost is not None:
        refuse_search(preset, "a draw cost")
    known = registry.writable(path)
    if goal.size is not None and known.file_bytes is None:
        refuse_search(preset, f"the size of a {known.suffix} file")
    if known.write is None and (goal.size is not None or goal.psnr is not None):
        asked = "size" if goal.psnr is None else "psnr"
        raise OptionError(
            f"`{asked}` is for models in one file, and {known.suffix} describes a folder; write a"
            " .sog file."
        )


def target_of(
    goal: Goal,
    splats: Splats,
    available: int,
    path: Path,
    chosen: Parameters,
    sh_degree: int | None = None,
) -> int | None:
    """The count that a wish comes to; None where only trying can tell.

    Args:
        goal: What is asked.
        splats: The model.
        available: Its usable splats.
        path: What will be written; only its suffix counts.
        chosen: Parameters of the method.
        sh_degree: Of the result's harmonics, if it is asked for.

    Raises:
        OptionError: It cannot be had from this model, or not in this format.
    """
    if goal.size is None:
        return goal.known_count(available)
    known = registry.writable(path)
    if known.file_bytes is None:
        return None
    file_bytes = known.file_bytes
    like = splats if sh_degree is None else splats.with_sh_degree(sh_degree)
    degree = splats.sh_degree if sh_degree is None else 0
    searched = is_searched(goal, known, degree=degree, looks=renders(chosen))
    if searched and file_bytes(like, available) > goal.size:
        return None
    return count_for_size(available, goal.size, lambda count: file_bytes(like, count))


def refuse_small(wish: "Wish", some: Splats, files: "HeldFiles") -> None:
    """Refuse, before anything is computed, a size that is far too small.

    Args:
        wish: What is asked of the file.
        some: Usable splats of the model, one at least.
        files: Writes some to see what they take.

    Raises:
        TooSmallError: It is.
    """
    from nanogs.pipeline.fit_size import refuse_hopeless

    smallest = wish.smallest(some.sh_degree)
    lowest = some.with_sh_degree(smallest.sh_degree)
    if (file_bytes := wish.known.file_bytes) is not None:
        count_for_size(1, wish.size, lambda _count: file_bytes(lowest, 1))
    else:
        refuse_hopeless(lowest, wish.size, lambda one: files.sample_bytes(one, smallest.options(1)))


def _fit(job: Job, size: int, files: "HeldFiles", threads: int, progress: Tracker) -> Outcome:
    from nanogs.pipeline.pack import Packer
    from nanogs.pipeline.results import HeldResults
    from nanogs.pipeline.sized import fill_size
    from nanogs.pipeline.wish import Wish

    usable, clock = job.splats.take(job.rows), files.clock
    known, looks = registry.writable(files.path), renders(job.parameters)
    wish = Wish(size, known, files.given, job.sh_degree, looks=looks)
    refuse_small(wish, usable, files)
    results = HeldResults(job.build(threads, clock, progress), clock)
    outcome, found = fill_size(Packer(results, wish, usable, files, progress))
    fitted, packed = found.fitted, found.packed
    left_over = fitted.leap(size, results.available, known.around())
    return replace(
        outcome,
        stop=fitted.stop if outcome.stop is StopReason.TARGET else outcome.stop,
        achieved_size=fitted.bytes,
        size_probes=fitted.probes,
        notes=(*outcome.notes, *left_over, *packed.notes),
        **packed.entries(len(outcome.splats)),
    )


def _reach(job: Job, psnr: float, files: "HeldFiles", threads: int, progress: Tracker) -> Outcome:
    from nanogs.pipeline.pack import PackNear
    from nanogs.pipeline.reach import reach_psnr
    from nanogs.pipeline.results import HeldResults
    from nanogs.pipeline.wish import Wish
    from nanogs.scoring.held_out import held_out

    clock = files.clock
    progress.begin("measure")
    with clock.time("measure"):
        views = held_out(job.splats, progress.part)

    def stored(outcome: Outcome) -> Splats:
        return files.stored(outcome.splats, pack.options(outcome))

    def psnr_of(outcome: Outcome) -> float:
        with clock.time("measure"):
            return views.psnr(stored(outcome))

    results = HeldResults(job.build(threads, clock, progress), clock)
    wish = Wish(0, registry.writable(files.path), files.given, job.sh_degree)
    pack = PackNear(results, wish, lambda: job.splats.take(job.rows), files, progress)
    outcome, found = reach_psnr(results, psnr, psnr_of, progress, pack)
    if found.stop is StopReason.UNREACHED:  # and so the whole model is written, as it is
        pack.packed = None
    with clock.time("measure"):
        judged = views.judge(stored(outcome))
    entries = pack.entries(outcome)
    notes = (*outcome.notes, *pack.notes)
    return replace(
        outcome, probes=found.probes, stop=found.stop, judged=judged, notes=notes, **entries
    )


def _lighten(
    job: Job, asked: float, files: "HeldFiles", threads: int, progress: Tracker
) -> Outcome:
    from nanogs.pipeline.draw import meet_cost
    from nanogs.pipeline.results import HeldResults
    from nanogs.scoring.draw_views import draw_views

    clock = files.clock
    progress.begin("measure")
    with clock.time("measure"):
        views = draw_views(job.splats, progress.part)

    def share_of(outcome: Outcome, *, stored: bool = True) -> float:
        with clock.time("measure"):
            small = files.stored(outcome.splats, {}) if stored else outcome.splats
            return views.share(small)

    results = HeldResults(job.build(threads, clock, progress), clock)
    quick = partial(share_of, stored=False)
    outcome, found = meet_cost(results, asked, share_of, quick, progress)
    with clock.time("measure"):
        cost = views.cost(files.stored(outcome.splats, {}))
    return replace(
        outcome, draw_probes=found.probes, stop=found.stop, cost=cost, original_cost=views.original
    )
