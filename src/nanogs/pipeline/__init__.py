"""The simplification pipeline: `api` checks the arguments, `run` runs the stages in order.

Importing this package imports no Numba; the stages do.
"""
