"""A smaller stand-in for a large model, for searches that render it many times."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from nanogs.source import Source, joined_rows
from nanogs.splats import Splats

LIMIT = 600_000  # most splats of a stand-in


def decimated(model: Splats | Source, limit: int | None = None, *, sh_degree: int = 0) -> Splats:
    """Return a model with few harmonics, reduced to every n-th row if it exceeds a limit.

    The scales are multiplied by the square root of n, so that the rows cover as much as all did.
    Models in memory and sources, which are read once, give the same rows.

    Args:
        model: The model.
        limit: Most splats; `LIMIT` by default.
        sh_degree: Highest degree of harmonics to keep, 0 to 4.

    Raises:
        FormatError: The source cannot be read.
    """
    every = max(-(-len(model) // (limit or LIMIT)), 1)
    some = joined_rows(list(_rows(model, every, sh_degree)))
    if every == 1:
        return some
    return replace(some, log_scales=some.log_scales + np.float32(np.log(every) / 2))


def _rows(model: Splats | Source, every: int, sh_degree: int) -> Iterator[Splats]:
    """Iterate over blocks of every `every`-th row, without harmonics above a degree."""
    passed = 0
    for block in [model] if isinstance(model, Splats) else model.blocks():
        bare = replace(block.with_sh_degree(sh_degree), extras={}, elements=())
        yield bare if every == 1 else bare.take(np.arange(-passed % every, len(bare), every))
        passed += len(block)
