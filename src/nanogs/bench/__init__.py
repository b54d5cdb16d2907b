"""`nanogs bench`: methods, scenes and ratios in, rows of numbers out, and tables of them.

Importing this package imports no Numba; running a method does.
"""
