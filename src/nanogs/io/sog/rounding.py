"""How finely a SOG file rounds a model: the bits that centres spare, and the values it can hold."""

import numpy as np

from nanogs.activations import BYTE_LOGITS
from nanogs.io.precision import Precision
from nanogs.io.rate_distortion import Quantisation
from nanogs.io.sog.centres import grid_of, rounded_centres
from nanogs.io.sog.codebook import codebook
from nanogs.io.sog.codes import alpha_codes, codebooks, restored_components
from nanogs.io.sog.meta import CODES
from nanogs.io.sog.options import USUAL_BITS
from nanogs.splats import RenderMode, Splats


def spare_bits(splats: Splats, bits: int = USUAL_BITS) -> int:
    """Compute the default of `spare` that `write.write` uses for a model and `bits`."""
    precision = Precision(bits)
    return grid_of(splats, codebook(splats.log_scales, precision.scale_codes), precision).spare


def quantisation(splats: Splats, bits: int = USUAL_BITS, spare: int | None = None) -> Quantisation:
    """Return the values that `write.write` can give a model with `bits` and `spare`."""
    precision = Precision(bits, spare)
    scales, colours = codebooks(splats, precision)
    grid = grid_of(splats, scales, precision)
    levels = np.arange(precision.alpha_steps + 1) / precision.alpha_steps
    codes = np.arange(0, CODES, precision.rotation_step)
    return Quantisation(
        centres=(rounded_centres(splats, grid, 1), rounded_centres(splats, grid, 2)),
        log_scales=np.unique(scales),
        logits=BYTE_LOGITS[alpha_codes(levels, precision.alpha_steps)],
        colours=np.unique(colours),
        # A surfel keeps its third axis, so that w need not be the largest component.
        rotations=None if splats.render_mode is RenderMode.SURFEL else restored_components(codes),
    )
