"""Views of a streamed SOG as viewers draw it, far chunks coarser, compared with its original.

A *seam* is where chunks of different levels meet in an image. Coarse splats extend into the fine
chunk there, and fine splats extend less far out of it than the splats they were merged into: light
can be counted twice, or be missing. Seams are therefore measured separately, against an image of
the coarser of the two levels alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nanogs._types import F32, F64, I64, Bool
from nanogs.io import open as open_model
from nanogs.io.sog.chunks import Chunks, read_chunks
from nanogs.metrics import psnr, ssim
from nanogs.protocol import Background
from nanogs.raster.camera import Camera
from nanogs.raster.checks import background_of
from nanogs.raster.rendering import PreparedSplats, blend, clipped, prepare, project
from nanogs.scoring.scores import ReferenceView
from nanogs.splats import concatenate
from nanogs.views.chunk_levels import NOTHING, chosen_levels, chunk_distances

SEAM = 0.1  # least weight that each of two levels has in a pixel at a seam
_CHANNELS = 3  # channels of one rendering, each of which measures the weight of one level


@dataclass(frozen=True, slots=True)
class MixedView:
    """The scores of a view as a viewer draws it, compared with the original.

    Attributes:
        view: Name of the camera.
        chunks: Number of chunks drawn at each level, the finest first.
        splats: Number of splats in the levels drawn, whether or not they are in the image.
        psnr: PSNR of the image, dB; infinite if it equals the original's.
        ssim: SSIM of the image.
        coarse: The coarsest level that is drawn; None if none is.
        coarse_psnr: PSNR of the whole of that level, drawn alone, dB.
        coarse_ssim: SSIM of the same.
        seams: Share of the pixels that are at seams, in [0, 1].
        seam_error: Squared error, mean over channels, summed over the pixels at seams; colours are
            in [0, 1].
        seam_coarse_error: The same for the coarser of the levels that meet, drawn alone.
        seam_loss: Ratio of `seam_error` to `seam_coarse_error`, dB; None without seams.
    """

    view: str
    chunks: tuple[int, ...]
    splats: int
    psnr: float
    ssim: float
    coarse: int | None
    coarse_psnr: float
    coarse_ssim: float
    seams: float
    seam_error: float
    seam_coarse_error: float
    seam_loss: float | None = None


def loss_of(error: float, other: float) -> float:
    """Return the ratio of a squared error to another, dB; below 0 if the first is smaller."""
    if error == other:
        return 0.0
    with np.errstate(divide="ignore"):
        return float(10 * (np.log10(error) - np.log10(other)))


@dataclass(frozen=True, slots=True, eq=False)
class StreamLevels:
    """All levels of a streamed SOG in one array, so that any mixture of levels can be drawn.

    Attributes:
        chunks: The rows of each chunk at each level.
        prepared: M splats: the levels without the environment, the finest first; the environment.
        levels: (M,) int64, the level of each splat; `NOTHING` for the environment.
        ends: (L + 1,) int64, the first row of each level, and the end of the last one.
    """

    chunks: Chunks
    prepared: PreparedSplats
    levels: I64
    ends: I64

    def drawn(self, choice: I64) -> Bool:
        """Return (M,) bool: the rows of a mixture, with the environment.

        Args:
            choice: (C,) the level of each chunk, or `NOTHING`.
        """
        rows: Bool = self.levels == NOTHING
        for chunk, level in enumerate(choice.tolist()):
            if level != NOTHING:
                first = self.ends[level] + self.chunks.starts[chunk, level]
                rows[first : first + self.chunks.counts[chunk, level]] = True
        return rows

    def alone(self, level: int) -> Bool:
        """Return (M,) bool: the rows of a level and of the environment."""
        found: Bool = (self.levels == level) | (self.levels == NOTHING)
        return found

    def score(self, view: ReferenceView, background: Background, budget: int | None) -> MixedView:
        """Draw a view like a viewer does, and score it against the original.

        Args:
            view: The view of the original.
            background: RGB in [0, 1].
            budget: As for `chosen_levels`.
        """
        camera, chunks = view.camera, self.chunks
        choice = chosen_levels(chunk_distances(chunks.boxes, camera), chunks.counts, budget)
        levels = chunks.counts.shape[1]
        rows, counts = self.drawn(choice), np.bincount(choice[choice != NOTHING], minlength=levels)
        shown = np.flatnonzero(counts).tolist()
        image, shares = self._picture(rows, camera, background, shown)
        quality, similar = psnr(view.image, image), ssim(view.image, image)
        own = MixedView(
            view=camera.name,
            chunks=tuple(counts.tolist()),
            splats=int(np.count_nonzero(rows)),
            psnr=quality,
            ssim=similar,
            coarse=None,
            coarse_psnr=quality,
            coarse_ssim=similar,
            seams=0.0,
            seam_error=0.0,
            seam_coarse_error=0.0,
        )
        if not shown:
            return own
        alone = {level: self._alone(level, camera, background) for level in shown[1:]}
        coarsest = alone.get(shown[-1])
        if coarsest is None:
            coarsest = self._alone(shown[-1], camera, background)
        seams, errors = _at_seams(view.image, image, shares, [alone[each] for each in shown[1:]])
        return replace(
            own, coarse=shown[-1], coarse_psnr=psnr(view.image, coarsest),
            coarse_ssim=ssim(view.image, coarsest), seams=seams, seam_error=errors[0],
            seam_coarse_error=errors[1], seam_loss=loss_of(*errors) if seams else None,
        )  # fmt: skip

    def _alone(self, level: int, camera: Camera, background: Background) -> F32:
        return self._picture(self.alone(level), camera, background, ())[0]

    def _picture(
        self, rows: Bool, camera: Camera, background: Background, levels: Sequence[int]
    ) -> tuple[F32, F32]:
        """Render some rows: the image (H, W, 3), and each level's weight (H, W, len(levels))."""
        some = replace(self.prepared, keep=self.prepared.keep & rows)
        view = project(some, camera)
        behind = background_of(background, depth=False)
        image, _, _ = blend(view, camera, view.features, behind)
        parts = [np.zeros((camera.height, camera.width, 0), np.float32)]
        for first in range(0, len(levels), _CHANNELS):
            lights = np.zeros((len(rows), _CHANNELS), np.float32)
            for channel, level in enumerate(levels[first : first + _CHANNELS]):
                lights[self.levels == level, channel] = 1
            parts.append(blend(view, camera, lights, np.zeros(_CHANNELS, np.float32))[0])
        shares: F32 = np.concatenate(parts, axis=2)[:, :, : len(levels)]
        return clipped(image[..., :3]), shares


