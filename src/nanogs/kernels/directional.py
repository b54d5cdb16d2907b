"""Colours of groups of splats, fitted to what their members show in each of some directions."""

import math

import numpy as np

from nanogs._types import F32, F64, I32, I64
from nanogs.kernels.harmonics import sh_basis
from nanogs.kernels.nodes import symmetric
from nanogs.kernels.policy import exact_inline, exact_parallel_kernel
from nanogs.kernels.quaternion import rotation_matrix
from nanogs.kernels.symmetric3 import adjugate

DIRECTIONS = 24  # known to the compiler, which unrolls the loops over them
_SUMMED = 1024  # members added up in single precision, for speed; of more, shares would get lost
_GREY = np.float32(0.5)  # the colour without harmonics
_BLACK = np.float32(0.0)


@exact_inline
def evaluate_colours(coefficients: F32, basis: F32, colours: F32) -> None:
    """Compute colours by direction, before they are cut off at black.

    coefficients: (3 C,), red, green, blue of one harmonic after the other; basis: (C, D); colours:
    (3, D) out.
    """
    colours[:] = _GREY
    for c in range(len(basis)):
        red, green, blue = coefficients[3 * c], coefficients[3 * c + 1], coefficients[3 * c + 2]
        for d in range(DIRECTIONS):
            value = basis[c, d]
            colours[0, d] += value * red
            colours[1, d] += value * green
            colours[2, d] += value * blue


