"""Growth: enlarge merged splats that would block too little light even if they were opaque."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nanogs import parallel
from nanogs._types import F32, F64, I32
from nanogs.kernels.sheet_growth import sheet_growths
from nanogs.kernels.side_coverage import covered_sides
from nanogs.method.integrals import layers_integral
from nanogs.method.nodes import LIGHTEST, Nodes, member_lists
from nanogs.neighbours import nearest_neighbours
from nanogs.slices import slices

# Largest growth factor of an axis for groups on a sheet, or covered by others on all sides.
MOST_GROWTH = 1.8
_AROUND = 16  # number of nearest groups that may cover the sides of one


@dataclass(frozen=True, slots=True, eq=False)
class Cover:
    """Groups of splats as Gaussians without growth, which may cover the sides of other groups.

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
        """Concatenate several of them."""
        return Cover(
            np.concatenate([part.means for part in parts]),
            np.concatenate([part.covariances for part in parts]),
            np.concatenate([part.alphas for part in parts]),
        )


def effective_counts(leaves: Nodes, labels: I32, coverages: F64, counts: F64 | None = None) -> F64:
    """Compute (G,) float64, how many members of equal coverage each group is like, 1 or more.

    For coverages a it is (sum a)² / sum a² (Kish's effective sample size), and for members that are
    themselves like n splats, (sum a)² / sum (a²/n): as if all these were members.

    Args:
        leaves: M nodes.
        labels: (M,) the group of each.
        coverages: (G,) float64, sum of all members' coverages, square scene units.
        counts: (M,) float64, effective counts of the members; by default 1.
    """
    squares = np.zeros(len(coverages))
    with np.errstate(divide="ignore", invalid="ignore"):
        for part in slices(len(leaves)):
            shares = leaves.coverages[part] / coverages[labels[part]]
            np.square(shares, out=shares)
            if counts is not None:
                shares /= counts[part]
            np.add.at(squares, labels[part], shares)
        found = 1 / squares
    # Groups without any coverage have NaN; the sum of the shares is rounded.
    return np.fmax(found, 1.0)


def blocked(coverages: F64, areas: F64, counts: F64) -> F64:
    """Compute the (G,) float64 light that each group blocks, as an opaque area, square scene units.

    It is less than the sum of its members' coverages, because they hide each other. Where the
    group's Gaussian has the value g, the transmittance of n equal splats with the moments of the
    group is (1 - u g / n)^n, for u their coverage over its footprint; 1 minus this, integrated over
    the plane, is

        footprint (u - (1 - 1/n) u²/4 + ...),

    the coverage for a single splat, and footprint (E1(u) + ln u + 0.5772) for very many.

    Args:
        coverages: (G,) float64, sum of all members' coverages, 0 or more, square scene units.
        areas: (G,) float64, footprints of the groups, above 0, square scene units.
        counts: (G,) float64, `effective_counts`.
    """
    light = np.empty(len(areas))

    def integrate(part: slice) -> None:
        layers = coverages[part] / areas[part]
        light[part] = areas[part] * layers_integral(layers, np.maximum(counts[part], layers))

    parallel.for_each(slices(len(areas)), integrate)
    return light


def area_needs(
    merged: Nodes, leaves: Nodes, labels: I32, areas: F64, *, sheets: bool
) -> tuple[F64, F64]:
    """Compute the factor by which each group's area must grow for an opaque splat to block enough.

    A group has to block as much light as its members do (`blocked`), each counted by its
    visibility. They are taken as very many, which asks for the least: growth that is not needed
    reaches beyond a surface. Their coverage is then (sum w)² / (sum w²/a), for weights w and
    coverages a: the sum of all coverages if all are equally visible, and without those of hidden
    members otherwise.
    Members of the least weight, such as splats of alpha 0, have that weight for any coverage, and
    are left out; if a group has no others, all coverage counts.
    Members side by side on a flat sheet do not hide each other: there all their coverage counts.
    The factors of groups of one member have no meaning.

    Args:
        merged: G nodes from `gather`.
        leaves: M nodes, their members.
        labels: (M,) the group of each member.
        areas: (G,) float64, footprints of the groups, square scene units.
        sheets: Whether groups on flat sheets grow even if other groups may not
            (`growth_on_sheets`).

    Returns:
        (G,) float64, factor of the area to block enough, and (G,) float64, 1 or more, factor for
        flat sheets.
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
        most = growth_on_sheets(merged, leaves, labels)
        least = np.clip(wanted / areas, 1.0, most**2)
    return blocked(wanted, areas, np.full(len(areas), np.inf)) / areas, least


def widened(scales: F32, larger: F64) -> F32:
    """Enlarge the two longer scales, so that no surface becomes thicker; returns (G, 3) float32.

    Args:
        scales: (G, 3) float32, scene units.
        larger: (G,) float64, factor for the product of the two longer scales.
    """
    factors = np.repeat(np.sqrt(larger)[:, None], 3, axis=1)
    factors[np.arange(len(scales)), np.argmin(scales, axis=1)] = 1.0
    return scales * factors.astype(np.float32)


def covered_around(cover: Cover, groups: I32, scales: F32, quats: F32) -> F64:
    """Compute the (R,) float64 degree, in [0, 1], to which others cover all four sides of groups.

    A covered group that grows fills gaps between it and its neighbours; an uncovered one would
    extend beyond the surface.

    Args:
        cover: G groups, including the given ones.
        groups: (R,) int32, rows of the given groups.
        scales: (R, 3) float32, scales of these, scene units.
        quats: (R, 4) float32, quaternions of these, wxyz, unit.
    """
    shares = np.zeros(len(groups))
    if len(groups) and len(cover.means) > 1:
        neighbours = nearest_neighbours(cover.means, _AROUND)
        covered_sides(
            groups, scales, quats, neighbours, cover.means, cover.covariances, cover.alphas, shares
        )
    return shares


def growth_on_sheets(merged: Nodes, leaves: Nodes, labels: I32) -> F64:
    """Compute the (G,) float64 limits on the growth of each group's axes: 1 except on flat sheets.

    Half the light passes between Gaussians that have the moments of the pieces of a sheet, and
    nothing behind the sheet stops it. Pieces of a thicker surface have others behind them.

    Args:
        merged: G nodes from `gather`.
        leaves: M nodes, their members.
        labels: (M,) the group of each member.
    """
    starts, members = member_lists(labels, len(merged))
    growths = np.empty(len(merged))
    sheet_growths(
        starts, members, leaves.weights, leaves.means,
        merged.weights, merged.means, merged.covariances, growths,
    )  # fmt: skip
    return np.clip(growths, 1.0, MOST_GROWTH)
