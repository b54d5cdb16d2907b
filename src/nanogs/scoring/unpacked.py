"""Scoring packed files of a model against the same model unpacked, without rendering it again."""

from dataclasses import dataclass, field, replace

import numpy as np

from nanogs._types import F32
from nanogs.metrics import psnr, ssim
from nanogs.protocol import PackingLoss
from nanogs.raster.rendering import Rendering
from nanogs.scoring.scores import ModelScore, ReferenceView, ViewScore, mean_psnr


@dataclass(slots=True)
class UnpackedModel:
    """The score and renders of the latest unpacked model; its packed files are scored after it.

    Attributes:
        keep: Whether packed files will follow; otherwise renders are not kept.
    """

    keep: bool
    _suffix: str = ""
    _score: ModelScore | None = None
    _images: list[F32] = field(default_factory=list)
    _view_scores: list[tuple[float, float]] = field(default_factory=list)

    def begin(self, suffix: str) -> None:
        """Begin a model; `suffix` is the format of a packed file, or "" for an unpacked model."""
        self._suffix = suffix
        self._view_scores.clear()
        if not suffix:
            self._images.clear()

    def see(self, _view: ReferenceView, rendering: Rendering, _score: ViewScore) -> None:
        """Receive the model's next view, as `on_view` of `score`; each model has the same order."""
        if self._suffix:
            beside, image = self._images[len(self._view_scores)], rendering.shown()
            self._view_scores.append((psnr(beside, image), ssim(beside, image)))
        elif self.keep:
            self._images.append(rendering.shown())

    def end(self, score: ModelScore) -> ModelScore:
        """End a model and return its score, for a packed file with the loss due to packing."""
        if not self._suffix:
            self._score = score
        if not self._suffix or self._score is None:
            return score
        whole, (psnrs, ssims) = self._score, zip(*self._view_scores, strict=True)
        same = whole.psnr == score.psnr  # avoids inf - inf
        loss = PackingLoss(
            format=self._suffix,
            of=whole.name,
            psnr_cost=0.0 if same else whole.psnr - score.psnr,
            ssim_cost=whole.ssim - score.ssim,
            psnr=mean_psnr(psnrs),
            ssim=float(np.mean(ssims)),
        )
        return replace(score, packed=loss)
