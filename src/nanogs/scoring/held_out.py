"""The views that a result is judged by: those of `nanogs compare` at its defaults.

Nothing is learnt from them: what methods look at, choose by and fit to are views of the other
split (see `views.automatic`). So a number from here is the one that `compare` prints.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from nanogs.errors import ModelError
from nanogs.metrics import psnr
from nanogs.progress import Parts, untold
from nanogs.protocol import BLACK, PIXELS, VIEWS, Judged, Kind, PackingLoss, Protocol
from nanogs.raster.rendering import PreparedSplats
from nanogs.scoring.scores import (
    ModelScore,
    ReferenceView,
    mean_psnr,
    reference_views,
    score,
)
from nanogs.scoring.unpacked import Unpacked
from nanogs.source import Source
from nanogs.splats import Splats
from nanogs.views.automatic import Split
from nanogs.views.cameras import cameras_for
from nanogs.views.plan import room_for_measuring
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
        shown = renderings(as_drawn(small, self.max_memory), cameras, background=BLACK)
        pairs = zip(shown, self.views, strict=True)
        return mean_psnr([psnr(view.image, rendering.shown()) for rendering, view in pairs])

    def judge(self, small: Splats | Source) -> Judged:
        """Hold a model against the original; it raises what `psnr` does."""
        means = score("", as_drawn(small, self.max_memory), self.views, BLACK)
        return Judged(means.psnr, means.ssim, self.protocol)

    def judge_packed(
        self, model: Splats, packed: Splats, suffix: str
    ) -> tuple[Judged, PackingLoss | None]:
        """Hold a model as read back from a file against the original, and against itself.

        Args:
            model: The model.
            packed: The same as read back.
            suffix: Format of the file.

        Returns:
            The marks of the file, as `judge` gives them, and what packing alone cost.
        """
        beside = Unpacked(keep=True)

        def marks(small: Splats, form: str) -> ModelScore:
            beside.begin(form)
            drawn = as_drawn(small, self.max_memory)
            return beside.end(score("", drawn, self.views, BLACK, on_view=beside.see_view))

        marks(model, "")
        means = marks(packed, suffix)
        return Judged(means.psnr, means.ssim, self.protocol), means.packed


def held_out(
    original: Splats | Source,
    tell: Parts = untold,
    max_memory: int | None = None,
    split: Split = "test",
) -> HeldOut:
    """Render the original once, for any number of models.

    Args:
        original: The model; of a source some rows are read at a time, with the same result.
        tell: Told of the views rendered.
        max_memory: Bytes that this process may take, where a source is rendered; by default what is
            free.
        split: Of the views; "fit" for such as methods learn from, to choose by.

    Raises:
        FormatError: The source cannot be read.
        ModelError: Nothing of it is visible.
        NotEnoughMemoryError: The source cannot be rendered in so little memory.
    """
    return _shown(original, ("auto",), split, tell, max_memory)


def to_choose_by(original: Splats | Source, max_memory: int | None = None) -> HeldOut:
    """Render other views of the original, half of them roaming, for methods to choose by.

    Of two ways that automatic views find alike, roaming ones, near by and far away, often show one
    to be better.

    Args:
        original: As `held_out` takes it, and so is the other; it raises what that does.
        max_memory: See there.
    """
    return _shown(original, ("auto", "roam"), "fit", untold, max_memory)


def _shown(
    original: Splats | Source,
    kinds: Sequence[Kind],
    split: Split,
    tell: Parts,
    max_memory: int | None,
) -> HeldOut:
    """The original on as many views of each kind."""
    drawn, count = as_drawn(original, max_memory), VIEWS // len(kinds)
    try:
        cameras = [
            camera
            for kind in kinds
            for camera in cameras_for(
                original, kind, count=count, width=PIXELS, height=PIXELS, split=split
            )
        ]
        views, _ = reference_views(drawn, cameras, BLACK, tell, depth=False)
    except ModelError as error:
        raise ModelError(f"The PSNR cannot be measured: {error}") from None
    protocol = Protocol(views=len(views), split="test" if split == "test" else "train")
    return HeldOut(views, protocol, max_memory)


def as_drawn(model: Splats | Source, max_memory: int | None) -> PreparedSplats | Streamed:
    """A model as it is rendered: held where it is held already, else some rows at a time."""
    if isinstance(model, Splats):
        return drawable(model, None)
    return drawable(model, room_for_measuring(model, max_memory))
