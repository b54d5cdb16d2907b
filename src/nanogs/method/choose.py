"""Quality by which candidates are chosen, and the growths that are tried."""

# Tried in turn after the usual one, as long as that helps clearly: thin opaque shells want more,
# where merged splats would let light through at grazing angles.
GROWTHS = (1.5, 1.8, 2.1)
GROWTH_MARGIN = 0.5  # dB that a growth has to gain: a few small views judge it roughly
SSIM_WORTH = 50.0  # dB of PSNR that a whole unit of SSIM is worth: 0.02 counts as one dB


def quality(psnr: float, ssim: float) -> float:
    """PSNR and SSIM in one number: PSNR alone would favour blur."""
    return psnr + SSIM_WORTH * ssim


def further_growths(usual: float) -> list[float]:
    """The growths that are tried after the usual one, ascending."""
    return [more for more in GROWTHS if more > usual]
