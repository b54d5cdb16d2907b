"""Image metrics: PSNR, SSIM, depth error; FLIP and LPIPS with optional packages."""

from nanogs.metrics._flip import flip
from nanogs.metrics._lpips import lpips
from nanogs.metrics._psnr import psnr
from nanogs.metrics._ssim import ssim
from nanogs.metrics.depth import depth_error

__all__ = ["depth_error", "flip", "lpips", "psnr", "ssim"]
