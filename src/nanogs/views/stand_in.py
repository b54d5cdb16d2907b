"""A large model by some of its splats, for what looks at it many times."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from nanogs.source import Source, joined_rows
from nanogs.splats import Splats

LIMIT = 600_000  # splats; models of more are stood for by so many at the most
AFAR = 200_000  # where nothing is judged by what is found: roaming views that only say what hides


def stand_in(model: Splats | Source, limit: int | None = None) -> Splats:
    """A model without higher harmonics; one of more splats than a limit by evenly spread rows.

    These are larger by the root of how many each stands for, so that together they cover as much.
    Models in memory and sources, which are read once, give the same rows.

    Args:
        model: The model.
        limit: Splats at most; `LIMIT` by default.

    Raises:
        FormatError: The source cannot be read.
    """
    every = -(-len(model) // (limit or LIMIT))
    some = joined_rows(list(_rows(model, every)))
    if every == 1:
        return some
    return replace(some, log_scales=some.log_scales + np.float32(np.log(every) / 2))


def _rows(model: Splats | Source, every: int) -> Iterator[Splats]:
    """Every so many-th row, block by block, without higher harmonics."""
    passed = 0
    for block in [model] if isinstance(model, Splats) else model.blocks():
        bare = replace(block.with_sh_degree(0), extras={}, elements=())
        yield bare if every == 1 else bare.take(np.arange(-passed % every, len(bare), every))
        passed += len(block)
