"""`.ksplat` of GaussianSplats3D."""

from nanogs.io.format import Format
from nanogs.io.ksplat.read import KsplatFile

FORMATS = (Format(".ksplat", KsplatFile, rounds=True),)
