"""Conversion of groups of splats to stored splats."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nanogs import parallel
from nanogs._types import F32, F64, I32, I64, Bool
from nanogs.activations import LEAST_ALPHA, LEAST_SCALE
from nanogs.kernels.nodes import principal_axes
from nanogs.kernels.symmetric3 import MOST_DEVIATION
from nanogs.method.directional import fit_colours
from nanogs.method.growth import (
    MOST_GROWTH,
    Cover,
    area_needs,
    blocked,
    covered_around,
    effective_counts,
    widened,
)
from nanogs.method.nodes import (
    Nodes,
    footprints,
    gather,
    gather_groups,
    member_lists,
    stored_order,
)
from nanogs.method.viewers import Dilation
from nanogs.slices import slices
from nanogs.splats import Splats, pick

MOST_OPAQUE = 1 - 1e-6  # alpha 1 has an infinite logit, which not every viewer supports


@dataclass(frozen=True, slots=True, eq=False)
class Groups:
    """Groups of splats as stored splats, before growth.

    Attributes:
        model: G splats without growth.
        labels: (G,) int64, label of the group that each of them stands for.
        new: (G,) bool, groups of more than one member.
        scales: (M, 3) float32, scales of the new splats without growth, scene units.
        needed: (M,) float64, factor by which their areas must grow to block enough light.
        least: (M,) float64, 1 or more, factor by which those on flat sheets grow in any case.
        covered: (M,) float64 in [0, 1], degree to which others cover all sides of each: the higher,
            the more it may grow.
    """

    model: Splats
    labels: I64
    new: Bool
    scales: F32
    needed: F64
    least: F64
    covered: F64

    def grown(self, growth: float) -> Splats:
        """Return the model with axes grown by a factor of at most `growth`; shares other columns.

        Splats that others cover on all sides may grow by up to `MOST_GROWTH`, if that is more.
        """
        most = growth + max(MOST_GROWTH - growth, 0.0) * self.covered
        larger = np.maximum(np.clip(self.needed, 1.0, most**2), self.least)
        log_scales = self.model.log_scales.copy()
        with np.errstate(over="ignore"):  # clipped below
            scales = widened(self.scales, larger)
        log_scales[self.new] = np.log(np.clip(scales, LEAST_SCALE, MOST_DEVIATION))
        return replace(self.model, log_scales=log_scales)


def store_groups(
    leaves: Nodes,
    labels: I32,
    splats: Splats,
    origin: F64,
    dilation: Dilation,
    *,
    growth: float | None = None,
    others: Sequence[Cover] = (),
    counts: F64 | None = None,
) -> Groups:
    """Convert groups to stored splats, in the order of their dominant members in the input.

    alpha = min(1, blocked / footprint), so that as much light is blocked as by the members
    (`growth.blocked`). If even an opaque splat blocks too little, it may grow (`area_needs`). A
    group of one keeps the bytes of the input; a larger one takes its extra columns from its
    dominant member.

    Args:
        leaves: M nodes, one for each splat.
        labels: (M,) the group of each; no group is empty.
        splats: The input.
        origin: (3,) the origin that `activate_nodes` subtracted from the centres, scene units.
        dilation: The rasteriser's dilation; see `activate_nodes`.
        growth: Largest growth of most groups, while groups on flat sheets, and those that others
            cover on all sides, may grow more (`growth.growth_on_sheets`, `growth.covered_around`).
            None for results that are measured: all may grow alike, and colours are the weighted
            means; else they are fitted to directions (`directional.fit_colours`), and what may
            follow, a fit to views, starts from there.
        others: Neighbouring groups that are stored elsewhere and may cover these.
        counts: (M,) float64, `growth.effective_counts` of splats that were merged before; by
            default 1.
    """
    groups = int(labels.max()) + 1
    sources, order, new = stored_order(leaves, labels, groups)
    places = np.empty(groups, np.int32)
    places[order] = np.arange(groups, dtype=np.int32)
    # Groups are renumbered in the order of the output, so that gathered features need no copy.
    labels = places[labels]
    starts, members = member_lists(labels, groups)
    merged = gather_groups(leaves, starts, members)
    scales = np.empty((np.count_nonzero(new), 3), np.float32)
    quats = np.empty((len(scales), 4), np.float32)
    areas = footprints(merged.covariances, dilation.at(merged.means))
    principal_axes(merged.covariances[new], scales, quats)
    if growth is not None:
        fit_colours(leaves, starts, members, _frames(quats, new), merged.features)
    del starts, members  # only to free their memory
    like = effective_counts(leaves, labels, merged.coverages, counts)
    needed, least = area_needs(merged, leaves, labels, areas, sheets=growth is not None)
    every = _alphas(merged.coverages, areas, like)
    alphas, covered = every[new], np.zeros(len(scales))
    if growth is not None:
        cover = Cover(merged.means, merged.covariances, every)
        if others:
            cover = Cover.joined([cover, *others])
        asked = np.flatnonzero(needed[new] > growth**2)
        rows = np.flatnonzero(new)[asked].astype(np.int32)
        covered[asked] = covered_around(cover, rows, scales[asked], quats[asked])
    sh = merged.features.reshape(groups, *splats.sh.shape[1:])
    stored = _of_sources(splats, sources, sh)
    stored.means[new] = merged.means[new] + origin
    stored.quats[new] = quats
    stored.opacity_logits[new] = np.log(alphas) - np.log1p(-alphas)
    alone = np.flatnonzero(~new)

    def restore(part: slice) -> None:
        sh[alone[part]] = pick(splats.sh, sources[alone[part]])

    parallel.for_each(slices(len(alone)), restore)
    return Groups(stored, order, new, scales, needed[new], least[new], covered)


def _frames(quats: F32, new: Bool) -> F32:
    """Return the (G, 4) rotations of groups: those of new splats, and none for the others."""
    frames = np.zeros((len(new), 4), np.float32)
    frames[:, 0] = 1
    frames[new] = quats
    return frames


def cover_of(leaves: Nodes, labels: I32, groups: int, dilation: Dilation) -> Cover:
    """Make the Gaussians of groups by which these may cover other groups.

    Args:
        leaves: M nodes, one for each splat; they need no features.
        labels: (M,) the group of each; no group is empty.
        groups: Number of groups.
        dilation: The rasteriser's dilation; see `activate_nodes`.
    """
    merged = gather(leaves, labels, groups)
    areas = footprints(merged.covariances, dilation.at(merged.means))
    counts = effective_counts(leaves, labels, merged.coverages)
    return Cover(merged.means, merged.covariances, _alphas(merged.coverages, areas, counts))


def _alphas(coverages: F64, areas: F64, counts: F64) -> F64:
    """Compute the alphas with which groups of these footprints block as much as their members."""
    return np.clip(blocked(coverages, areas, counts) / areas, LEAST_ALPHA, MOST_OPAQUE)


def _of_sources(splats: Splats, sources: I64, sh: F32) -> Splats:
    """Return the given rows of all columns, with `sh` as the spherical harmonics."""
    return replace(
        splats,
        means=pick(splats.means, sources),
        log_scales=pick(splats.log_scales, sources),
        quats=pick(splats.quats, sources),
        opacity_logits=pick(splats.opacity_logits, sources),
        sh=sh,
        extras={name: pick(column, sources) for name, column in splats.extras.items()},
    )
