"""A simplification from a wish to a report: `api` checks and asks, `run` calls the stages in turn.

Importing this package imports no Numba; the stages do.
"""
