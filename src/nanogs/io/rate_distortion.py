"""Rounding by rate and distortion: values that hardly show take codes that pack well.

A packed file is the smaller, the more often the same codes occur. Many values could be rounded more
coarsely than a format does, such as the length of a flat splat's thin axis or the rotation of a
round splat. How much a value shows is its curvature, which the fit measures (`nanogs.fit.descent`).

Source: Sullivan and Wiegand, "Rate-distortion optimization for video compression", 1998: of all
codes, the one of least D + lambda R is chosen, the error plus the price of the code's bits.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from nanogs import parallel
from nanogs._types import F32, F64, I32
from nanogs.activations import LEAST_SCALE, SH_C0, rotations
from nanogs.io.rotations import minimise_rotation, rotations_between, with_w
from nanogs.slices import slices
from nanogs.splats import Splats

# Largest changes, since a curvature tells nothing of a picture far away: of log-scales, logits of
# opacities, coefficients of base colours, and of rotations in radians.
MOST_STRETCH, MOST_LOGIT, MOST_COLOUR, MOST_TURN = 0.3, 0.5, 0.1 / SH_C0, 0.3
FARTHEST_LOGIT = 6.9  # in place of -inf and inf: formats of up to 8 bits round it to opacity 0 or 1
# A Gaussian shifted by this many standard deviations hardly overlaps with itself any more, so the
# error grows no further.
FARTHEST_SHIFT = 2.0
ROUNDS = 3  # of choosing codes, each by how often every code occurs after the round before


@dataclass(frozen=True, slots=True, eq=False)
class Curvatures:
    """How fast the squared error of views grows with the square of a change of N splats.

    Attributes:
        centres: (N, 3) float32, along a splat's own axes, per standard deviation.
        log_scales: (N, 3) float32.
        rotations: (N, 3) float32, about a splat's own axes, per radian.
        logits: (N,) float32, of opacities.
        colours: (N,) float32, SH coefficient of degree 0 of each channel.
    """

    centres: F32
    log_scales: F32
    rotations: F32
    logits: F32
    colours: F32


class Quantisation(NamedTuple):
    """The values that a format can hold.

    Attributes:
        centres: Those of the model, (N, 3) float32, rounded as usual, and to every second code.
        log_scales: (L,) float32, ascending, as the following.
        logits: (L,) float32, of opacities; -inf and inf stand for `FARTHEST_LOGIT`.
        colours: (L,) float32, SH coefficients of degree 0.
        rotations: (L,) float64, x, y and z of quaternions whose w is the largest component; None
            if rotations are held in another form.
    """

    centres: tuple[F32, F32]
    log_scales: F32
    logits: F32
    colours: F32
    rotations: F64 | None = None


def rounded(
    splats: Splats, curvatures: Curvatures, quantisation: Quantisation, coarseness: float = 1.0
) -> Splats:
    """Round a model's values to those of a format, so chosen that its file is small.

    Centres stay as they are, or get every second code. The axes of a splat may have another order.
    Values that are not finite are kept.

    Args:
        splats: N splats.
        curvatures: How much their values show.
        quantisation: Values of the format.
        coarseness: Factor of the price of a bit; more gives smaller files and larger errors.
    """
    turned = None
    log_scales, scale_curvatures = splats.log_scales, curvatures.log_scales
    if quantisation.rotations is not None:  # they reorder the axes of splats, scales included
        turned = _Rotations.of(splats, curvatures, quantisation.rotations)
        log_scales, scale_curvatures = turned.log_scales, turned.scale_curvatures
    ends = np.clip(quantisation.logits, -FARTHEST_LOGIT, FARTHEST_LOGIT)
    colours = np.repeat(curvatures.colours[:, None], splats.sh.shape[2], axis=1)
    logits = splats.opacity_logits[:, None]
    kinds = (
        _Values(log_scales, scale_curvatures, quantisation.log_scales, MOST_STRETCH),
        _Values(logits, curvatures.logits[:, None], ends, MOST_LOGIT),
        _Values(splats.sh[:, 0], colours, quantisation.colours, MOST_COLOUR),
    )
    error = sum(each.error() for each in kinds) + (turned.error() if turned else 0.0)
    number = sum(each.values.size for each in kinds) + (turned.curvatures.size if turned else 0)
    # A bit more for each value would leave a quarter of the error of rounding to the nearest, so a
    # bit lowers it by 2 ln 2 times itself (Gray and Neuhoff, "Quantization", 1998, section II).
    price = coarseness * 2 * math.log(2) * error / max(number, 1)
    means = _centres(splats, curvatures.centres, quantisation.centres, price)
    scales, opacities, base = (each.cheapest(price) for each in kinds)
    sh = splats.sh.copy()
    sh[:, 0] = base
    quats = turned.cheapest(price) if turned else splats.quats
    return replace(
        splats, means=means, log_scales=scales, opacity_logits=opacities[:, 0], sh=sh, quats=quats
    )


def _centres(splats: Splats, curvatures: F32, centres: tuple[F32, F32], price: float) -> F32:
    """Return the centres, rounded to every second code if the bit that this saves is worth it.

    The step is the same for all splats: one for each saves hardly more, because neither gzip nor
    WebP can tell which splats have which. A step four times as long would suit finer values than
    those for which the bits of the file were chosen.

    Args:
        splats: N splats.
        curvatures: (N, 3) of the centres.
        centres: See `Quantisation.centres`.
        price: Of a bit.
    """
    usual, coarser = centres

    def added_error(rows: slice) -> float:
        some = splats.span(rows.start, rows.stop)
        axes = rotations(some.unit_quats().astype(np.float64))
        deviations = np.maximum(some.scales().astype(np.float64), LEAST_SCALE)

        def errors(rounded: F32) -> F64:
            shifts = np.einsum("nij,ni->nj", axes, rounded[rows] - some.means.astype(np.float64))
            limited: F64 = np.minimum((shifts / deviations) ** 2, FARTHEST_SHIFT**2)
            return limited

        return float((curvatures[rows] * (errors(coarser) - errors(usual))).sum())

    added = sum(parallel.map_ordered(slices(len(splats)), added_error))
    # If a centre is not finite, all stay as they are, and the writer refuses the model.
    return coarser if added < price * usual.size else splats.means


class _Values(NamedTuple):
    """Values of one kind.

    Attributes:
        values: (N, C) float32.
        curvatures: (N, C) float32.
        levels: (L,) float32, the values that they can be rounded to, ascending.
        most: Largest change.
    """

    values: F32
    curvatures: F32
    levels: F32
    most: float

    def error(self) -> float:
        """Return the error of rounding to the nearest level.

        That of values beyond the first or last level is left out: no further bit would lower it.
        """
        nearest = self.levels[_nearest(self.values, self.levels)].astype(np.float64)
        within = (self.values >= self.levels[0]) & (self.values <= self.levels[-1])
        changes = np.where(within, nearest, 0) - np.where(within, self.values, 0)
        return float((self.curvatures * changes**2).sum())

    def cheapest(self, price: float) -> F32:
        """Return the levels of least cost, (N, C), at a price of a bit."""
        from nanogs.kernels.rate_distortion import cheapest_levels

        out, levels = self.values.copy(), self.levels.astype(np.float64)
        for column in range(out.shape[1]):
            values = np.ascontiguousarray(self.values[:, column], np.float64)
            curvatures = np.ascontiguousarray(self.curvatures[:, column])
            nearest = _nearest(values, self.levels)
            codes = nearest
            for _ in range(ROUNDS):
                lengths, codes = _lengths(codes, len(levels)), nearest.copy()
                cheapest_levels(values, curvatures, levels, lengths, price, self.most, codes)
            finite = np.isfinite(values)
            out[finite, column] = self.levels[codes[finite]]
        return out


class _Rotations(NamedTuple):
    """Rotations whose w is the largest component, and what follows the order of their axes.

    Attributes:
        quats: (N, 4) float64, wxyz, unit.
        curvatures: (N, 3) float32, of the rotations.
        levels: (L,) float64, the values that x, y and z can have.
        log_scales: (N, 3) float32.
        scale_curvatures: (N, 3) float32, of the log-scales.
    """

    quats: F64
    curvatures: F32
    levels: F64
    log_scales: F32
    scale_curvatures: F32

    @classmethod
    def of(cls, splats: Splats, curvatures: Curvatures, levels: F64) -> "_Rotations":
        """Reorder the axes of splats so that rotations are small, and curvatures with them."""
        # The numbers of the axes in place of their scales, which do not decide the order.
        axes = np.tile(np.arange(3, dtype=np.float32), (len(splats), 1))
        quats, reordered = minimise_rotation(replace(splats, log_scales=axes))
        order = reordered.astype(np.int64)
        of_rotations, log_scales, of_scales = (
            np.take_along_axis(each, order, axis=1)
            for each in (curvatures.rotations, splats.log_scales, curvatures.log_scales)
        )
        return cls(quats, of_rotations, levels, log_scales, of_scales)

    def error(self) -> float:
        """Return the error of rounding to the nearest levels."""
        nearest = with_w(self.levels[_nearest(self.quats[:, 1:], self.levels)])
        changes = rotations_between(self.quats, nearest)
        return float((self.curvatures * changes**2).sum())

    def cheapest(self, price: float) -> F32:
        """Return the quaternions of least cost, (N, 4), at a price of a bit."""
        from nanogs.kernels.rate_distortion import cheapest_rotations

        nearest = _nearest(self.quats[:, 1:], self.levels)
        codes = nearest
        for _ in range(ROUNDS):
            lengths = np.stack([_lengths(column, len(self.levels)) for column in codes.T])
            codes = nearest.copy()
            cheapest_rotations(
                self.quats, self.curvatures, self.levels, lengths, price, MOST_TURN, codes
            )
        return with_w(self.levels[codes]).astype(np.float32)


def _nearest(values: F32 | F64, levels: F32 | F64) -> I32:
    """Return the index of the nearest level for each value."""
    middles = (levels[1:].astype(np.float64) + levels[:-1]) / 2
    return np.searchsorted(middles, values).astype(np.int32)


def _lengths(codes: I32, levels: int) -> F64:
    """Return (L,) the bits of each code by how often it occurs (Shannon, 1948)."""
    counts = np.bincount(codes, minlength=levels) + 0.5  # a code that is not in use has bits too
    lengths: F64 = -np.log2(counts / counts.sum())
    return lengths
