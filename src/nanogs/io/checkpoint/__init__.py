"""Checkpoints of trainers, which PyTorch saved."""

from functools import partial

from nanogs.io.checkpoint import read
from nanogs.io.checkpoint.torch_file import LEGACY_START, PICKLE
from nanogs.io.format import Format
from nanogs.io.parts import Whole

_OPEN = partial(Whole, inspect=read.inspect, read=read.read)
FORMATS = tuple(
    Format(suffix, _OPEN, frame=read.FRAME, axes=None, starts=(LEGACY_START,), holds=PICKLE)
    for suffix in (".pt", ".ckpt", ".pth")
)
