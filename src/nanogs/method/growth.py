"""Growth: merged splats that block too little light although they are opaque become larger."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nanogs._types import F32, F64, I32
from nanogs.kernels.sheets import sheet_growths
from nanogs.kernels.sides import covered_sides
from nanogs.method.integrals import exponential_integral
from nanogs.method.nodes import LIGHTEST, Nodes, member_lists
from nanogs.neighbours import nearest_neighbours
from nanogs.slices import slices

# Most that an axis of a group may grow that lies on a sheet, or between others on all sides.
MOST_GROWTH = 1.8
_AROUND = 16  # nearest groups that may cover the sides of one


@dataclass(frozen=True, slots=True, eq=False)
class Cover:
    """Merged splats without growth, which may cover the sides of groups.

    Attributes:
        means: (G, 3) float64, scene units, relative to the origin of the run.
        covariances: (G, 6) float64, xx, xy, xz, yy, yz, zz, square scene units.
        alphas: (G,) float64 in (0, 1).
    """

    means: F64
    covariances: F64
    alphas: F64

    @staticmethod
    def joined(parts: Sequence["Cover"]) -> "Cover":
        """One after the other."""
        return Cover(
            np.concatenate([part.means for part in parts]),
            np.concatenate([part.covariances for part in parts]),
            np.concatenate([part.alphas for part in parts]),
        )


def blocked(coverages: F64, areas: F64) -> F64:
    """(G,) float64: how much light each group blocks, as the area that blocks all, square units.

    Less than its members cover together, since they hide each other. Of many splats with the
    moments of a group, exp(-u g) of the light gets through where its Gaussian is g, for u their
    coverage over its footprint; 1 - exp(-u g) over the whole plane is

        footprint (E1(u) + ln u + 0.5772) = footprint (u - u²/4 + u³/18 - ...) = footprint Ein(u).

    Args:
        coverages: (G,) float64, of all members, 0 or more, square scene units.
        areas: (G,) float64, footprints of the groups, above 0, square scene units.
    """
    return areas * exponential_integral(coverages / areas)


def area_needs(
    merged: Nodes, leaves: Nodes, labels: I32, areas: F64, *, sheets: bool
) -> tuple[F64, F64]:
    """How much larger each group has to be for an opaque splat to block enough light.

    A group has to block as much light as its members do (`blocked`), where each counts by how
    visible it is. Their coverage is then (sum w)² / (sum w²/a), for weights w and coverages a: that
    of all members where all are equally visible, without those that are hidden behind others.
    Members of the least weight, such as splats of alpha 0, have it whatever they cover, and are
    left out; of a group that has no others all coverage counts.
    Members side by side on a flat sheet do not hide each other: there all their coverage counts.
    Numbers of groups of one member mean nothing.

    Args:
        merged: G nodes from `gather`.
        leaves: (M) their members.
        labels: (M,) the group of each.
        areas: (G,) float64, footprints of the groups, square scene units.
        sheets: Whether groups on flat sheets grow, however little others may (`growth_on_sheets`).

    Returns:
        (G,) float64, how much larger to block enough, and (G,) float64, from 1, how much larger
        for flat sheets.
    """
    squares = np.zeros(len(merged))
    with np.errstate(divide="ignore", over="ignore"):
        for part in slices(len(leaves)):
            weights = leaves.weights[part]
            shares = weights**2 / leaves.coverages[part]
            shares[weights <= LIGHTEST] = 0.0
            np.add.at(squares, labels[part], shares)
        wanted = np.where(squares > 0, merged.weights**2 / squares, merged.coverages)
    least = np.ones(len(merged))
    if sheets:
        most = growth_on_sheets(merged, leaves, labels, 1.0)
        least = np.clip(wanted / areas, 1.0, most**2)
    return blocked(wanted, areas) / areas, least


def widened(scales: F32, larger: F64) -> F32:
    """(G, 3) float32 scales of which the two longer are longer: no surface becomes thicker.

    Args:
        scales: (G, 3) float32, scene units.
        larger: (G,) float64, factor of the product of the two longer scales.
    """
    factors = np.repeat(np.sqrt(larger)[:, None], 3, axis=1)
    factors[np.arange(len(scales)), np.argmin(scales, axis=1)] = 1.0
    return scales * factors.astype(np.float32)


def covered_around(cover: Cover, groups: I32, scales: F32, quats: F32) -> F64:
    """(R,) float64 in [0, 1], how far others cover all four sides of some groups.

    Where they do, a group that grows fills gaps between it and them; where they do not, it reaches
    beyond the surface.

    Args:
        cover: G groups, these among them.
        groups: (R,) int32, rows of those asked for.
        scales: (R, 3) float32 of these, scene units.
        quats: (R, 4) float32 of these, wxyz, unit.
    """
    shares = np.zeros(len(groups))
    if len(groups) and len(cover.means) > 1:
        neighbours = nearest_neighbours(cover.means, _AROUND)
        covered_sides(
            groups, scales, quats, neighbours, cover.means, cover.covariances, cover.alphas, shares
        )
    return shares


def growth_on_sheets(merged: Nodes, leaves: Nodes, labels: I32, growth: float) -> F64:
    """(G,) float64: most that the axes of each group may grow, more on flat sheets.

    Half the light gets through between Gaussians that have the moments of the pieces of a sheet,
    and nothing behind the sheet stops it. Pieces of a thicker surface have others behind them.

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
    return np.maximum(np.minimum(growths, MOST_GROWTH), growth)
