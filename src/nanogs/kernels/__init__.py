"""Numba kernels: plain arrays in, plain arrays out, no Python objects, no validation.

The stages in `nanogs.simplify` and `nanogs.render` check and allocate, then call these.
"""
