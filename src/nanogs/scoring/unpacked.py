"""Files of a model held against the same model unpacked, on views that show it once."""

from dataclasses import dataclass, field, replace

import numpy as np

from nanogs._types import F32
from nanogs.metrics import psnr, ssim
from nanogs.protocol import PackingLoss
from nanogs.raster.rendering import Rendering
from nanogs.scoring.scores import ModelScore, ReferenceView, ViewScore, mean_psnr


@dataclass(slots=True)
class Unpacked:
    """The latest model that is no packed file, as views show it; files of it are scored after it.

    Attributes:
        keep: Whether any file comes, or else nothing is kept.
    """

    keep: bool
    _suffix: str = ""
    _score: ModelScore | None = None
    _images: list[F32] = field(default_factory=list)
    _marks: list[tuple[float, float]] = field(default_factory=list)

    def begin(self, suffix: str) -> None:
        """Begin with a model; of a file, the suffix says its format."""
        self._suffix = suffix
        self._marks.clear()
        if not suffix:
            self._images.clear()

    def see(self, rendering: Rendering) -> None:
        """Take the model's next view; views come in the same order for every model."""
        if self._suffix:
            beside, image = self._images[len(self._marks)], rendering.shown()
            self._marks.append((psnr(beside, image), ssim(beside, image)))
        elif self.keep:
            self._images.append(rendering.shown())

    def see_view(self, _view: ReferenceView, rendering: Rendering, _score: ViewScore) -> None:
        """Take the next view as `score` tells of it."""
        self.see(rendering)

    def end(self, score: ModelScore) -> ModelScore:
        """Take the model's score; that of a file is given back with what packing cost."""
        if not self._suffix:
            self._score = score
        if not self._suffix or self._score is None:
            return score
        whole, (psnrs, ssims) = self._score, zip(*self._marks, strict=True)
        same = whole.psnr == score.psnr  # infinite ones too
        loss = PackingLoss(
            format=self._suffix,
            of=whole.name,
            psnr_cost=0.0 if same else whole.psnr - score.psnr,
            ssim_cost=whole.ssim - score.ssim,
            psnr=mean_psnr(psnrs),
            ssim=float(np.mean(ssims)),
        )
        return replace(score, packed=loss)
