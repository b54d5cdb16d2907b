"""Damped Newton steps of many splats side by side: ten equations each (Levenberg and Marquardt).

Within one splat, every operation depends on the one before it, so that a processor that solves
splat by splat mostly waits. Here the innermost loop runs over splats, which are independent and
fill the vector registers: ten times as fast. The length of that loop is not a constant, because the
compiler would unroll it and then not vectorise it. Operations are kept in the order written: the
remainder of a loop is compiled separately, and if it could reorder them, the rounding of a splat's
step would depend on its lane.
"""

import math

import numpy as np

from nanogs._types import F64, Bool
from nanogs.kernels.chain import SCREEN, SHAPE
from nanogs.kernels.policy import allocating_inline, exact_inline

# Splats side by side: their matrices take 14 kB of the first-level cache.
LANES = 32
# Numbers of parameters, monomials and splats side by side, passed to kernels as arguments: LLVM
# would unroll loops of constant length, and take seconds to compile the result.
SIZES = SHAPE, SCREEN, LANES


@allocating_inline
def new_lanes(shape: int, lanes: int) -> tuple[F64, F64, Bool]:
    """Allocate the arrays of `damped_steps`: gradients, matrices, and which splats have a step.

    Lanes that stay empty are solved, too: their matrices are 0, which gives no step.
    """
    packed = shape * (shape + 1) // 2
    return np.zeros((shape, lanes)), np.zeros((packed, lanes)), np.zeros(lanes, np.bool_)


@exact_inline
def _lift_diagonal(
    shape: int, hessians: F64, damping: float, floor: float, lifts: F64, moves: Bool
) -> None:
    """Damp the matrices, and store what the floor adds to each diagonal; 1 for a matrix of 0."""
    lanes = len(lifts)
    for lane in range(lanes):
        largest = 0.0
        for a in range(shape):
            largest = max(largest, hessians[a * (a + 3) // 2, lane])
        moves[lane] = largest > 0.0
        lifts[lane] = floor * largest if moves[lane] else 1.0
    for a in range(shape):
        for lane in range(lanes):
            hessians[a * (a + 3) // 2, lane] *= 1.0 + damping
            hessians[a * (a + 3) // 2, lane] += lifts[lane]


@exact_inline
def _factorise(shape: int, lower: F64, lifts: F64) -> None:
    """Replace the matrices by their lower Cholesky factors, whose diagonals are inverted."""
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
            # The pivot is at least what was added to the diagonal, but for rounding.
            lower[row + a, lane] = 1.0 / math.sqrt(max(lower[row + a, lane], lifts[lane]))


@exact_inline
def _substitute(lower: F64, steps: F64) -> None:
    """Solve for the steps in place, by substitution with the factors of `_factorise`."""
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
    """Shorten every step to its limits; one that is not finite is none."""
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
    gradients: F64,
    hessians: F64,
    damping: float,
    floor: float,
    limits: F64,
    lifts: F64,
    moves: Bool,
) -> None:
    """Solve the equations of L splats, and shorten the steps to their limits.

    All L lanes are solved, used or not, so that a splat's step does not depend on the number of
    splats beside it.

    Args:
        gradients: (10, L) negative gradients in; the steps out.
        hessians: (55, L) lower triangles of the matrices, row by row; overwritten.
        damping: Fraction of the diagonal that is added to it.
        floor: Fraction of the largest diagonal entry that is added to all of the diagonal, more
            than 0, so that a parameter that nothing determines does not move.
        limits: (10 or more,) largest steps, above 0; a longer step is shortened as a whole.
        lifts: (L,) scratch.
        moves: (L,) out, whether there is a step: false if the matrix is 0 or the step is not
            finite.
    """
    _lift_diagonal(len(gradients), hessians, damping, floor, lifts, moves)
    _factorise(len(gradients), hessians, lifts)
    _substitute(hessians, gradients)
    _shorten(gradients, limits, moves)
