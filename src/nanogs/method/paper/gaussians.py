"""The working set of the published method: activated splats, converted once in and once out."""

from dataclasses import dataclass, field

import numpy as np

from nanogs._types import F32, F64, I32, I64, Bool
from nanogs.activations import LEAST_ALPHA, LEAST_SCALE, alphas
from nanogs.kernels.lazy_features import mean_features
from nanogs.method.activation import activated
from nanogs.method.order import morton_order
from nanogs.slices import slices
from nanogs.splats import Splats, pick

MOST_ALPHA = 1 - float(np.finfo(np.float64).epsneg)


@dataclass(frozen=True, slots=True, eq=False)
class Gaussians:
    """N activated splats, in the form in which they are compared and merged.

    Attributes:
        means: (N, 3) float64, scene units, relative to the origin that `activate` chose.
        scales: (N, 3) float32, standard deviations, scene units.
        quats: (N, 4) float32, wxyz, unit.
        opacities: (N,) float64, alpha in [0, 1].
        features: (F, C) float32, all spherical-harmonic coefficients; those of splats are the
            input's own, in its order, and are not copied.
        rows: (N,) int32, row of the features for each splat.
        sources: (N,) int32, row in the input of the splat itself or of its dominant member.
        merged: (N,) bool, False for an unchanged splat of the input.
        second_rows: (N,) int32, a second row of the features for each splat, whose features are
            then the weighted mean of both; empty, (0,), if each splat has one row.
        shares: (N, 2) float64, the weights of that mean, or (0, 2).
    """

    means: F64
    scales: F32
    quats: F32
    opacities: F64
    features: F32
    rows: I32
    sources: I32
    merged: Bool
    second_rows: I32 = field(default_factory=lambda: np.empty(0, np.int32))
    shares: F64 = field(default_factory=lambda: np.empty((0, 2)))

    def __len__(self) -> int:
        return len(self.means)

    def take(self, rows: I64 | I32 | Bool) -> "Gaussians":
        """Return some rows, given by indices or a mask."""
        return Gaussians(
            pick(self.means, rows),
            pick(self.scales, rows),
            pick(self.quats, rows),
            pick(self.opacities, rows),
            self.features,
            pick(self.rows, rows),
            pick(self.sources, rows),
            pick(self.merged, rows),
            pick(self.second_rows, rows) if len(self.second_rows) else self.second_rows,
            pick(self.shares, rows) if len(self.shares) else self.shares,
        )

    def colours(self) -> F32:
        """Return the (N, C) float32 features of all splats."""
        every, alone = np.arange(len(self), dtype=np.int32), np.array((1.0, 0.0))
        return self.mean_features(every, every, np.broadcast_to(alone, (len(self), 2)).copy())

    def mean_features(self, firsts: I32, others: I32, weights: F64) -> F32:
        """Return the (M, C) float32 weighted means of the features of M pairs of splats.

        Args:
            firsts: (M,) the first splat of each pair.
            others: (M,) the second one, which may be the same.
            weights: (M, 2) weights of both, which sum to 1.
        """
        means = np.empty((len(firsts), self.features.shape[1]), np.float32)
        mean_features(
            self.features, self.rows, self.second_rows, self.shares, firsts, others, weights, means
        )
        return means


def activate(splats: Splats, rows: I64 | I32, origin: F64) -> Gaussians:
    """Activate some rows of a model, in Morton order of their centres.

    Args:
        splats: The input.
        rows: (M,) rows of it, all finite.
        origin: (3,) subtracted from the centres, scene units.
    """
    rows = rows[morton_order(pick(splats.means, rows) - origin)].astype(np.int32)
    means, scales, quats = activated(splats, rows, origin)
    return Gaussians(
        means=means,
        scales=scales,
        quats=quats,
        opacities=alphas(pick(splats.opacity_logits, rows)),
        features=np.ascontiguousarray(splats.sh).reshape(len(splats), -1),
        rows=rows,
        sources=rows,
        merged=np.zeros(len(rows), dtype=bool),
    )


def store(gaussians: Gaussians, splats: Splats, origin: F64) -> Splats:
    """Convert a working set back to stored values, in the order of the input's rows.

    A splat that was not merged keeps the bytes of the input. A merged one takes its extra columns
    from its dominant member, because their meaning is unknown and they cannot be averaged.

    Args:
        gaussians: The working set.
        splats: The input it came from.
        origin: (3,) the origin that `activate` subtracted from the centres, scene units.
    """
    order = np.argsort(gaussians.sources)
    stored = splats.take(gaussians.sources[order])
    new = np.flatnonzero(gaussians.merged[order])
    for part in slices(len(new)):
        at = new[part]
        fresh = gaussians.take(order[at])
        stored.means[at] = fresh.means + origin
        stored.quats[at] = fresh.quats
        stored.sh[at] = fresh.colours().reshape(len(fresh), *stored.sh.shape[1:])
        stored.log_scales[at] = np.log(np.maximum(fresh.scales, np.float32(LEAST_SCALE)))
        opacities = np.clip(fresh.opacities, LEAST_ALPHA, MOST_ALPHA)
        stored.opacity_logits[at] = np.log(opacities) - np.log1p(-opacities)
    return stored
