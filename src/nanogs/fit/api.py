"""`nanogs.refit`: fit a small model to renders of the original, and report on it."""

import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

from nanogs.bar import show_progress
from nanogs.card.device import device_notes, use_device
from nanogs.clock import StageClock
from nanogs.errors import ModelError, OptionError
from nanogs.fit.parameters import RefitParameters
from nanogs.fit.report import RefitReport
from nanogs.fit.stages import refit_stages
from nanogs.formatting import counted, undrawn
from nanogs.io import registry
from nanogs.io.format import FormatOptions, given_options, shared_entries
from nanogs.io.frames import other_frames
from nanogs.io.limits import refuse_unstorable
from nanogs.io.models import Model, as_splats, opened
from nanogs.progress import PartProgress, Progress, Tracker
from nanogs.ranges import one_or_several
from nanogs.splats import Splats

if TYPE_CHECKING:
    from nanogs.fit.groups import ViewGroup
    from nanogs.fit.rounds import Fitted
    from nanogs.fit.targets import Fitting
    from nanogs.raster.camera import Camera


def refit(
    original: Model,
    small: Model,
    *,
    cameras: Sequence["Camera"] | None = None,
    parameters: RefitParameters | None = None,
    format: str = ".ply",  # noqa: A002 - the name in `load`
    format_options: FormatOptions | None = None,
    device: str | None = None,
    threads: int | None = None,
    progress: Progress | bool | None = None,
) -> tuple[Splats, RefitReport]:
    """Fit a small model's centres, scales, rotations, opacities and colours to the original.

    The original is rendered from a number of cameras. Some of these views are held out for
    validation, in groups by picture size and distance, and changes that do not improve them are
    undone. So the result is never worse than the input there, in the mean of any group.

    Args:
        original: The model to fit to, or a path.
        small: The model to fit, from any tool, or a path; its count, degree and further columns
            are kept.
        cameras: Views of the scene, of any sizes and distances; by default they are chosen from the
            original.
        parameters: See `RefitParameters`.
        format: Suffix of the file that the result will be saved as. If splats share harmonics
            there, as in .sog, they do so in the result, and the fit makes good a part of the loss;
            the input then counts as if it were shared already.
        format_options: Options that the file will be saved with, as `save` takes them.
        device: The device that renders and fits, as in `nanogs.simplify`.
        threads: Number of threads; all by default. The result does not depend on it.
        progress: True for a bar, in a notebook or on a terminal, or a function that is called with
            each `nanogs.progress.Step`, from "render" and "fit" to the last, whose
            fraction is 1.

    Returns:
        The fitted model, its rows in the order of the input, and the report.

    Raises:
        FormatError: A path cannot be read as a model.
        OptionError: An option is out of range, there are fewer than two cameras, or there is no
            such device or format.
        OutputError: In files of the format splats share harmonics, and it cannot store some of the
            small model's values.
        ModelError: A model has no visible splat, or the two do not show the same scene.
    """
    begin, clock = time.perf_counter(), StageClock()
    chosen = parameters or RefitParameters()
    if not isinstance(chosen, RefitParameters):
        raise OptionError(
            f"`parameters` must be nanogs.RefitParameters, not {type(chosen).__name__}; a"
            " dictionary becomes them by RefitParameters(**dictionary)."
        )
    cameras = None if cameras is None else _listed(cameras)
    known, options = registry.writable(registry.file_of(format)), given_options(format_options)
    registry.keywords(known, options)  # refuses options that the format does not have
    sharing = known.sharing_with(options)
    # Imported here because these import Numba, which `--help` must not wait for.
    from nanogs.fit.views import view_targets
    from nanogs.raster.camera import camera_notes
    from nanogs.threads import use_threads
    from nanogs.views.cameras import frame_notes

    with (
        use_device(device) as used,
        use_threads(threads) as threads_used,
        show_progress(progress) as on_step,
    ):
        with (
            opened(original, "the original") as first,
            opened(small, "the small model") as second,
        ):
            frames = other_frames([(getattr(each, "name", ""), each) for each in (first, second)])
            large, given = as_splats(first), as_splats(second)
        unusable = [*_unusable(large, "original"), *_unusable(given, "small")]
        if sharing is not None:  # such a value cannot be part of a shared set either
            refuse_unstorable(given, known.suffix)
        entries = shared_entries(sharing, given.sh_degree, len(given))
        tracker = Tracker(on_step, refit_stages(chosen, len(large), len(given)))
        tracker.begin("render")
        with clock.time("render"):
            fitting, deciding, unseen = view_targets(large, given, cameras, chosen, tracker.part)
        tracker.begin("fit")
        fitted, report = fit_to_views(
            given, fitting, deciding, chosen, len(large), threads_used, tracker.part, entries
        )
        tracker.finish()
    return fitted.splats, replace(
        report,
        seconds=clock.seconds | report.seconds,
        total_seconds=time.perf_counter() - begin,
        notes=(
            *frames,
            *_swapped(len(large), len(given)),
            *unusable,
            *camera_notes(cameras or ()),
            *frame_notes(cameras or (), large),
            *unseen,
            *report.notes,
            *known.without_effect(options, given.sh_degree),
            *device_notes(device, used),
        ),
    )


