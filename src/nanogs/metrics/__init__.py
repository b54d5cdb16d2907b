"""How far one image is from another: PSNR, SSIM, depth; FLIP and LPIPS with optional packages."""

from nanogs.metrics.depth import depth_error
from nanogs.metrics.flip import flip
from nanogs.metrics.lpips import lpips
from nanogs.metrics.psnr import psnr
from nanogs.metrics.ssim import ssim

__all__ = ["depth_error", "flip", "lpips", "psnr", "ssim"]
