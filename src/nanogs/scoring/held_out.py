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
from nanogs.metrics import psnr
from nanogs.progress import Parts, untold
from nanogs.protocol import BLACK, PIXELS, VIEWS, Judged, Protocol
from nanogs.raster.rendering import prepare, render
from nanogs.scoring.scores import ReferenceView, mean_psnr, reference_views, score
from nanogs.splats import Splats
from nanogs.threads import use_threads
from nanogs.views.cameras import cameras_for


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """The original as views show it that nothing is learnt from.

    Attributes:
        views: Those in which it is seen; 3 MB each.
        protocol: What they are.
    """

    views: Sequence[ReferenceView]
    protocol: Protocol

    def psnr(self, small: Splats) -> float:
        """The PSNR that `judge` gives, alone and in half the time, dB."""
        prepared = prepare(small)
        shown = (render(prepared, view.camera, background=BLACK) for view in self.views)
        pairs = zip(self.views, shown, strict=True)
        return mean_psnr([psnr(view.image, rendering.shown()) for view, rendering in pairs])

    def judge(self, small: Splats) -> Judged:
        """Hold a model against the original."""
        means = score("", prepare(small), self.views, BLACK)
        return Judged(means.psnr, means.ssim, self.protocol)


def judge_file(
    original: Splats,
    path: Path,
    *,
    turn: tuple[str, str] | None = None,
    threads: int | None = None,
    tell: Parts = untold,
) -> tuple[Judged | None, tuple[str, ...]]:
    """Hold a file against the original that it was made of.

    Args:
        original: The model.
        path: The file.
        turn: Frames from and to which the file's model was turned, or None.
        threads: Threads to use; all by default.
        tell: Told of the original's views rendered.

    Returns:
        What was measured and no note; or None and why nothing could be, in a sentence.
    """
    known = registry.find(path)
    if known is not None and not known.readable:
        return None, (f"The result was not measured: nanogs does not read {known.suffix} files.",)
    try:
        with use_threads(threads):
            small = load(path)
            back = change_frame(small, turn[1], turn[0]) if turn else small
            return held_out(original, tell).judge(back), ()
    except (ModelError, FormatError) as error:
        return None, (f"The result was not measured: {error}",)


def held_out(original: Splats, tell: Parts = untold) -> HeldOut:
    """Render the original once, for any number of models; told of the views rendered.

    Raises:
        ModelError: Nothing of it is visible.
    """
    try:
        cameras = cameras_for(original, "auto", count=VIEWS, width=PIXELS, height=PIXELS)
        views, _ = reference_views(prepare(original), cameras, BLACK, tell, depth=False)
    except ModelError as error:
        raise ModelError(f"The PSNR cannot be measured: {error}") from None
    return HeldOut(views, Protocol(views=len(views)))
