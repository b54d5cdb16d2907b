"""The views that a result is judged by: those of `nanogs compare` at its defaults.

Nothing is learnt from them: what methods look at, choose by and fit to are views of the other
split (see `views.automatic`). So a number from here is the one that `compare` prints.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from nanogs.errors import ModelError
from nanogs.io import load
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
    back: Callable[[Splats], Splats] | None = None,
    threads: int | None = None,
    tell: Parts = untold,
) -> Judged:
    """Hold a file against the original that it was made of.

    Args:
        original: The model.
        path: The file.
        back: Turns the file's model into the original's frame, where it is in another.
        threads: Threads to use; all by default.
        tell: Told of the original's views rendered.

    Raises:
        FormatError: nanogs does not read the file.
        ModelError: Nothing of the original is visible.
    """
    with use_threads(threads):
        small = load(path)
        return held_out(original, tell).judge(back(small) if back else small)


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
