"""Search for the coarseness of rounding with which a file fills a size, or just has a PSNR."""

import math
from collections.abc import Callable
from typing import TypeVar

from nanogs.pipeline.search.file_size import AIM, ENOUGH

MOST_TRIED = 4
# Limits of a coarseness. Within these, more splats and finer values gain about the same for each
# byte; beyond them, another count gains more.
FINER, COARSEST = 0.8, 1.6
FINEST = 1 / 64  # if no more splats fit; values are then nearly the nearest
# How much the logarithm of the bytes falls with that of the coarseness: at first, and at least.
USUAL_FALL, LEAST_FALL = 0.05, 0.02

COARSEST_FOR_PSNR, HALVINGS = 2.5, 3  # the limit of `coarsest`, and its steps below that

T = TypeVar("T")


def fill_by_rounding(
    packed: Callable[[float], tuple[T, int]], size: int, finest: float = FINER
) -> tuple[T, int]:
    """Round a result more finely or more coarsely, until its file takes most of a size.

    That is quick, while another count would need another fit.

    Args:
        packed: Rounds a result with a coarseness (see `nanogs.io.economical`); returns it and the
            bytes of its file.
        size: Bytes that the file may have.
        finest: Least coarseness.

    Returns:
        The result and its bytes: with a coarseness of 1 if none fills the size.
    """
    usual = found = packed(1.0)
    coarseness, fall = 0.0, USUAL_FALL  # the coarseness as a logarithm
    for _ in range(MOST_TRIED):
        if ENOUGH * size <= found[1] <= size:
            return found
        wanted = coarseness + math.log(found[1] / (AIM * size)) / fall
        following = min(max(wanted, math.log(finest)), math.log(COARSEST))
        if following == coarseness:
            break
        before, found = found, packed(math.exp(following))
        fall = max(math.log(before[1] / found[1]) / (following - coarseness), LEAST_FALL)
        coarseness = following
    return found if ENOUGH * size <= found[1] <= size else usual


def coarsest(reaches: Callable[[float], bool]) -> float:
    """Return the coarseness of rounding, 1 or more, with which a result still reaches its PSNR.

    Results are mostly somewhat better than asked. Coarser values use that up for a smaller file at
    once, while another count needs another fit.

    Args:
        reaches: Whether the result does so with a coarseness.
    """
    if reaches(COARSEST_FOR_PSNR):
        return COARSEST_FOR_PSNR
    fine, coarse = 0.0, math.log(COARSEST_FOR_PSNR)
    for _ in range(HALVINGS):
        middle = (fine + coarse) / 2
        if reaches(math.exp(middle)):
            fine = middle
        else:
            coarse = middle
    return math.exp(fine)
