"""Colours of merged splats by direction, for results that are not fitted to renders.

A renderer shows the members of a group beside each other, each as large as it looks from where the
viewer is, and black where its harmonics are negative. Their weighted mean counts each alike from
everywhere: the colour that a flat splat has edge-on counts as much as that of one seen from the
front. So the harmonics are fitted to what is shown in 24 directions.
"""

from itertools import permutations, product

import numpy as np

from nanogs._types import F32, F64, I32, I64
from nanogs.kernels.directional import fit_directional_colours
from nanogs.method.nodes import Nodes

STEPS = 2
RATE = 0.7  # a whole step would be too long for flat splats, whose areas are up to twice the mean
_FITTED = 16  # up to degree 3: a product of two bands of the fit and one above it is integrated
# McLaren's 24 points, a spherical design of strength 7: the mean over them is that over the sphere
# for every polynomial of degree 7 (Hardin & Sloane, "McLaren's Improved Snub Cube and Other New
# Spherical Designs in Three Dimensions", 1996).
_POINT = (0.8662468181078206, 0.42251865376111153, 0.2666354015167047)


def design() -> F64:
    """Return the (24, 3) float64 unit vectors of a spherical design of strength 7."""
    # An orbit under the rotations of a cube: order and signs of a frame's axes do not matter.
    signs = [np.diag(each) for each in product((1.0, -1.0), repeat=3)]
    matrices = [np.eye(3)[list(order)] @ sign for order in permutations(range(3)) for sign in signs]
    return np.array([matrix @ _POINT for matrix in matrices if np.linalg.det(matrix) < 0])


def fit_colours(leaves: Nodes, starts: I64, members: I32, frames: F32, colours: F32) -> None:
    """Fit the harmonics of groups to what their members show in each direction.

    Args:
        leaves: N nodes, one for each splat.
        starts: (G + 1,) start of each group; see `nodes.member_lists`.
        members: (N,) members of the groups; see `nodes.member_lists`.
        frames: (G, 4) float32 wxyz, unit, the principal axes of each group. Directions are relative
            to these, so that a scene that is turned gets the same colours.
        colours: (G, 3 C) float32 weighted means of the members' coefficients; changed for groups of
            several members if C is above 1.
    """
    count = colours.shape[1] // 3
    if count == 1:
        return
    fit_directional_colours(
        starts, members, leaves.weights, leaves.covariances, leaves.features, leaves.rows, frames,
        design(), round(count**0.5) - 1, min(count, _FITTED), STEPS, RATE, colours,
    )  # fmt: skip
