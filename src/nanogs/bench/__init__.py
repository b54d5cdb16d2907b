"""`nanogs bench`: run methods on scenes at several ratios, and tabulate the measurements.

Importing this package imports no Numba; running a method does.
"""
