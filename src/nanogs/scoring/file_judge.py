"""Scoring written files: they are read back and compared with the original model."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from nanogs.costs import DrawCost
from nanogs.errors import FormatError, ModelError
from nanogs.frames import back, turned
from nanogs.io import load, registry
from nanogs.io import open as open_model
from nanogs.progress import PartProgress, ignore_progress
from nanogs.protocol import UNMEASURED, Judged, PackingLoss
from nanogs.source import Source, turned_source
from nanogs.splats import Splats
from nanogs.switches import PixelOf, SwitchQuality

if TYPE_CHECKING:
    from nanogs.scoring.draw_views import DrawViews
    from nanogs.scoring.held_out import HeldOut
    from nanogs.scoring.switch_views import SwitchViews

T = TypeVar("T")


@dataclass(slots=True, eq=False)
class FileJudge:
    """Measures files against the original, or notes why that is not possible.

    Attributes:
        views: Test views of the original, which no method learns from; None if scores are not
            measured.
        held: Whether files are loaded; otherwise they are read some rows at a time.
        turn: The coordinate frames (from, to) of the change made to the files' models, or None;
            it is undone before they are measured.
        threads: Threads to use, or None for all.
        notes: Why nothing is measured, one sentence each.
        drawing: Draw cost of the original; None if costs are not measured.
        original: The original, to measure levels at the distances at which viewers switch to them;
            None if that is not measured.
        max_memory: Bytes that this process may take for that if the original is a source; by
            default the free memory.
    """

    views: "HeldOut | None" = None
    held: bool = True
    turn: tuple[str, str] | None = None
    threads: int | None = None
    notes: tuple[str, ...] = ()
    drawing: "DrawViews | None" = None
    original: Splats | Source | None = None
    max_memory: int | None = None
    _switching: "SwitchViews | None" = None

    def of(self, path: Path, level: int = 0) -> Judged | None:
        """Score a file; None if it cannot be measured, and a note then says why.

        Args:
            path: The file.
            level: Level of detail of a streamed model.
        """
        views = self.views
        if views is None:
            return None
        return self._tried(lambda: self._judged(views, path, level), None)

    def costs(self, path: Path, level: int = 0) -> tuple[DrawCost, ...]:
        """Return the draw costs of a file and of the original; () if they cannot be measured.

        Args:
            path: The file.
            level: Level of detail of a streamed model.
        """
        if self.drawing is None:
            return ()
        drawing = self.drawing

        def measure() -> tuple[DrawCost, ...]:
            with open_model(path, level=level) as file:
                return drawing.cost(self._source_back(file)), drawing.original

        return self._tried(measure, ())

    def quality_at_switch(self, path: Path, level: int, pixel_of: PixelOf) -> SwitchQuality | None:
        """Score a level at the distance at which a viewer switches to it.

        Args:
            path: The file.
            level: Level of detail, 1 or more.
            pixel_of: Gives the pixel size, scene units, at which the viewer switches.

        Returns:
            None if it cannot be measured.
        """
        if self.views is None or self.original is None:
            return None
        from nanogs.scoring.switch_views import switch_views, typical_deviation

        original, cameras = self.original, [view.camera for view in self.views.views]

        def measure() -> SwitchQuality | None:
            with self._read(path, level) as model:
                if self._switching is None:
                    self._switching = switch_views(original, cameras, self.max_memory)
                return self._switching.judge(model, pixel_of(level, typical_deviation(model)))

        return self._tried(measure, None)

    def beside(self, path: Path, result: Splats) -> tuple[Judged | None, PackingLoss | None]:
        """Return the scores of a file, and the loss due to packing alone if its format rounds.

        Args:
            path: The file.
            result: The model that was written to it.
        """
        known = registry.writable(path)
        if self.views is None or not known.rounds:
            return self.of(path), None
        views = self.views

        def measure() -> tuple[Judged | None, PackingLoss | None]:
            both = self._turned_back(result), self._turned_back(load(path))
            return views.judge_packed(*both, known.suffix)

        nothing: tuple[Judged | None, PackingLoss | None] = None, None
        return self._tried(measure, nothing)

    def _tried(self, measure: Callable[[], T], otherwise: T) -> T:
        """Return `measure()`, or `otherwise` if the model or file does not allow it.

        The reason is added to the notes, once for all files.
        """
        from nanogs.threads import use_threads

        try:
            with use_threads(self.threads):
                return measure()
        except (ModelError, FormatError) as error:
            note = _unmeasured(error)
            if note not in self.notes:
                self.notes = (*self.notes, note)
            return otherwise

    def _turned_back(self, splats: Splats) -> Splats:
        return turned(splats, back(self.turn))

    def _source_back(self, file: Source) -> Source:
        return turned_source(file, back(self.turn))

    def _judged(self, views: "HeldOut", path: Path, level: int) -> Judged:
        with self._read(path, level) as model:
            return views.judge(model)

    @contextmanager
    def _read(self, path: Path, level: int) -> Iterator[Splats | Source]:
        """Open a level of a file, loaded or as a source, in the frame of the original."""
        if self.held:
            yield self._turned_back(load(path, level=level))
            return
        with open_model(path, level=level) as source:
            yield self._source_back(source)


def file_judge(
    original: Splats | Source,
    suffix: str,
    *,
    turn: tuple[str, str] | None = None,
    threads: int | None = None,
    on_progress: PartProgress = ignore_progress,
    max_memory: int | None = None,
    costs: bool = False,
) -> FileJudge:
    """Render the original once, for any number of files.

    Args:
        original: The model; a source is read some rows at a time, and so are the files then.
        suffix: Format of the files.
        turn: The coordinate frames (from, to) of the change made to the files' models, or None.
        threads: Threads to use, or None for all.
        on_progress: Receives the progress in views rendered.
        max_memory: Bytes that this process may take to render a source; by default the free memory.
        costs: Also measure draw costs, and levels at the distances at which viewers switch to them.
    """
    known = registry.find(Path(f"model{suffix}"))
    if known is not None and not known.readable:
        # The draw cost is not named: a search for one has measured it on the model itself.
        reason = f"PSNR and SSIM were not measured: nanogs does not read {known.suffix} files."
        return FileJudge(notes=(reason,))
    from nanogs.scoring.held_out import held_out
    from nanogs.threads import use_threads

    try:
        with use_threads(threads):
            views = held_out(original, on_progress, max_memory)
            drawing = _drawing(original) if costs else None
    except (ModelError, FormatError) as error:
        return FileJudge(notes=(_unmeasured(error),))
    held, looked = isinstance(original, Splats), original if costs else None
    return FileJudge(
        views, held, turn, threads, drawing=drawing, original=looked, max_memory=max_memory
    )


def _drawing(original: Splats | Source) -> "DrawViews":
    from nanogs.scoring.draw_views import draw_views

    return draw_views(original)


def file_costs(
    original: Splats | Source,
    path: Path,
    turn: tuple[str, str] | None = None,
    threads: int | None = None,
) -> tuple[DrawCost, ...]:
    """Return the draw costs of a file and of its original; () if they cannot be measured.

    Args:
        original: The model; a source is read some rows at a time.
        path: The file.
        turn: The coordinate frames (from, to) of the change made to the file's model, or None.
        threads: Threads to use, or None for all.
    """
    known = registry.find(path)
    if known is not None and not known.readable:
        return ()
    from nanogs.threads import use_threads

    try:
        with use_threads(threads):
            judge = FileJudge(turn=turn, threads=threads, drawing=_drawing(original))
    except ModelError:  # nothing of it is visible, which the notes of its scores say
        return ()
    return judge.costs(path)


def _unmeasured(error: ModelError | FormatError) -> str:
    """Return the note on why a file has no scores; of a model, the same that making it gives."""
    nothing = "rendered or measured" if isinstance(error, ModelError) else "measured"
    return f"Nothing was {nothing}: {str(error).removeprefix(UNMEASURED)}"
