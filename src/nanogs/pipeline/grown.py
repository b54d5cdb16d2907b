"""`nanogs.grow`: a model with its merge forest, from which any count is made quickly."""

import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from threading import RLock
from typing import TYPE_CHECKING, Any

from nanogs.bar import show_progress
from nanogs.card.device import device_notes, use_device
from nanogs.clock import StageClock
from nanogs.formatting import counted
from nanogs.io import registry, round_trip_with_size
from nanogs.io.format import FormatOptions, given_options
from nanogs.io.models import Model, as_splats
from nanogs.pipeline.checks import refuse_device
from nanogs.pipeline.in_memory import CheckedModel, NanPolicy, check_model
from nanogs.pipeline.options.presets import DEFAULT_PRESET, parameters, refuse_search
from nanogs.pipeline.options.target import Goal, target_count
from nanogs.pipeline.outcome import Outcome
from nanogs.progress import PartProgress, Progress, Stage, Tracker
from nanogs.protocol import Judged
from nanogs.report import SimplifyReport
from nanogs.splats import Splats, check_degree, refuse_misaligned_elements, refuse_other

if TYPE_CHECKING:
    from nanogs.pipeline.one_block import OneBlock
    from nanogs.scoring.held_out import HeldOut
    from nanogs.views.cameras import Cameras


@dataclass(frozen=True, slots=True)
class Measured:
    """Size and scores of a result as a file.

    Attributes:
        bytes: Bytes of the file, or of all files if the format is a folder.
        judged: Scores of the file, as read back, against the model it was made of.
    """

    bytes: int
    judged: Judged


class Grown:
    """A model that has been rendered from its views and has its merge forest; see `nanogs.grow`.

    Several threads may use it: they make results one after the other, and measure them one after
    the other; while one thread measures, another may make results.

    Attributes:
        available: Number of splats that results are made of: the finite ones.
        fewest: The smallest count that can be delivered.
        seconds: Time that growing took, by stage.
    """

    def __init__(
        self,
        original: Splats,
        checked: CheckedModel,
        scene: "OneBlock",
        clock: StageClock,
        device: str | None,
        threads: int | None,
    ) -> None:
        """Store the results of `grow`.

        Args:
            original: The model with all of its harmonics, which results are compared with.
            checked: The model and the method.
            scene: The model with its visibility and its forest.
            clock: The seconds that growing took.
            device: Device on which results are rendered and fitted.
            threads: Number of threads; None for all.
        """
        from nanogs.pipeline.search.results import HeldResults

        self._original, self._checked, self._scene = original, checked, scene
        self._device, self._threads = device, threads
        self._making, self._measuring = RLock(), RLock()
        self._held_out: HeldOut | None = None
        self._plain = HeldResults(scene, StageClock()).plain(rounds=0)
        self.available = len(checked.rows)
        self.fewest = scene.forest.fewest
        self.seconds = dict(clock.seconds)

    def __repr__(self) -> str:
        return (
            f"Grown({counted(self.available, 'splat')}, which can become {self.fewest:,} or more;"
            f" preset {self._checked.preset})"
        )

    def draft(self, count: int) -> Splats:
        """Make a quick model of a count: one cut of the forest, nothing rendered or fitted.

        Args:
            count: Number of splats to deliver; below `fewest` that many are delivered.

        Returns:
            The model, its rows in the order of the input.

        Raises:
            OptionError: The count is below 1, or above the number of usable splats.
            ModelError: Other elements of the file have a row for each splat, which would be lost.
        """
        count = self._checked_count(count)
        if count == self.available:
            return self._checked.whole().splats
        with self._alone(self._making):
            return self._plain.make(count, Tracker(None, ())).splats

    def simplify(
        self,
        count: int,
        *,
        format: str = ".ply",  # noqa: A002 - as `nanogs.simplify` calls it
        format_options: FormatOptions | None = None,
        progress: Progress | bool | None = None,
    ) -> tuple[Splats, SimplifyReport]:
        """Simplify to a count as `nanogs.simplify` does, without growing the forest again.

        Args:
            count: Number of splats to deliver.
            format: Suffix of the file that the result will be saved as: fitted values are rounded
                for .sog and .spz. Harmonics are not shared before the fit, as `simplify` does it.
            format_options: Options that the file will be saved with.
            progress: As `nanogs.simplify` takes it.

        Returns:
            The same model as of `nanogs.simplify`, and its report, without the time of growing.

        Raises:
            OptionError: The count is below 1, or above the number of usable splats; or the format
                cannot be written, or there is no such option.
            ModelError: Other elements of the file have a row for each splat, which would be lost.
        """
        from nanogs.pipeline.estimates.durations import count_stages
        from nanogs.pipeline.rounded import rounded_for_file

        count, path = self._checked_count(count), registry.file_of(format)
        given, known = given_options(format_options), registry.writable(path)
        registry.keywords(known, given)  # refuses options that the format does not have
        checked, start, clock = self._checked, time.perf_counter(), StageClock()
        stages = count_stages(checked.parameters, self.available, count, known)
        with (
            show_progress(progress) as on_step,
            self._alone(self._making) as (device, threads),
        ):
            tracker = Tracker(on_step, stages)
            outcome = self._delivered(count, clock, tracker)
            outcome = rounded_for_file(
                outcome, checked.parameters, path, given, None, clock, tracker
            )
            tracker.finish()
        report = checked.report(Goal(count=count), count, outcome, threads, clock, start)
        notes = device_notes(self._device, device)
        return outcome.splats, replace(report, notes=(*report.notes, *notes))

    def measure(
        self,
        splats: Splats,
        *,
        format: str = ".ply",  # noqa: A002 - as `nanogs.simplify` calls it
        format_options: FormatOptions | None = None,
        progress: Progress | bool | None = None,
    ) -> Measured:
        """Compare a result, as read back from its file, with the model as `nanogs compare` does.

        Of a page (.html), which nanogs does not read, it compares what the page shows.

        The views of the model are rendered when they are first needed, and kept: 3 MB each.

        Args:
            splats: The result.
            format: Suffix of the file.
            format_options: Options of the format, as `nanogs.save` takes them.
            progress: As `nanogs.simplify` takes it.

        Returns:
            Bytes of the file, and its PSNR and SSIM.

        Raises:
            OptionError: The format cannot be written, or there is no such option.
            ModelError: Nothing of the model is visible, or the result is no `Splats`.
        """
        refuse_other(splats)
        path = registry.file_of(format)
        stages = [Stage("measure", 1.0), Stage("encode", 0.2), Stage("score", 1.0)]
        with show_progress(progress) as on_step, self._alone(self._measuring):
            tracker = Tracker(on_step, stages)
            tracker.begin("measure")
            views = self._views(tracker.part)
            tracker.begin("encode")
            on_part = tracker.passing()
            stored, size = round_trip_with_size(splats, path, format_options, progress=on_part)
            tracker.begin("score")
            judged = views.judge(stored)
            tracker.finish()
        return Measured(size, judged)

    def __getstate__(self) -> dict[str, Any]:
        locks = ("_making", "_measuring")
        return {name: value for name, value in self.__dict__.items() if name not in locks}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _making=RLock(), _measuring=RLock())

    @contextmanager
    def _alone(self, lock: AbstractContextManager[bool]) -> Iterator[tuple[str, int]]:
        """Wait for other threads that do the same, by their lock; then as `_on`.

        All results are made in one scene, which measuring does not use.
        """
        with lock, _on(self._device, self._threads) as used:
            yield used

    def _views(self, on_progress: PartProgress) -> "HeldOut":
        """Render the model on the held-out views of `compare`, on the first call only."""
        from nanogs.scoring.held_out import held_out

        if self._held_out is None:
            self._held_out = held_out(self._original, on_progress)
        return self._held_out

    def _delivered(self, count: int, clock: StageClock, progress: Tracker) -> Outcome:
        from nanogs.pipeline.run import deliver

        if count == self.available:
            return self._checked.whole()
        return deliver(self._scene, count, clock, progress)

    def _checked_count(self, count: int) -> int:
        """Return a count as a number of Python's.

        Raises:
            OptionError: It is below 1, or above the number of usable splats.
            ModelError: Other elements of the file have a row for each splat, which would be lost.
        """
        count = target_count(self.available, None, count)
        refuse_misaligned_elements(self._checked.splats, count)
        return count


