"""The formats nanogs knows, by the suffix of the file name."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from nanogs.errors import FormatError, OptionError, did_you_mean
from nanogs.io import (
    checkpoint,
    compressed_ply_write,
    gltf,
    gltf_write,
    ksplat,
    npz,
    npz_packed,
    ply,
    ply_write,
    sog,
    sog_levels,
    sog_packed,
    sog_write,
    splat,
    spz,
    spz_write,
    usda_write,
)
from nanogs.io.format import Format, Sizer, WriteOption, Writer, unread
from nanogs.splats import Splats

LEVELS = "lod-meta.json"
_SPZ_FRAME = (
    "not stated in the file; y up (rub) by the specification, though many files have y down (rdf)"
)
_GLTF_FRAME = "y up (luf) in the file, turned to y down (rdf) when read"
_USD_FRAME = "y up in the file, by a transform; the model's own y is taken to be down (rdf)"


# Both PLY layouts share a reader: the header tells them apart, whatever the file is called.
FORMATS = (
    Format(
        ".compressed.ply",
        ply.read,
        ply.inspect,
        compressed_ply_write.write,
        compressed_ply_write.file_bytes,
        compressed_ply_write.losses,
        ply.stream,
        ply.rows,
        ply.packed,
    ),
    Format(
        ".ply",
        ply.read,
        ply.inspect,
        ply_write.write,
        ply_write.file_bytes,
        stream=ply.stream,
        rows=ply.rows,
        packed=ply.packed,
    ),
    Format(
        ".splat",
        splat.read,
        splat.inspect,
        splat.write,
        splat.file_bytes,
        losses=splat.losses,
        rows=splat.rows,
    ),
    Format(
        ".npz",
        npz.read,
        npz.inspect,
        npz.write,
        npz.file_bytes,
        losses=npz.losses,
        packed=npz_packed.packed,
    ),
    Format(
        ".spz",
        spz.read,
        spz.inspect,
        spz_write.write,
        losses=spz_write.losses,
        packed=spz.packed,
        frame=_SPZ_FRAME,
        axes=None,
        options={"spz_version": WriteOption("version", (3, 4))},
    ),
    Format(".ksplat", ksplat.read, ksplat.inspect, rows=ksplat.rows),
    Format(
        ".glb",
        gltf.read,
        gltf.inspect,
        gltf_write.write,
        gltf_write.file_bytes,
        gltf_write.losses,
        rows=gltf.rows,
        frame=_GLTF_FRAME,
        turns=True,
    ),
    Format(
        ".sog",
        sog.read,
        sog.inspect,
        sog_write.write,
        losses=sog_write.losses,
        packed=sog_packed.packed,
        leaps=sog_write.leaps,
    ),
    Format(
        ".usda",
        unread,
        unread,
        usda_write.write,
        losses=usda_write.losses,
        frame=_USD_FRAME,
        turns=True,
    ),
    Format(".pt", checkpoint.read, checkpoint.inspect, frame=checkpoint.FRAME, axes=None),
    Format(".ckpt", checkpoint.read, checkpoint.inspect, frame=checkpoint.FRAME, axes=None),
    Format(
        "meta.json",
        sog.read,
        sog.inspect,
        losses=sog_write.losses,
        packed=sog_packed.packed,
        files=sog_packed.files,
        write_folder=sog_write.write_folder,
        ours=sog_write.ours,
    ),
    Format(
        LEVELS,
        sog_levels.read,
        sog_levels.inspect,
        read_level=sog_levels.read_level,
        packed=sog_packed.packed_level,
        files=sog_packed.level_files,
    ),
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
        suffixes = [known.suffix for known in FORMATS if known.readable]
        meant = did_you_mean(path.suffix, suffixes)
        raise FormatError(f"{path}: unknown suffix{meant}; nanogs reads {', '.join(suffixes)}.")
    return known


def writer(path: Path, options: Mapping[str, Any] | None = None) -> Writer:
    """The function that writes a model to files of that suffix.

    Args:
        path: What is to be written.
        options: Of the format, by name; those that are None stand for the default.

    Raises:
        OptionError: nanogs does not write the format that the suffix stands for, the format has no
            such option, or not that value of it.
    """
    known = writable(path)
    if known.write is None:
        raise OptionError(
            f"{path} describes a folder of files; name a file, such as {path.with_suffix('.sog')}."
        )
    chosen = keywords(known, options or {})
    return partial(known.write, **chosen) if chosen else known.write


def keywords(known: Format, options: Mapping[str, Any]) -> dict[str, Any]:
    """What a format's writer takes, from options by name; None stands for the default.

    Raises:
        OptionError: The format has no such option, or not that value of it.
    """
    chosen = {}
    for name, value in options.items():
        if value is None:
            continue
        if (option := known.options.get(name)) is None:
            raise OptionError(_foreign(name, known))
        if value not in option.values:
            values = " or ".join(map(str, option.values))
            raise OptionError(f"{name} must be {values}, not {value!r}.")
        chosen[option.keyword] = value
    return chosen


def _foreign(name: str, known: Format) -> str:
    suffixes = [other.suffix for other in FORMATS if name in other.options]
    if not suffixes:
        meant = did_you_mean(name, {option for other in FORMATS for option in other.options})
        return f"There is no option {name!r}{meant} for writing files."
    return f"{name} is for {' and '.join(suffixes)} files, not for {known.suffix}; leave it out."


def has_known_size(path: Path) -> bool:
    """Whether the size of files of that suffix is known before they are written.

    Raises:
        OptionError: As for `writer`.
    """
    return writable(path).file_bytes is not None


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


def losses_by_format(splats: Splats) -> dict[str, tuple[str, ...]]:
    """What a file of each suffix that is written cannot hold of a model."""
    return {known.suffix: known.losses(splats) for known in FORMATS if known.writable}


def writable(path: Path) -> Format:
    """The format to write a file with, or a folder.

    Raises:
        OptionError: nanogs does not write the format that the suffix stands for.
    """
    known = find(path)
    if known is not None and known.suffix == LEVELS:
        raise OptionError(f"{path} describes levels of detail; make them with `nanogs lod`.")
    if known is None or not known.writable:
        suffixes = [known.suffix for known in FORMATS if known.writable]
        meant = did_you_mean(path.suffix, suffixes) if known is None else ""
        raise OptionError(
            f"{path}: nanogs does not write this format{meant}; it writes {', '.join(suffixes)}."
        )
    return known
