"""Training checkpoints that were saved by PyTorch: `.pt`, `.ckpt` and `.pth`."""

from nanogs.io.checkpoint.read import FRAME, Checkpoint
from nanogs.io.checkpoint.torch_file import LEGACY_START, PICKLE
from nanogs.io.format import Format

FORMATS = tuple(
    Format(suffix, Checkpoint, frame=FRAME, axes=None, magic=(LEGACY_START,), zip_member=PICKLE)
    for suffix in (".pt", ".ckpt", ".pth")
)
