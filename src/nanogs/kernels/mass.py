"""Shares of mass from logarithms, because products of scales overflow long before scales do."""

import math

from nanogs.kernels.policy import inline


@inline
def mass_fraction(log_first: float, log_second: float) -> float:
    """Return the first mass over the sum of both; one half if both are zero."""
    if log_first == -math.inf and log_second == -math.inf:
        return 0.5
    difference = log_second - log_first
    if difference > 700.0:  # exp would overflow; the fraction is below 1e-304
        return 0.0
    return 1.0 / (1.0 + math.exp(difference))
