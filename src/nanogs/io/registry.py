"""The formats nanogs knows, by the suffix of the file name."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Protocol

from nanogs.errors import FormatError, OptionError
from nanogs.io import (
    compressed_ply_write,
    gltf,
    gltf_write,
    ksplat,
    npz,
    ply,
    ply_write,
    sog,
    sog_levels,
    sog_write,
    splat,
    spz,
    spz_write,
)
from nanogs.io.folder import Ours
from nanogs.io.info import FileInfo
from nanogs.splats import Splats

LEVELS = "lod-meta.json"
Writer = Callable[[Splats, BinaryIO], None]
Sizer = Callable[[Splats, int], int]
"""Bytes of the file of a model of so many splats that is like the given one in all else."""
Losses = Callable[[Splats], tuple[str, ...]]
"""What a file of the format cannot hold of a model, one sentence each, besides quantisation."""


class FolderWriter(Protocol):
    """Makes the folder of a model; it may replace one of nanogs' own if told so."""

    def __call__(self, splats: Splats, path: Path, *, overwrite: bool) -> None:
        """Write the model; see `io.save` for what it raises."""


def _nothing(_splats: Splats) -> tuple[str, ...]:
    return ()


@dataclass(frozen=True, slots=True)
class Format:
    """One format: what its files are called, and how they are read and written.

    `file_bytes` tells the size of a file before it is written; never smaller for more splats. Of a
    format whose model is a folder, described by the file of the name `suffix` in it, `write_folder`
    makes that folder and `ours` says what in such a folder nanogs made.
    """

    suffix: str
    read: Callable[[Path], Splats]
    inspect: Callable[[Path], FileInfo]
    write: Writer | None = None
    file_bytes: Sizer | None = None
    losses: Losses = _nothing
    write_folder: FolderWriter | None = None
    ours: Ours | None = None


# Both PLY layouts share a reader: the header tells them apart, whatever the file is called.
FORMATS = (
    Format(
        ".compressed.ply",
        ply.read,
        ply.inspect,
        compressed_ply_write.write,
        compressed_ply_write.file_bytes,
        compressed_ply_write.losses,
    ),
    Format(".ply", ply.read, ply.inspect, ply_write.write, ply_write.file_bytes),
    Format(".splat", splat.read, splat.inspect, splat.write, splat.file_bytes, losses=splat.losses),
    Format(".npz", npz.read, npz.inspect, npz.write, npz.file_bytes, losses=npz.losses),
    Format(".spz", spz.read, spz.inspect, spz_write.write, losses=spz_write.losses),
    Format(".ksplat", ksplat.read, ksplat.inspect),
    Format(
        ".glb", gltf.read, gltf.inspect, gltf_write.write, gltf_write.file_bytes, gltf_write.losses
    ),
    Format(".sog", sog.read, sog.inspect, sog_write.write, losses=sog_write.losses),
    Format(
        "meta.json",
        sog.read,
        sog.inspect,
        losses=sog_write.losses,
        write_folder=sog_write.write_folder,
        ours=sog_write.ours,
    ),
    Format(LEVELS, sog_levels.read, sog_levels.inspect),
)


def find(path: Path) -> Format | None:
    """The format with the longest suffix that the file name ends in, whatever its case."""
    name = path.name.lower()
    found = [known for known in FORMATS if name.endswith(known.suffix)]
    return max(found, key=lambda known: len(known.suffix), default=None)


def reader(path: Path) -> Format:
    """The format to read a file with.

    Raises:
        FormatError: No known format has the file's suffix.
    """
    known = find(path)
    if known is None:
        suffixes = ", ".join(known.suffix for known in FORMATS)
        raise FormatError(f"{path}: unknown suffix; nanogs reads {suffixes}.")
    return known


def writable(path: Path) -> Format:
    """The format to write a file with, or a folder.

    Raises:
        OptionError: nanogs does not write the format that the suffix stands for.
    """
    known = find(path)
    if known is not None and known.suffix == LEVELS:
        raise OptionError(f"{path} describes levels of detail; make them with `nanogs lod`.")
    if known is None or not (known.write or known.write_folder):
        suffixes = ", ".join(known.suffix for known in FORMATS if known.write or known.write_folder)
        raise OptionError(f"{path}: nanogs does not write this format; it writes {suffixes}.")
    return known


def sizer(path: Path) -> Sizer:
    """The function that tells how large a file of that suffix will be.

    Raises:
        OptionError: As for `writable`, or the size of such files is not known beforehand.
    """
    known = writable(path)
    if known.file_bytes is None:
        raise OptionError(
            f"The size of a {known.suffix} file is only known once it is written; give a ratio or a"
            " count."
        )
    return known.file_bytes


def losses(path: Path, splats: Splats) -> tuple[str, ...]:
    """What a file of that suffix cannot hold of a model, one sentence each.

    Raises:
        OptionError: As for `writable`.
    """
    return writable(path).losses(splats)