def _at_seams(
    original: F32, image: F32, shares: F32, alone: Sequence[F32]
) -> tuple[float, tuple[float, float]]:
    """Return the share of pixels at seams, and the squared errors there.

    Args:
        original: (H, W, 3), the image of the original.
        image: (H, W, 3), the image of the mixture.
        shares: (H, W, K), the weight of each of the K levels that are drawn, the finest first.
        alone: Images (H, W, 3) of each of these levels alone, without the finest.

    Returns:
        The share, and the sums of squares of the mixture and of the coarser level alone.
    """
    meet = shares >= SEAM
    seams = meet.sum(axis=2) > 1
    if not seams.any():
        return 0.0, (0.0, 0.0)
    coarser = meet.shape[2] - 1 - meet[:, :, ::-1].argmax(axis=2)  # index of the last True
    error = _squares(original, image)[seams].sum()
    others = np.stack([_squares(original, each) for each in alone])  # (K - 1, H, W)
    rows, columns = np.nonzero(seams)
    other = others[coarser[seams] - 1, rows, columns].sum()
    return float(seams.mean()), (float(error), float(other))


def _squares(a: F32, b: F32) -> F64:
    found: F64 = np.square(a.astype(np.float64) - b).mean(axis=2)
    return found


def read_levels(path: Path) -> StreamLevels:
    """Read all levels of a streamed SOG.

    Raises:
        FormatError: A file is missing or damaged.
    """
    chunks = read_chunks(path)
    parts, numbers, ends = [], [], [0]
    for level in range(chunks.counts.shape[1]):
        with open_model(path, level=level) as source:
            own = source.count - chunks.environment
            parts.append(source.read(0, own))
            if level == 0:
                apart = source.read(own, source.count)
        numbers.append(np.full(own, level, np.int64))
        ends.append(ends[-1] + own)
    numbers.append(np.full(len(apart), NOTHING, np.int64))
    together = prepare(concatenate([*parts, apart]))
    return StreamLevels(chunks, together, np.concatenate(numbers), np.array(ends))
