"""Which format some bytes are of, where no name says it."""

import zipfile
from pathlib import Path

from nanogs.io.checkpoint.torch_file import LEGACY_START

_MAGIC = (
    (b"ply\n", ".ply"),  # a compressed one too: the header tells them apart
    (b"ply\r\n", ".ply"),
    (b"glTF", ".glb"),
    (b"NGSP", ".spz"),
    (b"\x1f\x8b", ".spz"),
    (LEGACY_START, ".pt"),
    (b"#usda 1.", ".usda"),
)


def sniff(path: Path) -> str | None:
    """The suffix of the format that a file's first bytes show; None where they show none.

    `.splat` files have no such bytes, and those of `.ksplat` are too few to tell.

    Args:
        path: A file that can be read.
    """
    with path.open("rb") as file:
        start = file.read(8)
    for magic, suffix in _MAGIC:
        if start.startswith(magic):
            return suffix
    return _zipped(path) if start.startswith(b"PK\x03\x04") else None


def _zipped(path: Path) -> str | None:
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (OSError, ValueError, zipfile.BadZipFile, NotImplementedError):
        return None
    if "meta.json" in names:
        return ".sog"
    if any(name.endswith("/data.pkl") for name in names):
        return ".pt"
    return ".npz" if "means.npy" in names else None
