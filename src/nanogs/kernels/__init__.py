"""Numba kernels: plain arrays in, plain arrays out, no Python objects, no validation.

The stages in `nanogs.method` and `nanogs.raster` check and allocate, then call these.
"""
