"""Simplification of models that do not fit into memory, block by block; see `docs/scale.md`."""
