"""The working set of a simplification: activated values, converted once at each edge."""

from dataclasses import dataclass

import numpy as np

from nanogs._types import F32, F64, I64, Bool, F
from nanogs.simplify.order import morton_order
from nanogs.splats import Splats


@dataclass(frozen=True, slots=True, eq=False)
class Gaussians:
    """N splats in the form in which they are compared and merged.

    Attributes:
        means: (N, 3) float64, scene units, relative to the origin that `activate` chose.
        scales: (N, 3) float32, standard deviations, scene units.
        quats: (N, 4) float32, wxyz, unit.
        opacities: (N,) float64, alpha in [0, 1].
        features: (N, C) float32, all spherical-harmonic coefficients.
        sources: (N,) int64, row in the input of the splat itself or of its dominant member.
        merged: (N,) bool, False for a splat of the input as it was.
    """

    means: F64
    scales: F32
    quats: F32
    opacities: F64
    features: F32
    sources: I64
    merged: Bool

    def __len__(self) -> int:
        return len(self.means)

    def take(self, rows: I64 | Bool) -> "Gaussians":
        """The given rows, by index or mask."""
        return Gaussians(
            self.means[rows],
            self.scales[rows],
            self.quats[rows],
            self.opacities[rows],
            self.features[rows],
            self.sources[rows],
            self.merged[rows],
        )


def scene_origin(means: F) -> F64:
    """(3,) float64: the middle of the centres' bounding box, scene units.

    Differences of centres far from zero keep their digits when this is taken off first.
    """
    low = means.min(axis=0).astype(np.float64)
    high = means.max(axis=0).astype(np.float64)
    origin: F64 = low + (high - low) / 2
    return origin


def activate(splats: Splats, rows: I64, origin: F64) -> Gaussians:
    """Activated values of the given rows, in Morton order of their centres.

    Args:
        splats: The input.
        rows: (M,) rows of it, all finite.
        origin: (3,) taken off the centres, scene units.
    """
    means = splats.means[rows] - origin
    order = morton_order(means)
    rows = rows[order]
    chosen = splats.take(rows)
    return Gaussians(
        means=means[order],
        scales=chosen.scales(),
        quats=chosen.unit_quats(),
        opacities=chosen.opacities(),
        features=chosen.sh.reshape(len(rows), -1),
        sources=rows,
        merged=np.zeros(len(rows), dtype=bool),
    )


def store(gaussians: Gaussians, splats: Splats, origin: F64) -> Splats:
    """Stored values of a working set, in the order of the input's rows.

    A splat that was not merged gets the input's bytes back. A merged one takes its extra columns
    from its dominant member, since they have no meaning that could be averaged.

    Args:
        gaussians: The working set.
        splats: The input it came from.
        origin: (3,) what `activate` took off the centres, scene units.
    """
    gaussians = gaussians.take(np.argsort(gaussians.sources))
    stored = splats.take(gaussians.sources)
    new = gaussians.merged
    fresh = gaussians.take(new)
    stored.means[new] = fresh.means + origin
    stored.quats[new] = fresh.quats
    stored.sh[new] = fresh.features.reshape(len(fresh), *stored.sh.shape[1:])
    with np.errstate(divide="ignore"):  # a scale of 0 is stored as -inf, alpha 0 and 1 as ±inf
        stored.log_scales[new] = np.log(fresh.scales)
        stored.opacity_logits[new] = np.log(fresh.opacities) - np.log1p(-fresh.opacities)
    return stored
