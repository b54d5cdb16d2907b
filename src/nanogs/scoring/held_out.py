"""The views that a result is judged by: those of `nanogs compare` at its defaults.

Nothing is learnt from them: what methods look at, choose by and fit to are views of the other
split (see `views.automatic`). So a number from here is the one that `compare` prints.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from nanogs.errors import ModelError
from nanogs.metrics import psnr
from nanogs.progress import Parts, untold
from nanogs.protocol import BLACK, PIXELS, UNMEASURED, Judged, PackingLoss, Protocol
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
from nanogs.views.cameras import cameras_for
from nanogs.views.plan import room_for_measuring
from nanogs.views.streamed import Streamed, drawable, renderings

ROAMING = 16  # views, where results are chosen by them as well


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


@dataclass(frozen=True, slots=True, eq=False)
class ToChooseBy:
    """The original on several kinds of views, each of which counts as much.

    Attributes:
        kinds: The views of each kind; none where nothing of the original is visible.
    """

    kinds: tuple[HeldOut, ...]

    def judge(self, small: Splats | Source) -> tuple[float, float]:
        """PSNR, dB, and SSIM of a model; it raises what `HeldOut.psnr` does."""
        marks = [kind.judge(small) for kind in self.kinds]
        ssims = [each.ssim for each in marks]
        return mean_psnr([each.psnr for each in marks]), sum(ssims) / len(ssims)


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
    return _shown(original, Protocol(pixels=(PIXELS, PIXELS)), tell, max_memory)


def to_choose_by(
    original: Splats | Source, max_memory: int | None = None, *, automatic: bool = False
) -> ToChooseBy:
    """Render other views of the original, automatic and roaming ones, for methods to choose by.

    Of two ways that automatic views find alike, roaming ones, near by and far away, often show one
    to be better. They differ much, hence so many; in a quarter of the pixels they tell the same.

    Args:
        original: As `held_out` takes it; it raises what that does.
        max_memory: Bytes that this process may take, where a source is rendered; by default what is
            free.
        automatic: Whether automatic views alone count, as where a PSNR of such ones is asked for.
            They must show something then.
    """
    usual = Protocol(pixels=(PIXELS, PIXELS), split="train")
    if automatic:
        return ToChooseBy((_shown(original, usual, untold, max_memory),))
    pixels = PIXELS // 2
    kinds = []
    for protocol in (usual, Protocol(ROAMING, (pixels, pixels), "roam", "train")):
        with suppress(ModelError):  # such views show nothing
            kinds.append(_shown(original, protocol, untold, max_memory))
    return ToChooseBy(tuple(kinds))


def _shown(
    original: Splats | Source, protocol: Protocol, tell: Parts, max_memory: int | None
) -> HeldOut:
    """The original on the views of a protocol, those in which it is seen."""
    drawn, (width, height) = as_drawn(original, max_memory), protocol.pixels
    try:
        cameras = cameras_for(
            original,
            protocol.kind,
            count=protocol.views,
            width=width,
            height=height,
            split="test" if protocol.split == "test" else "fit",
        )
        views, _ = reference_views(drawn, cameras, BLACK, tell, depth=False)
    except ModelError as error:
        raise ModelError(f"{UNMEASURED}{error}") from None
    return HeldOut(views, replace(protocol, views=len(views)), max_memory)


def as_drawn(model: Splats | Source, max_memory: int | None) -> PreparedSplats | Streamed:
    """A model as it is rendered: held where it is held already, else some rows at a time."""
    if isinstance(model, Splats):
        return drawable(model, None)
    return drawable(model, room_for_measuring(model, max_memory))
