"""Values that an `.spz` file cannot hold: those that are left out, clamped or refused."""

import numpy as np

from nanogs.findings import Finding
from nanogs.io import limits
from nanogs.io.spz.centres import FIXED_MAX, USUAL_FRACTION_BITS, most_fraction_bits, reach_of
from nanogs.io.spz.codes import SH_BITS, buckets_of
from nanogs.io.spz.header import SUFFIX
from nanogs.io.spz.read import COLOUR_SCALE, SCALE_LOW, SCALE_STEPS, SH_STEPS
from nanogs.io.spz.records import without_records
from nanogs.splats import RenderMode, Splats


def losses(
    splats: Splats, *, records: bool = True, suffix: str = SUFFIX, range_of: str = SUFFIX
) -> tuple[str, ...]:
    """Name what the file leaves out or clamps, or why it is refused, one sentence each.

    Args:
        splats: The model.
        records: Whether its extension records go into the file.
        suffix: Name of the format in the sentences, if it contains this one.
        range_of: What has the range to which values are clamped, in the sentences.
    """
    step = 0.5 / SCALE_STEPS
    low, high = SCALE_LOW, SCALE_LOW + 255 / SCALE_STEPS
    scales = splats.log_scales
    with np.errstate(invalid="ignore"):  # signalling NaNs would warn
        far = (np.abs(splats.means) > FIXED_MAX) & np.isfinite(splats.means)
    beyond = f"coordinates beyond ±{FIXED_MAX:,}"
    out = list(limits.refusal(int(far.any(axis=1).sum()), suffix, beyond))
    out += limits.left_out(without_records(splats) if records else splats, suffix)
    out += limits.lost_mode(splats, suffix, RenderMode.MIP)
    out += limits.clamped(
        (scales < low - step) | (scales > high + step),
        f"log-scales outside {low:g} to {high:.2f}, the range of {range_of}",
    )
    out += clamped_colours(splats, range_of)
    fraction = most_fraction_bits(reach_of([splats]))
    if 0 <= fraction < USUAL_FRACTION_BITS:
        text = "Centres are rounded to 1/{}, because the scene is so large."
        out.append(Finding(text, 1 << fraction, min))
    return tuple(out)


def clamped_colours(splats: Splats, range_of: str) -> list[str]:
    """Return a sentence each if base colours, or higher SH coefficients, are clamped to a range."""
    colours, rest = splats.sh[:, 0], splats.sh[:, 1:]
    widest = 0.5 / COLOUR_SCALE
    half = (buckets_of(splats.sh_degree, SH_BITS) / 2 / SH_STEPS)[:, None]
    out = limits.clamped(
        np.abs(colours) > widest * (1 + 1 / 255),
        f"base colours outside ±{widest:.2f}, the range of {range_of}",
    )
    return out + limits.clamped(
        (rest < -1 - half) | (rest > 1 - 1 / SH_STEPS + half),
        f"higher SH coefficients outside ±1, the range of {range_of}",
    )