def fit_to_views(
    small: Splats,
    fitting: "Fitting",
    deciding: Sequence["ViewGroup"],
    parameters: RefitParameters,
    original_count: int,
    threads: int,
    on_progress: PartProgress,
    entries: int | None = None,
) -> tuple["Fitted", RefitReport]:
    """Fit a small model to given views.

    Args:
        small: The model.
        fitting: Views of the original to fit to, at least one, kept or to be rendered.
        deciding: Groups of validation views, at least one, which decide how much is kept.
        parameters: See `RefitParameters`.
        original_count: Number of splats of the original, for the report.
        threads: Number of threads in use, for the report.
        on_progress: Progress callback: number of steps made, and their largest possible number.
        entries: Largest number of sets of higher harmonics that the splats are to share; None if
            each has its own.
    """
    from nanogs.fit.rounds import fit
    from nanogs.fit.shared import fit_shared

    clock = StageClock()
    with clock.time("fit"):
        if entries is None:
            fitted = fit(small, fitting, deciding, parameters, on_progress)
        else:
            fitted = fit_shared(small, entries, fitting, deciding, parameters, on_progress)
    outcome = fitted.outcome
    report = RefitReport(
        parameters=asdict(parameters),
        original_count=original_count,
        count=len(fitted.splats),
        fit_views=fitting.names,
        validation_views=tuple(name for group in outcome.groups for name in group.views),
        seconds=clock.seconds,
        total_seconds=sum(clock.seconds.values()),
        threads=threads,
        **outcome._asdict(),
    )
    return fitted, report


def _listed(cameras: "Sequence[Camera] | Camera") -> "list[Camera]":
    """Return the cameras that a caller gives as a list, because they are iterated repeatedly.

    Raises:
        OptionError: They are not cameras, or one is invalid.
    """
    # Not needed by `--help`.
    from nanogs.raster.camera import Camera
    from nanogs.views.cameras import check_cameras

    found = one_or_several(cameras)
    if not all(isinstance(each, Camera) for each in found):
        raise OptionError("`cameras` of a refit must be a list of at least two nanogs.Camera.")
    check_cameras(found)
    return found


def _swapped(original: int, small: int) -> tuple[str, ...]:
    """Return a note if the original has fewer splats than the model that is fitted to it."""
    if small <= original:
        return ()
    note = (
        f"The original has {counted(original, 'splat')}, fewer than the {small:,} of the model that"
        " was fitted to it; if the two were swapped, give the original first."
    )
    return (note,)


def _unusable(splats: Splats, name: str) -> tuple[str, ...]:
    """Return the note on splats of a model that are not drawn.

    Raises:
        ModelError: None is.
    """
    usable = int(splats.finite().sum())
    if not usable:
        raise ModelError(
            f"The {name} model holds no usable splat: it is empty, or each row has a NaN or an "
            "infinite value; check the file it came from."
        )
    left_out = len(splats) - usable
    return (f"Of the {name} model, {undrawn(left_out)}.",) if left_out else ()
