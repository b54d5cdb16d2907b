"""Growth: merged splats that cover too little although they are opaque become larger."""

import numpy as np

from nanogs._types import F64, I32
from nanogs.kernels.sheets import sheet_growths
from nanogs.simplify.blocks import blocks
from nanogs.simplify.nodes import Nodes, footprints, member_lists

SHEET_GROWTH = 1.8  # most that an axis of a group on a sheet may grow


def grown(merged: Nodes, leaves: Nodes, labels: I32, pixel: float, most: float | F64) -> F64:
    """(G, 6) float64: covariances, larger where even an opaque splat would cover too little.

    What has to be covered is the members' footprints in proportion to how visible they are,
    (sum w)² / (sum w²/a) for weights w and coverages a: all of them where all are seen alike, and
    not those that hide behind others. Groups of one are not to be asked for.

    Args:
        merged: G nodes from `gather`.
        leaves: (M) their members.
        labels: (M,) the group of each.
        pixel: As `footprints` takes it.
        most: That an axis may grow, 1 or more; of each group (G,) or of all.
    """
    squares = np.zeros(len(merged))
    with np.errstate(divide="ignore", over="ignore"):
        for block in blocks(len(leaves)):
            shares = leaves.weights[block] ** 2 / leaves.coverages[block]
            np.add.at(squares, labels[block], shares)
        wanted = merged.weights**2 / squares
    factors = np.clip(wanted / footprints(merged.covariances, pixel), 1.0, np.square(most))
    return merged.covariances * factors[:, None]


def growth_on_sheets(merged: Nodes, leaves: Nodes, labels: I32, growth: float) -> F64:
    """(G,) float64: most that the axes of each group may grow, more on flat sheets.

    Nothing lies behind a sheet of splats, and between Gaussians of the moments of its pieces half
    the light gets through. Pieces of a thicker surface have others behind them.

    Args:
        merged: G nodes from `gather`.
        leaves: (M) their members.
        labels: (M,) the group of each.
        growth: Most that an axis may grow elsewhere.
    """
    starts, members = member_lists(labels, len(merged))
    growths = np.empty(len(merged))
    sheet_growths(
        starts, members, leaves.weights, leaves.means,
        merged.weights, merged.means, merged.covariances, growths,
    )  # fmt: skip
    return np.maximum(np.minimum(growths, SHEET_GROWTH), growth)
