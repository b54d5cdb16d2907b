"""The values that an `.spz` file can give a model."""

from nanogs.activations import BYTE_LOGITS
from nanogs.io.precision import MOST_BITS, Precision
from nanogs.io.rate_distortion import Quantisation
from nanogs.io.spz.centres import fraction_bits, on_grid
from nanogs.io.spz.codes import BLACK, OPAQUE, STEPS, codes_of_grid
from nanogs.io.spz.header import VERSION_SHORT_ROTATIONS
from nanogs.io.spz.read import COLOURS, LOG_SCALES
from nanogs.io.spz.rotations import packed_components, xyz_components
from nanogs.splats import Splats


def quantisation(splats: Splats, bits: int, version: int, spare: int | None) -> Quantisation:
    """Return the values that `write.write` can give a model, in a version of the format.

    Args:
        splats: The model.
        bits: As for `write.write`.
        version: As for `write.write`.
        spare: As for `write.write`.

    Raises:
        OptionError: As for `write.write`.
        OutputError: As for `write.write`.
    """
    steps, fraction = STEPS[bits], fraction_bits(splats, Precision(bits, spare))
    rotations = None
    if bits < MOST_BITS and version == VERSION_SHORT_ROTATIONS:
        rotations = xyz_components(steps.rotations)
    elif bits < MOST_BITS:
        rotations = packed_components(steps.magnitudes)
    return Quantisation(
        centres=(on_grid(splats.means, fraction), on_grid(splats.means, fraction - 1)),
        log_scales=LOG_SCALES[codes_of_grid(steps.scales)],
        logits=BYTE_LOGITS[codes_of_grid(steps.alphas, OPAQUE)],
        colours=COLOURS[codes_of_grid(steps.colours, BLACK)],
        rotations=rotations,
    )
