"""Memory of a block, stage by stage, for blocks of any size; and what all write to the scratch.

No Numba here: `--dry-run` uses it.
"""

from collections.abc import Sequence
from dataclasses import replace

from nanogs.io.files import splat_bytes
from nanogs.method.parameters import ForestParameters
from nanogs.pipeline.memory import plan_memory
from nanogs.pipeline.memory_forest import (
    COMPARED,
    DRAWN,
    FIT_STEP,
    PIXEL,
    PREPARED,
    SHARES,
    fit_state,
)
from nanogs.pipeline.presets import renders
from nanogs.pipeline.settings import MOST_SEEN
from nanogs.source import Layout
from nanogs.store.columns import row_bytes

FINE, ROUGH = 0, 1  # coarse levels of the scene
# Splats of a coarse level, at most: this share of the scene's, and no more than this many for each
# splat of a block, for which memory has room, since they are only drawn. The third number is always
# allowed, however small the blocks.
COARSE_SHARES, COARSE_OF_BLOCK, COARSE_LEAST = (0.9, 0.125), (1.0, 0.5), (1 << 18, 1 << 15)
_CODES = 2 * 8  # Morton codes and their order
_HISTOGRAM = 8 << 16  # of the scores of a forest, for each balance
_PLACE = 4 * 8  # of a group: its centre and reach
_TRIED = 2  # models that are compared with the original at a time; growths share all but scales


def most_coarse(level: int, block: int, splats: int) -> int:
    """Splats of a coarse level of the scene, at most: enough to hide what is behind them.

    Args:
        level: `FINE` or `ROUGH`.
        block: Most splats of a block.
        splats: Of the scene.
    """
    beside = max(int(COARSE_OF_BLOCK[level] * block), COARSE_LEAST[level])
    return min(int(splats * COARSE_SHARES[level]), beside)


def block_stages(
    block: int, splats: int, layout: Layout, parameters: ForestParameters, share: float
) -> dict[str, int]:
    """Bytes that the tasks of a block hold at most, the libraries apart.

    Args:
        block: Splats of the block.
        splats: Of the whole scene.
        layout: Of their columns.
        parameters: Of the method.
        share: What the result keeps of the splats; one block can keep more than others.
    """
    kept = int(min(1.0, 2 * share) * block)
    degree, row = layout.sh_degree, row_bytes(layout)
    extra = row - splat_bytes(degree)
    plain = replace(parameters, measure=False, steps=0)
    grown = plan_memory(block, degree, extra, plain, kept).peak + _CODES * block
    grown = int(grown * (1 + MOST_SEEN if parameters.rounds else 1))
    if not renders(parameters):
        return {"grow": grown}
    fine, rough = (most_coarse(level, block, splats) for level in (FINE, ROUGH))
    bare, features = row_bytes(layout.bare()), 3 * (degree + 1) ** 2 * 4
    pixels = parameters.view_size**2
    coarse = plan_memory(block, 0, 0, plain, min(block, fine)).peak + block * (row + _CODES)
    # Drawn together: the block and its surroundings, copied into one model.
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


def scratch_bytes(
    splats: int,
    block: int,
    blocks: int,
    layout: Layout,
    parameters: ForestParameters,
    shares: Sequence[float],
    *,
    encoded: bool,
) -> int:
    """Bytes of the intermediate files of a job at its end, the results among them.

    Args:
        splats: Of the whole scene.
        block: Most splats of a block.
        blocks: How many blocks.
        layout: Of their columns.
        parameters: Of the method.
        shares: What each result keeps of the splats.
        encoded: Whether results are encoded in chunks before they are put together.
    """
    row, balances = row_bytes(layout), len(parameters.balances)
    results = sum(int(share * splats) for share in shares)
    copies = 2 + encoded + (parameters.steps > 0)  # parts, fitted, encoded, the result
    held = splats * (row + 8)  # sorted, with their codes
    held += splats * (8 + 4 * balances) + blocks * balances * _HISTOGRAM  # forests
    held += len(shares) * splats * 2 * 4 + results * (copies * row + _PLACE)  # labels, parts
    if not renders(parameters):
        return held
    held += splats * 8  # how visible each is
    if blocks > 1:
        coarse = sum(most_coarse(level, block, splats) for level in (FINE, ROUGH))
        held += splats * 12 + blocks * _HISTOGRAM + coarse * row_bytes(layout.bare())
    return held
