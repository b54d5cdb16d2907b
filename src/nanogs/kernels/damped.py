"""Damped Newton steps of many splats side by side: ten equations each (Levenberg and Marquardt).

Every sum of one splat waits for the one before it, so that a processor that solves splat by splat
mostly waits. Here the innermost loop runs over splats, which do not wait for each other and fill
the processor's vectors: ten times as fast. Its length is not known to the compiler, which would
write a known one out and then not find the vectors. Sums keep their order: the end of a loop is
compiled apart, and with liberties it could round a splat's step by where the splat stands.
"""

import math

import numpy as np

from nanogs._types import F64, Bool
from nanogs.kernels.chain import SCREEN, SHAPE
from nanogs.kernels.policy import exact_inline

# Splats side by side: their blocks fill 14 kB of the first cache.
LANES = 32
# Parameters, monomials and splats side by side, for a kernel to take: loops of lengths that LLVM
# knows are written out, and it takes seconds to compile what comes of that.
SIZES = SHAPE, SCREEN, LANES


@exact_inline
def new_lanes(shape: int, lanes: int) -> tuple[F64, F64, Bool]:
    """Allocate what `damped_steps` takes: the pulls, the blocks, and which splats have a step.

    Lanes that stay empty are solved too: as what nothing bends.
    """
    packed = shape * (shape + 1) // 2
    return np.zeros((shape, lanes)), np.zeros((packed, lanes)), np.zeros(lanes, np.bool_)


@exact_inline
def _lift_diagonal(
    shape: int, blocks: F64, damping: float, floor: float, lifts: F64, moves: Bool
) -> None:
    """Damp the blocks, and note what the floor adds to each; 1 where nothing bends."""
    lanes = len(lifts)
    for lane in range(lanes):
        largest = 0.0
        for a in range(shape):
            largest = max(largest, blocks[a * (a + 3) // 2, lane])
        moves[lane] = largest > 0.0
        lifts[lane] = floor * largest if moves[lane] else 1.0
    for a in range(shape):
        for lane in range(lanes):
            blocks[a * (a + 3) // 2, lane] *= 1.0 + damping
            blocks[a * (a + 3) // 2, lane] += lifts[lane]


@exact_inline
def _factorise(shape: int, lower: F64, lifts: F64) -> None:
    """Cholesky's lower factors in place of the blocks, with the inverses of their diagonals."""
    lanes = len(lifts)
    for a in range(shape):
        row = a * (a + 1) // 2
        for b in range(a + 1):
            other = b * (b + 1) // 2
            for k in range(b):
                for lane in range(lanes):
                    lower[row + b, lane] -= lower[row + k, lane] * lower[other + k, lane]
            if b < a:
                for lane in range(lanes):
                    lower[row + b, lane] *= lower[other + b, lane]
        for lane in range(lanes):
            # Rounding alone could make it less than what was added.
            lower[row + a, lane] = 1.0 / math.sqrt(max(lower[row + a, lane], lifts[lane]))


@exact_inline
def _substitute(lower: F64, steps: F64) -> None:
    """Solve for the steps in place, with the factors of `_factorise`."""
    shape, lanes = steps.shape
    for a in range(shape):
        row = a * (a + 1) // 2
        for k in range(a):
            for lane in range(lanes):
                steps[a, lane] -= lower[row + k, lane] * steps[k, lane]
        for lane in range(lanes):
            steps[a, lane] *= lower[row + a, lane]
    for a in range(shape - 1, -1, -1):
        for k in range(a + 1, shape):
            other = k * (k + 1) // 2
            for lane in range(lanes):
                steps[a, lane] -= lower[other + a, lane] * steps[k, lane]
        for lane in range(lanes):
            steps[a, lane] *= lower[a * (a + 3) // 2, lane]


@exact_inline
def _shorten(steps: F64, limits: F64, moves: Bool) -> None:
    """Hold every step to its limits; what is past all bounds is none."""
    for lane in range(steps.shape[1]):
        excess, length = 1.0, 0.0
        for a in range(len(steps)):
            excess = max(excess, abs(steps[a, lane]) / limits[a])
            length += abs(steps[a, lane])
        moves[lane] = moves[lane] and length < math.inf
        for a in range(len(steps)):
            steps[a, lane] /= excess


@exact_inline
def damped_steps(
    pulls: F64, blocks: F64, damping: float, floor: float, limits: F64, lifts: F64, moves: Bool
) -> None:
    """Solve the equations of L splats and hold the steps to their limits.

    All L are solved, whatever some of them hold: what a splat comes to does not depend on how many
    there are beside it.

    Args:
        pulls: (10, L) in; the steps out.
        blocks: (55, L) lower triangles, row by row; overwritten.
        damping: Share of the diagonal added to it.
        floor: Share of the largest curvature added to all of the diagonal, more than 0: what
            nothing determines stays where it is.
        limits: (10 or more,) largest steps, above 0; a longer step is shortened as a whole.
        lifts: (L,) scratch.
        moves: (L,) out, whether there is a step: not where nothing bends, or where numbers are past
            all bounds.
    """
    _lift_diagonal(len(pulls), blocks, damping, floor, lifts, moves)
    _factorise(len(pulls), blocks, lifts)
    _substitute(blocks, pulls)
    _shorten(pulls, limits, moves)
