"""Small functions of the hottest kernels, in vectors of the compiler's own; see README.md."""
