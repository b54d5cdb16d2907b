"""`.npz`: the arrays of a model as they are, for NumPy."""
