"""Simplification: one stage a module, put together in `pipeline`, called through `api`.

Importing this package imports no Numba; the stages do.
"""
