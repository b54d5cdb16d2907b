"""Simplification: one stage a module, put together in `pipeline`."""

from nanogs.simplify.api import simplify

__all__ = ["simplify"]
