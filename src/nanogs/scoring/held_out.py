"""The held-out test views that results are scored on: those of `nanogs compare` at its defaults.

Methods never see them: visibility, selection and fitting use views of the other split (see
`views.automatic`). Scores from here are therefore the numbers that `compare` prints.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from nanogs.errors import ModelError
from nanogs.metrics import psnr
from nanogs.progress import PartProgress, ignore_progress
from nanogs.protocol import BLACK, PIXELS, UNMEASURED, Judged, PackingLoss, Protocol
from nanogs.raster.rendering import PreparedSplats
from nanogs.scoring.scores import (
    ModelScore,
    ReferenceView,
    mean_psnr,
    reference_views,
    score,
)
from nanogs.scoring.unpacked import UnpackedModel
from nanogs.source import Source
from nanogs.splats import Splats
from nanogs.views.cameras import cameras_for
from nanogs.views.plan import budget_for_measuring
from nanogs.views.streamed import Streamed, drawable, renderings

SELECTION_ROAMING = 16  # number of roaming views in `selection_views`


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """Renders of the original on a set of views, to score models against.

    Attributes:
        views: The views in which it is visible; 3 MB each.
        protocol: Their kind, number, size and split.
        max_memory: Bytes that this process may take if models are read some rows at a time; by
            default the free memory.
    """

    views: Sequence[ReferenceView]
    protocol: Protocol
    max_memory: int | None = None

    def psnr(self, small: Splats | Source) -> float:
        """Compute the PSNR of a model, dB, as `judge` does but in half the time.

        Raises:
            FormatError: The source cannot be read.
            NotEnoughMemoryError: There is not enough memory to render the source.
        """
        cameras = [view.camera for view in self.views]
        shown = renderings(as_drawn(small, self.max_memory), cameras, background=BLACK)
        pairs = zip(shown, self.views, strict=True)
        return mean_psnr([psnr(view.image, rendering.shown()) for rendering, view in pairs])

    def judge(self, small: Splats | Source) -> Judged:
        """Compute PSNR and SSIM of a model; raises the errors of `psnr`."""
        means = score("", as_drawn(small, self.max_memory), self.views, BLACK)
        return Judged(means.psnr, means.ssim, self.protocol)

    def judge_packed(
        self, model: Splats, packed: Splats, suffix: str
    ) -> tuple[Judged, PackingLoss | None]:
        """Score a packed file against the original and against the model that was written to it.

        Args:
            model: The model that was written.
            packed: The model read back from the file.
            suffix: Format of the file.

        Returns:
            The scores of the file, as from `judge`, and the loss due to packing alone.
        """
        beside = UnpackedModel(keep=True)

        def scored(small: Splats, form: str) -> ModelScore:
            beside.begin(form)
            drawn = as_drawn(small, self.max_memory)
            return beside.end(score("", drawn, self.views, BLACK, on_view=beside.see))

        scored(model, "")
        means = scored(packed, suffix)
        return Judged(means.psnr, means.ssim, self.protocol), means.packed


@dataclass(frozen=True, slots=True, eq=False)
class SelectionViews:
    """Renders of the original on several kinds of views, which are weighted equally.

    Attributes:
        kinds: The views of each kind; empty if nothing of the original is visible.
    """

    kinds: tuple[HeldOut, ...]

    def judge(self, small: Splats | Source) -> tuple[float, float]:
        """Compute PSNR, dB, and SSIM of a model; raises the errors of `HeldOut.psnr`."""
        scores = [kind.judge(small) for kind in self.kinds]
        ssims = [each.ssim for each in scores]
        return mean_psnr([each.psnr for each in scores]), sum(ssims) / len(ssims)


def held_out(
    original: Splats | Source,
    on_progress: PartProgress = ignore_progress,
    max_memory: int | None = None,
) -> HeldOut:
    """Render the original on the test views, once for any number of models.

    Args:
        original: The model; a source is read some rows at a time, with the same result.
        on_progress: Receives the progress in views rendered.
        max_memory: Bytes that this process may take to render a source; by default the free memory.

    Raises:
        FormatError: The source cannot be read.
        ModelError: Nothing of it is visible.
        NotEnoughMemoryError: There is not enough memory to render the source.
    """
    return _shown(original, Protocol(pixels=(PIXELS, PIXELS)), on_progress, max_memory)


def selection_views(
    original: Splats | Source, max_memory: int | None = None, *, automatic: bool = False
) -> SelectionViews:
    """Render the original on training views, by which methods select among candidate results.

    There are automatic and roaming views: candidates that are equal on automatic views often differ
    on roaming ones, which are near and far. Roaming views vary much, so there are many of them; a
    quarter of the pixels gives the same answer.

    Args:
        original: As for `held_out`, whose errors are raised here too.
        max_memory: Bytes that this process may take to render a source; by default the free memory.
        automatic: Use automatic views only, for instance when a PSNR on such views is requested.
            They must show something then.
    """
    usual = Protocol(pixels=(PIXELS, PIXELS), split="train")
    if automatic:
        return SelectionViews((_shown(original, usual, ignore_progress, max_memory),))
    pixels = PIXELS // 2
    kinds = []
    for protocol in (usual, Protocol(SELECTION_ROAMING, (pixels, pixels), "roam", "train")):
        with suppress(ModelError):  # such views show nothing
            kinds.append(_shown(original, protocol, ignore_progress, max_memory))
    return SelectionViews(tuple(kinds))


def _shown(
    original: Splats | Source, protocol: Protocol, on_progress: PartProgress, max_memory: int | None
) -> HeldOut:
    """Render the original on the views of a protocol; views that show nothing are left out."""
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
        views, _ = reference_views(drawn, cameras, BLACK, on_progress, depth=False)
    except ModelError as error:
        raise ModelError(f"{UNMEASURED}{error}") from None
    return HeldOut(views, replace(protocol, views=len(views)), max_memory)


def as_drawn(model: Splats | Source, max_memory: int | None) -> PreparedSplats | Streamed:
    """Prepare a model for rendering: `Splats` in memory, a source some rows at a time."""
    if isinstance(model, Splats):
        return drawable(model, None)
    return drawable(model, budget_for_measuring(model, max_memory))