def grow(
    model: Model,
    *,
    preset: str = DEFAULT_PRESET,
    sh_degree: int | None = None,
    cameras: "Cameras | None" = None,
    up: Sequence[float] | None = None,
    nan: NanPolicy = "drop",
    device: str | None = None,
    threads: int | None = None,
    max_memory: int | str | None = None,
    progress: Progress | bool | None = None,
    **overrides: Any,  # noqa: ANN401 - checked against the preset's parameters
) -> Grown:
    """Render the views of a model and grow its merge forest, from which any count can be made.

    With presets that do not fit, this is nearly all the time that `nanogs.simplify` takes. Use a
    `Grown` to try several counts; for ratios known in advance, use `nanogs.levels`.

    Args:
        model: The model, which is not changed, or a path.
        preset: Name of a preset that grows a forest: any but `paper`.
        sh_degree: As `nanogs.simplify` takes it.
        cameras: As `nanogs.simplify` takes it.
        up: As `nanogs.simplify` takes it.
        nan: As `nanogs.simplify` takes it.
        device: As `nanogs.simplify` takes it.
        threads: Number of threads; all by default. Results do not depend on it.
        max_memory: As `nanogs.simplify` takes it.
        progress: As `nanogs.simplify` takes it.
        **overrides: Parameters of the preset to replace, such as `k=8`.

    Returns:
        The model with its forest, which makes and measures results.

    Raises:
        FormatError: The path cannot be read as a model.
        OptionError: An option is out of range, the preset grows no forest, or the device is not
            available.
        ModelError: No splat is usable, or `nan="error"` and one is not.
        NotEnoughMemoryError: It takes more memory than is free or allowed.
    """
    refuse_search(preset, "several counts")
    chosen, clock = parameters(preset, overrides), StageClock()
    # A PSNR as the goal: `measure` renders, so that a card has work even if the preset does not.
    refuse_device(device, preset, chosen, Goal(psnr=1.0))
    check_degree(sh_degree)
    from nanogs.pipeline.estimates.durations import build_stages

    with show_progress(progress) as on_step, _on(device, threads) as (_, used):
        original = as_splats(model)
        with clock.time("check"):
            checked = check_model(original, preset, overrides, cameras, up, nan, sh_degree)
            checked.refuse_too_large(None, max_memory, judged=True)
        tracker = Tracker(on_step, build_stages(checked.parameters, len(checked.rows)))
        scene = checked.build(used, clock, tracker)
        tracker.finish()
    return Grown(original, checked, scene, clock, device, threads)


@contextmanager
def _on(device: str | None, threads: int | None) -> Iterator[tuple[str, int]]:
    """Use a device and a number of threads; yield those actually in use."""
    from nanogs.threads import use_threads  # imported here because it imports Numba

    with use_device(device) as used, use_threads(threads) as threads_used:
        yield used, threads_used
