"""Estimates for a job in blocks: memory of each stage of a block, and disk space of all files.

This module does not import Numba: `--dry-run` uses it.
"""

from collections.abc import Sequence
from dataclasses import replace

from nanogs.io.files import splat_bytes
from nanogs.method.parameters import ForestParameters
from nanogs.pipeline.estimates.memory import plan_memory
from nanogs.pipeline.estimates.memory_forest import (
    COMPARED,
    DRAWN,
    FIT_STEP,
    PIXEL,
    PREPARED,
    SHARES,
    fit_state,
)
from nanogs.pipeline.options.presets import renders
from nanogs.pipeline.options.settings import FINE, MOST_HALO, ROUGH, most_coarse
from nanogs.source import Layout
from nanogs.store.columns import row_bytes

_CODES = 2 * 8  # bytes a splat: Morton code and sort order
_HISTOGRAM = 8 << 16  # bytes of the histogram of a forest's scores, for each balance
_PLACE = 4 * 8  # bytes of a group: its centre and reach
_COVER = (3 + 6 + 1) * 8  # bytes of a group as a cover of others: centre, covariance, alpha
_SHOWN = 11 * 4  # bytes of how much the values of a splat show: see `Curvatures`
_ROUNDING = 180  # bytes for each splat that rounding works with, measured
_TRIED = 2  # models compared with the original at a time; growth candidates differ in scales only


def block_stages(
    block: int, splats: int, layout: Layout, parameters: ForestParameters, share: float
) -> dict[str, int]:
    """Estimate the most bytes that each task of a block holds, without the libraries themselves.

    Args:
        block: Number of splats of the block.
        splats: Number of splats of the whole scene.
        layout: Layout of their columns.
        parameters: Parameters of the method.
        share: Share of the splats that the result keeps; a block can keep a larger one.
    """
    kept = int(min(1.0, 2 * share) * block)
    degree, row = layout.sh_degree, row_bytes(layout)
    extra = row - splat_bytes(degree)
    plain = replace(parameters, guided=False, steps=0)
    grown = plan_memory(block, degree, extra, plain, kept).peak + _CODES * block
    grown = int(grown * (1 + MOST_HALO if parameters.rounds else 1))
    if not renders(parameters):
        return {"grow": grown}
    fine, rough = (most_coarse(level, block, splats) for level in (FINE, ROUGH))
    bare, features = row_bytes(layout.bare()), 3 * (degree + 1) ** 2 * 4
    pixels = parameters.view_size**2
    coarse = plan_memory(block, 0, 0, plain, min(block, fine)).peak + block * (row + _CODES)
    # Rendered together: the block and its surroundings, copied into one model.
    scene = (block + rough) * (12 + features + PREPARED)
    alone = block * (12 + features + PREPARED) + rough * (bare + PREPARED)
    views = 4 * pixels
    look = block * (bare + _CODES + PREPARED) + fine * (bare + PREPARED)
    look += (block + fine) * (24 + PREPARED + DRAWN + SHARES) + pixels * PIXEL
    judge = alone + scene + _TRIED * kept * row + 2 * views + (block + rough) * DRAWN
    fit = alone + scene + kept * row
    fitted = scene + kept * row + parameters.views * views + pixels * COMPARED
    fitted += rough * (12 + features + PREPARED) + fit_state(kept, features, parameters)
    fitted += (kept + rough) * FIT_STEP + ((block + rough) * DRAWN if parameters.further else 0)
    return {
        "grow": grown + 8 * block,
        "coarse": coarse,
        "look": look,
        "judge": judge + pixels * COMPARED,
        "fit": max(fit, fitted) if parameters.steps else 0,
    }


def rounding_bytes(row: int) -> int:
    """Return the bytes for each splat of `row` bytes that rounding a whole result for a file takes.

    They are those of the result, of the rounded one, and of the work on a `.sog`, which takes most.
    """
    return 2 * row + _SHOWN + _ROUNDING


def scratch_bytes(
    splats: int,
    block: int,
    blocks: int,
    layout: Layout,
    parameters: ForestParameters,
    shares: Sequence[float],
    *,
    encoded: bool,
    searched: bool = False,
    shown: bool = False,
) -> int:
    """Estimate the bytes of all files of a job at its end, including the results.

    Args:
        splats: Number of splats of the whole scene.
        block: Largest number of splats of a block.
        blocks: Number of blocks.
        layout: Layout of their columns.
        parameters: Parameters of the method.
        shares: Share of the splats that each result keeps.
        encoded: Whether results are encoded as chunks before they are assembled.
        searched: Whether the count is searched for; then forests also have the scores of `balance`.
        shown: Whether it is kept how much the values of fitted results show.
    """
    row, scored = row_bytes(layout), {*parameters.balances}
    balances = len(scored | {parameters.balance} if searched else scored)
    results = sum(int(share * splats) for share in shares)
    copies = 2 + encoded + (parameters.steps > 0)  # parts, fitted parts, chunks, the result
    held = splats * (row + 8)  # sorted splats with their Morton codes
    held += splats * (8 + 4 * balances) + blocks * balances * _HISTOGRAM  # forests
    held += results * copies * row
    held += results * _SHOWN * (shown and parameters.steps > 0)
    cut = [share for share in shares if int(share * splats) < splats]  # of the others no group
    groups = sum(int(share * splats) for share in cut)
    if parameters.rounds:
        held += len(cut) * splats * 2 * 4 + groups * _PLACE  # labels before and after
        held += 0 if parameters.guided else groups * _COVER
    if not renders(parameters):
        return held
    held += splats * 8  # visibility
    corrections = parameters.corrections if parameters.guided else 0
    held += len(shares) * corrections * (4 * splats + blocks * _HISTOGRAM)  # their scores
    if blocks > 1:
        coarse = sum(most_coarse(level, block, splats) for level in (FINE, ROUGH))
        held += splats * 12 + blocks * _HISTOGRAM + coarse * row_bytes(layout.bare())
    return held
