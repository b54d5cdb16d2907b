"""Fit a small model to renders of the original: no photographs, no training data, no network.

`nanogs.fit.api.refit` is the function; it imports Numba on its first call.
"""
