"""The views that a result is judged by: those of `nanogs compare` at its defaults.

Nothing is learnt from them: what methods look at, choose by and fit to are views of the other
split (see `views.automatic`). So a number from here is the one that `compare` prints.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nanogs.errors import FormatError, ModelError
from nanogs.frames import change_frame
from nanogs.io import load, registry
from nanogs.io import open as open_model
from nanogs.memory import allowed_memory
from nanogs.metrics import psnr
from nanogs.needs import pictures_bytes
from nanogs.progress import Parts, untold
from nanogs.protocol import BLACK, PIXELS, VIEWS, Judged, Protocol
from nanogs.raster.rendering import PreparedSplats
from nanogs.scoring.scores import ReferenceView, mean_psnr, reference_views, score
from nanogs.source import Source, Turned
from nanogs.splats import Splats
from nanogs.threads import use_threads
from nanogs.views.cameras import cameras_for
from nanogs.views.plan import room_for_splats
from nanogs.views.streamed import Streamed, drawable, renderings


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """The original as views show it that nothing is learnt from.

    Attributes:
        views: Those in which it is seen; 3 MB each.
        protocol: What they are.
        max_memory: Bytes that this process may take, where models are read some rows at a time; by
            default what is free.
    """

    views: Sequence[ReferenceView]
    protocol: Protocol
    max_memory: int | None = None

    def psnr(self, small: Splats | Source) -> float:
        """The PSNR that `judge` gives, alone and in half the time, dB.

        Raises:
            FormatError: The source cannot be read.
            NotEnoughMemoryError: The source cannot be rendered in so little memory.
        """
        cameras = [view.camera for view in self.views]
        shown = renderings(_drawable(small, self.max_memory), cameras, background=BLACK)
        pairs = zip(shown, self.views, strict=True)
        return mean_psnr([psnr(view.image, rendering.shown()) for rendering, view in pairs])

    def judge(self, small: Splats | Source) -> Judged:
        """Hold a model against the original; it raises what `psnr` does."""
        means = score("", _drawable(small, self.max_memory), self.views, BLACK)
        return Judged(means.psnr, means.ssim, self.protocol)


def judge_file(
    original: Splats | Source,
    path: Path,
    *,
    turn: tuple[str, str] | None = None,
    threads: int | None = None,
    tell: Parts = untold,
    max_memory: int | None = None,
) -> tuple[Judged | None, tuple[str, ...]]:
    """Hold a file against the original that it was made of.

    Args:
        original: The model; of a source some rows are read at a time, and of the file too.
        path: The file.
        turn: Frames from and to which the file's model was turned, or None.
        threads: Threads to use; all by default.
        tell: Told of the original's views rendered.
        max_memory: As `held_out` takes it.

    Returns:
        What was measured and no note; or None and why nothing could be, in a sentence.
    """
    known = registry.find(path)
    if known is not None and not known.readable:
        return None, (f"The result was not measured: nanogs does not read {known.suffix} files.",)
    try:
        with use_threads(threads):
            views = held_out(original, tell, max_memory)
            if isinstance(original, Splats):
                small = load(path)
                return views.judge(change_frame(small, turn[1], turn[0]) if turn else small), ()
            with open_model(path) as source:
                return views.judge(Turned(source, turn[1], turn[0]) if turn else source), ()
    except (ModelError, FormatError) as error:
        return None, (f"The result was not measured: {error}",)


def held_out(
    original: Splats | Source, tell: Parts = untold, max_memory: int | None = None
) -> HeldOut:
    """Render the original once, for any number of models.

    Args:
        original: The model; of a source some rows are read at a time, with the same result.
        tell: Told of the views rendered.
        max_memory: Bytes that this process may take, where a source is rendered; by default what is
            free.

    Raises:
        FormatError: The source cannot be read.
        ModelError: Nothing of it is visible.
        NotEnoughMemoryError: The source cannot be rendered in so little memory.
    """
    drawn = _drawable(original, max_memory)
    try:
        cameras = cameras_for(original, "auto", count=VIEWS, width=PIXELS, height=PIXELS)
        views, _ = reference_views(drawn, cameras, BLACK, tell, depth=False)
    except ModelError as error:
        raise ModelError(f"The PSNR cannot be measured: {error}") from None
    return HeldOut(views, Protocol(views=len(views)), max_memory)


def _drawable(model: Splats | Source, max_memory: int | None) -> PreparedSplats | Streamed:
    """A model as it is rendered: held where it is held already, else some rows at a time."""
    if isinstance(model, Splats):
        return drawable(model, None)
    pictures = pictures_bytes(PIXELS**2, VIEWS)
    remedy = "free some, or leave out what is measured"
    memory = allowed_memory(max_memory)
    return drawable(model, room_for_splats("Measuring", [model], pictures, memory, remedy))
