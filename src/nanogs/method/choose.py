"""The views and the score that candidates are chosen by, and the growths that are tried."""

import numpy as np

DECIDING = 6  # one view in six is held out, to choose a candidate and to accept a fit
# Tried in turn after the default, as long as each is clearly better: thin opaque shells need more
# growth, because merged splats would let light through at grazing angles.
GROWTHS = (1.5, 1.8, 2.1)
GROWTH_MARGIN = 0.1  # least gain in dB: a few views measure it only roughly
SSIM_WORTH = 50.0  # dB of PSNR for a whole unit of SSIM: 0.02 counts as one dB
LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # ITU-R BT.601; grey takes a third of the work


def quality(psnr: float, ssim: float) -> float:
    """Combine PSNR and SSIM into one score, dB: PSNR alone would favour blur."""
    return psnr + SSIM_WORTH * ssim


def further_growths(usual: float) -> list[float]:
    """Return the growths that are tried after the default one, ascending."""
    return [more for more in GROWTHS if more > usual]
