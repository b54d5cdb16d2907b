"""Groups of splats as stored splats."""

from dataclasses import replace

import numpy as np

from nanogs._types import F64, I32
from nanogs.kernels.nodes import principal_axes
from nanogs.simplify.blocks import blocks
from nanogs.simplify.extent import Dilation
from nanogs.simplify.gaussians import LEAST_ALPHA, LEAST_SCALE
from nanogs.simplify.growth import area_growths, blocked, widen
from nanogs.simplify.nodes import Nodes, footprints, gather, stored_order
from nanogs.splats import Splats

MOST_OPAQUE = 1 - 1e-6  # alpha 1 has an infinite logit, which not every viewer reads


def store_groups(
    leaves: Nodes,
    labels: I32,
    splats: Splats,
    origin: F64,
    dilation: Dilation,
    growth: float,
    *,
    sheets: bool,
) -> Splats:
    """Stored values of groups, in the order of their dominant members in the input.

    alpha = min(1, blocked / footprint): as much light is stopped as was (`growth.blocked`). Where
    that asks for more than an opaque splat, it grows (`area_growths`). A group of one gets the
    input's bytes back; a larger one takes its extra columns from its dominant member.

    Args:
        leaves: (M) nodes, one for each splat.
        labels: (M,) the group of each; no group is empty.
        splats: The input.
        origin: (3,) what `activate_nodes` took off the centres, scene units.
        dilation: As `activate_nodes` takes it.
        growth: Most that an axis may grow.
        sheets: Those of groups on flat sheets may grow more (`growth.growth_on_sheets`).
    """
    groups = int(labels.max()) + 1
    sources, order, new = stored_order(leaves, labels, groups)
    places = np.empty(groups, np.int32)
    places[order] = np.arange(groups, dtype=np.int32)
    # Gathered in the order in which they are stored, the features are the result's own.
    labels = places[labels]
    merged = gather(leaves, labels, groups)
    scales = np.empty((np.count_nonzero(new), 3), np.float32)
    quats = np.empty((len(scales), 4), np.float32)
    areas = footprints(merged.covariances, dilation.at(merged.means))
    principal_axes(merged.covariances[new], scales, quats)
    larger = area_growths(merged, leaves, labels, areas, growth, sheets=sheets)[new]
    widen(scales, larger)
    alphas = blocked(merged.coverages[new], areas[new]) / areas[new]
    alphas = np.clip(alphas, LEAST_ALPHA, MOST_OPAQUE)
    stored = replace(splats, sh=splats.sh[:, :1]).take(sources)
    stored.means[new] = merged.means[new] + origin
    stored.quats[new] = quats
    stored.log_scales[new] = np.log(np.maximum(scales, np.float32(LEAST_SCALE)))
    stored.opacity_logits[new] = np.log(alphas) - np.log1p(-alphas)
    sh = merged.features.reshape(groups, *splats.sh.shape[1:])
    alone = np.flatnonzero(~new)
    for block in blocks(len(alone)):
        sh[alone[block]] = splats.sh[sources[alone[block]]]
    return replace(stored, sh=sh)
