"""The formats nanogs knows, by the suffix of the file name."""

import zipfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

from nanogs.errors import FormatError, OptionError, did_you_mean
from nanogs.io.format import Format, FormatOptions, Sizer, Writer
from nanogs.io.urls import Address
from nanogs.source import Source, source_of
from nanogs.splats import Splats

_TOLD_BY = 8  # bytes
LEVELS, TILESET = "lod-meta.json", "tileset.json"
ARCHIVE = ".ssog"  # a zip of a folder with `LEVELS`


def formats() -> tuple[Format, ...]:
    """All formats."""
    from nanogs.io.formats import FORMATS  # a quarter of the time that `--help` took

    return FORMATS


def find(path: Path) -> Format | None:
    """The format with the longest suffix that the file name ends in, whatever its case."""
    name = path.name.lower()
    found = [known for known in formats() if name.endswith(known.suffix)]
    return max(found, key=lambda known: len(known.suffix), default=None)


def sniff(path: Path) -> str | None:
    """The suffix of the format that a file's first bytes show; None where they show none.

    `.splat` files have no such bytes, and those of `.ksplat` are too few to tell.

    Args:
        path: A file that can be read.
    """
    with path.open("rb") as file:
        start = file.read(_TOLD_BY)
    depths = _zipped(path) if start.startswith(b"PK\x03\x04") else {}
    told = [known for known in formats() if known.starts and start.startswith(known.starts)]
    # A zip of a stream has whole models in its folders: what lies outermost says what it is.
    held = sorted((k for k in formats() if k.holds in depths), key=lambda k: depths[k.holds])
    return next((known.suffix for known in (*held, *told)), None)


def _zipped(path: Path) -> dict[str, int]:
    """Names of the files in a zip, and in how many folders the outermost of each name is."""
    depths: dict[str, int] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for each in archive.namelist():
                depth, name = each.count("/"), each.rpartition("/")[2]
                depths[name] = min(depth, depths.get(name, depth))
    except (OSError, ValueError, zipfile.BadZipFile, NotImplementedError):
        return {}
    depths.pop("", None)
    return depths


def suffix_of(format: str) -> str:  # noqa: A002 - as `load` has it
    """The suffix of a format's name, which may begin with a dot or not: ".ply" of "PLY"."""
    return f".{format.lstrip('.').lower()}"


def stem_of(path: Path) -> str:
    """The file's name without its suffix; of a `meta.json` that of its folder."""
    known = find(path)
    stem = path.name[: -len(known.suffix)] if known else path.stem
    return stem or path.resolve().parent.name


def reader(path: Path) -> Format:
    """The format to read a file with.

    Raises:
        FormatError: No known format has the file's suffix, or it has none and is not there.
    """
    known = find(path)
    if known is None:
        if not (path.suffix or isinstance(path, Address) or path.exists()):
            raise FormatError(f"{path}: no such file or folder; check the path.")
        if path.is_dir() and not isinstance(path, Address):
            raise FormatError(f"{path} is a folder; name the model file inside it.")
        suffixes = [known.suffix for known in formats() if known.readable]
        meant = _meant(path, suffixes)
        raise FormatError(f"{path}: unknown suffix{meant}; nanogs reads {', '.join(suffixes)}.")
    return known


def _meant(path: Path, suffixes: Sequence[str]) -> str:
    """Guess the name that a file was meant to have, to follow it; empty where none is close."""
    if path.suffix.lower() == ".json":  # somewhat like every name that ends so, and like .sog
        return did_you_mean(path.name, [s for s in suffixes if s.endswith(".json")], cutoff=0.85)
    return did_you_mean(path.suffix, suffixes)


def writer(path: Path, options: FormatOptions | None = None) -> Writer:
    """The function that writes a model, or a source of one, to files of that suffix.

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
            f"{known.suffix} describes a folder of files; take a format of one file, such as .sog."
        )
    write = known.write if known.streams else partial(_write_whole, known.write)
    return partial(write, **keywords(known, options or {}))


def _write_whole(
    write: Writer,
    model: Splats | Source,
    file: BinaryIO,
    **given: Any,  # noqa: ANN401 - as the writer takes it
) -> None:
    write(source_of(model).load(), file, **given)


def keywords(known: Format, options: FormatOptions) -> dict[str, Any]:
    """Arguments for a format's writer, from options by name; None stands for the default.

    Raises:
        OptionError: The format has no such option, or not that value of it, or options do not go
            together.
    """
    chosen = {}
    for name, value in options.items():
        if value is None:
            continue
        if (option := known.options.get(name)) is None:
            raise OptionError(_foreign(name, known))
        if isinstance(value, bool | float) or value not in option.values:  # 6.0 equals 6
            raise OptionError(f"`{name}` must be {option.allowed}, not {value!r}.")
        chosen[option.keyword] = value
    known.check_options(options)
    return chosen


def framed(
    path: Path, options: FormatOptions | None, frame: tuple[str, str] | None
) -> FormatOptions | None:
    """Options with which a file states the frame that it is turned to, if its format can.

    Args:
        path: What is to be written.
        options: As they were given.
        frame: From and to which the model is turned.
    """
    known, given = find(path), options or {}
    if frame is None or known is None or not known.states_frame(given):
        return options
    name = frame[1].lower()
    return {**given, "frame": name} if name in known.options["frame"].values else options


def _foreign(name: str, known: Format) -> str:
    suffixes = [other.suffix for other in formats() if name in other.options]
    if not suffixes:
        meant = did_you_mean(name, {option for other in formats() for option in other.options})
        return f"There is no option {name!r}{meant} for writing files."
    return f"`{name}` is for {' and '.join(suffixes)} files, not for {known.suffix}; leave it out."


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


def losses_by_format(splats: Splats) -> dict[str, tuple[str, ...]]:
    """Name what a file of each suffix that is written cannot hold of a model."""
    return {known.suffix: known.losses(splats) for known in formats() if known.writable}


def writable(path: Path) -> Format:
    """The format to write a file with, or a folder.

    Raises:
        OptionError: nanogs does not write the format that the suffix stands for.
    """
    known = find(path)
    if known is not None and known.suffix in (LEVELS, TILESET, ARCHIVE):
        raise OptionError(f"{path} describes levels of detail; make them with `nanogs lod`.")
    if known is None and not isinstance(path, Address) and path.is_dir():
        raise OptionError(f"{path} is a folder; name a file in it, such as {path / 'scene.ply'}.")
    if known is None or not known.writable:
        raise OptionError(f"{path}: nanogs does not write this format{_instead(path)}.")
    return known


def file_of(format: str) -> Path:  # noqa: A002 - as `load` has it
    """A name for a file of a format, where only that is known.

    Raises:
        OptionError: There is no such format.
    """
    path = Path(f"model{suffix_of(format)}")
    if find(path) is None:
        raise OptionError(f"nanogs does not write a format {format!r}{_instead(path)}.")
    return path


def _instead(path: Path) -> str:
    """The end of an error on a format's name: what may have been meant, and what is written."""
    suffixes = [known.suffix for known in formats() if known.writable]
    meant = _meant(path, suffixes) if find(path) is None else ""
    return f"{meant}; it writes {', '.join(suffixes)}"