@exact_parallel_kernel("colours", least=64, each=32)
def fit_directional_colours(
    start: int, stop: int,
    starts: I64, members: I32, weights: F64, covariances: F64, features: F32, rows: I32,
    frames: F32, directions: F64, degree: int, fitted: int, steps: int, rate: float, colours: F32,
) -> None:  # fmt: skip
    """Fit the harmonics of each group to the colours of its members, by gradient descent.

    In direction d the members show t(d) = sum w a(d) max(0, c(d)) / sum w a(d): c their colours and
    a their projected areas sqrt(d^T adj(Sigma) d) over the mean of these. A step lowers
    sum_d (sum w a(d)) (t(d) - max(0, c'(d)))², c' the colour of the group.

    starts (G + 1,), members (N,), weights (N,), covariances (N, 6), features (F, 3 C), rows (N,):
    as in `gather_moments`; frames: (G, 4) wxyz unit, in which each group has the directions;
    directions: (D, 3) unit; degree: of the harmonics; fitted: number of these that may change;
    rate: length of a step, 1 for a whole one; colours: (G, 3 C) changed, except for groups of one
    member.
    """
    areas, whole = np.empty(DIRECTIONS, np.float32), np.empty(DIRECTIONS, np.float32)
    shown, light = np.empty((3, DIRECTIONS), np.float32), np.empty((3, DIRECTIONS), np.float32)
    wholes, lights = np.empty(DIRECTIONS), np.empty((3, DIRECTIONS))  # of all members
    forms, changes = np.empty((6, DIRECTIONS), np.float32), np.empty((3, fitted), np.float32)
    basis = np.empty((colours.shape[1] // 3, DIRECTIONS), np.float32)
    transposed = np.empty((DIRECTIONS, len(basis)), np.float32)
    factor = np.float32(rate * 4.0 * math.pi / DIRECTIONS)
    for group in range(start, stop):
        first, end = starts[group], starts[group + 1]
        if end - first < 2:
            continue
        total = 0.0
        for place in range(first, end):
            total += weights[members[place]]
        turn_directions(frames[group], directions, degree, forms, transposed, basis)
        wholes[:] = 0.0
        lights[:] = 0.0
        for part in range(first, end, _SUMMED):
            whole[:] = _BLACK
            light[:] = _BLACK
            for place in range(part, min(part + _SUMMED, end)):
                row = members[place]
                mean = projected_areas(covariances, row, forms, areas)
                share = np.float32(weights[row] / (total * mean))
                evaluate_colours(features[rows[row]], basis, shown)
                for d in range(DIRECTIONS):
                    area = share * areas[d]
                    whole[d] += area
                    light[0, d] += area * max(shown[0, d], _BLACK)
                    light[1, d] += area * max(shown[1, d], _BLACK)
                    light[2, d] += area * max(shown[2, d], _BLACK)
            # Loops, because copying whole arrays would take four seconds to compile.
            for d in range(DIRECTIONS):
                wholes[d] += whole[d]
                for channel in range(3):
                    lights[channel, d] += light[channel, d]
        for d in range(DIRECTIONS):
            whole[d] = wholes[d]
            for channel in range(3):
                light[channel, d] = lights[channel, d]
        for _ in range(steps):
            descend(colours[group], light, whole, basis, transposed, factor, shown, changes)


@exact_inline
def turn_directions(
    frame: F32, directions: F64, degree: int, forms: F32, transposed: F32, basis: F32
) -> None:
    """Turn the directions into a frame, and evaluate what depends on them.

    frame: (4,) wxyz unit; directions: (D, 3) unit; forms: (6, D) out, x², 2xy, 2xz, y², 2yz, z² of
    each; transposed: (D, C) out, the harmonics; basis: (C, D) out, the same.
    """
    first, second, third = rotation_matrix(frame)
    for d in range(DIRECTIONS):
        a, b, c = directions[d, 0], directions[d, 1], directions[d, 2]
        x = first[0] * a + first[1] * b + first[2] * c
        y = second[0] * a + second[1] * b + second[2] * c
        z = third[0] * a + third[1] * b + third[2] * c
        forms[0, d], forms[1, d], forms[2, d] = x * x, 2.0 * x * y, 2.0 * x * z
        forms[3, d], forms[4, d], forms[5, d] = y * y, 2.0 * y * z, z * z
        sh_basis(x, y, z, degree, transposed[d])
        for i in range(len(basis)):
            basis[i, d] = transposed[d, i]


@exact_inline
def projected_areas(covariances: F64, row: int, forms: F32, areas: F32) -> float:
    """Compute the relative areas that an ellipsoid shows in each direction; return their mean.

    covariances: (N, 6); forms: (6, D), see `turn_directions`; areas: (D,) out.
    """
    xx, xy, xz, yy, yz, zz = adjugate(symmetric(covariances, row))
    trace = xx + yy + zz
    a, b, c = np.float32(xx / trace), np.float32(xy / trace), np.float32(xz / trace)
    d, e, f = np.float32(yy / trace), np.float32(yz / trace), np.float32(zz / trace)
    for i in range(DIRECTIONS):
        areas[i] = math.sqrt(
            max(
                forms[0, i] * a + forms[1, i] * b + forms[2, i] * c
                + forms[3, i] * d + forms[4, i] * e + forms[5, i] * f,
                _BLACK,
            )
        )  # fmt: skip
    mean = 0.0
    for i in range(DIRECTIONS):
        mean += areas[i]
    return mean / DIRECTIONS


@exact_inline
def descend(
    colour: F32, light: F32, whole: F32, basis: F32, transposed: F32, factor: np.float32,
    shown: F32, changes: F32,
) -> None:  # fmt: skip
    """Make one step of gradient descent.

    colour: (3 C,) changed; light: (3, D) sum w a(d) max(0, c(d)); whole: (D,) sum w a(d); basis:
    (C, D); transposed: (D, C), the same; factor: length of the step; shown: (3, D), overwritten;
    changes: (3, B), overwritten, B the number of harmonics that may change.
    """
    evaluate_colours(colour, basis, shown)
    changes[:] = _BLACK
    for channel in range(3):
        for d in range(DIRECTIONS):
            rest = light[channel, d] - whole[d] * max(shown[channel, d], _BLACK)
            rest *= factor
            for c in range(changes.shape[1]):
                changes[channel, c] += transposed[d, c] * rest
    for c in range(changes.shape[1]):
        for channel in range(3):
            value = colour[3 * c + channel] + changes[channel, c]
            if math.isfinite(value):  # harmonics near the end of float32 overflow
                colour[3 * c + channel] = value
