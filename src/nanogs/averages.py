"""Means that a few extreme values do not decide."""

import numpy as np

from nanogs._types import F64


def cap(some: F64, medians: float) -> float:
    """Return a number of medians of values without zeros; infinite if there are only zeros."""
    positive = some[some > 0]
    return medians * float(np.median(positive)) if len(positive) else np.inf


def capped_mean(values: F64, some: F64, medians: float) -> float:
    """Return the mean of values, of which each counts as a number of medians at most.

    Args:
        values: (N,) 0 or more, N >= 1.
        some: Those of the values that the median is taken of, without zeros; if there are only
            zeros, no value is capped.
        medians: How many medians a value counts as at most.
    """
    return float(np.minimum(values, cap(some, medians)).mean())
