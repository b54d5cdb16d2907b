"""Looking up formats by the suffix of a file name or by the first bytes of a file."""

import zipfile
import zlib
from collections.abc import Sequence
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

from nanogs.errors import FormatError, OptionError, OutputError, did_you_mean
from nanogs.formatting import listed
from nanogs.io.files import input_size
from nanogs.io.format import Format, FormatOptions, Sizer, Writer, given_options
from nanogs.io.formats import all_formats, of_name
from nanogs.io.limits import refusal, refused_splats
from nanogs.io.urls import Address, as_path
from nanogs.paths import exists, is_file, is_folder
from nanogs.source import Source, source_of
from nanogs.splats import Splats

_HEAD_BYTES = 8  # bytes at the start of a file from which the format is detected
LEVELS, TILESET = "lod-meta.json", "tileset.json"
META = "meta.json"  # of a SOG model that is a folder
LEVEL_LIST = "levels.json"  # the list of levels in a folder with one file for each
ARCHIVE = ".ssog"  # a zip of a folder with `LEVELS`
_OF_LEVELS = (LEVELS, TILESET, ARCHIVE)
_TO_TEXT = "convert it to text with OpenUSD's usdcat, into a .usda file"
PICTURES = (".png", ".jpg", ".jpeg", ".webp")
# How to get a model out of files that are not read, and whose names resemble those that are.
_REMEDIES = {
    ".usd": _TO_TEXT,
    ".usdc": _TO_TEXT,
    ".usdz": _TO_TEXT,
    ".ssproj": "open this project in SuperSplat, and export a .ply file",
    ".mjs": "run this script with splat-transform, into a .ply file",
    ".gz": "unpack it with gunzip",
    ".zip": "unpack it, or rename it to .sog if it holds the files of one",
}


def formats() -> tuple[Format, ...]:
    """Return all formats."""
    return all_formats()


def find(path: str | PathLike[str]) -> Format | None:
    """Find the format with the longest suffix that matches a file name; case does not matter.

    Raises:
        OptionError: It is no path.
    """
    return of_name(as_path(path).name.lower())


def sniff(path: Path) -> str | None:
    """Detect the format of a file from its first bytes and return its suffix; None if unknown.

    `.splat` files have no magic number, and that of `.ksplat` is too short to be reliable.

    Args:
        path: A file that can be read.
    """
    with path.open("rb") as file:
        start = file.read(_HEAD_BYTES)
    depths = _zipped(path) if start.startswith(b"PK\x03\x04") else {}
    by_magic = [known for known in formats() if known.magic and start.startswith(known.magic)]
    # A zip of a streamed model has whole models in its folders: the outermost manifest decides.
    held = sorted(
        (k for k in formats() if k.zip_member in depths), key=lambda k: depths[k.zip_member]
    )
    return next((known.suffix for known in (*held, *by_magic)), None)


def refuse_misnamed(path: Path, known: Format, called: str | None = None) -> None:
    """Refuse a file that begins like one of another format.

    Args:
        path: The file. One that cannot be read is left to the reader to refuse.
        known: The format that its name states, or that was given.
        called: Name of the file in the message if the format was given apart from its name.

    Raises:
        FormatError: Its first bytes are those of another format.
    """
    other = _recognised(path)
    if other is None or other.open is known.open:
        return
    if other.zip_member and known.zip_member:
        return  # a folder in a damaged archive may look like the other kind of archive
    own = other.suffix
    remedy = f"give it the suffix {own}" if called is None else f"name the format {own}"
    raise FormatError(
        f"{called or path} begins like a {own} file, so it is no {known.suffix} file; {remedy}."
    )


def _recognised(path: Path) -> Format | None:
    """Return the format that the first bytes of a file show; None if they leave doubts.

    Only regular files are opened: a pipe that nothing is written to would wait for ever.
    """
    if not is_file(path):
        return None
    try:
        found = sniff(path)
        if found == ".spz" and not _holds_spz(path):
            return None
    except OSError:
        return None
    return next((each for each in formats() if each.suffix == found), None)


def _holds_spz(path: Path) -> bool:
    """Return whether a file with the first bytes of `.spz` is one: others are gzip files too."""
    from nanogs.io.spz.header import MAGIC

    with path.open("rb") as file:
        start = file.read(1 << 10)
    if start.startswith(MAGIC):
        return True
    try:
        return zlib.decompressobj(wbits=31).decompress(start, len(MAGIC)) == MAGIC
    except zlib.error:
        return False


def _zipped(path: Path) -> dict[str, int]:
    """Return the names of the files in a zip, each with the least folder depth at which it is."""
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


def suffix_of(format: str) -> str:  # noqa: A002 - the name in `load`
    """Convert a format's name, with or without a dot, to its suffix: "PLY" to ".ply".

    Raises:
        OptionError: It is no name.
    """
    if not isinstance(format, str):
        raise OptionError(f"A format is named by its suffix, as '.sog', not {format!r}.")
    return f".{format.lstrip('.').lower()}"


def stem_of(path: Path) -> str:
    """Return the file's name without its suffix; for a `meta.json` the name of its folder."""
    known = find(path)
    stem = path.name[: -len(known.suffix)] if known else path.stem
    return stem or path.resolve().parent.name


def reader(path: Path) -> Format:
    """Return the format for reading a file.

    Raises:
        FormatError: No known format has the file's suffix, or it has none and does not exist.
    """
    known = find(path)
    if known is None:
        if not (path.suffix or isinstance(path, Address) or exists(path)):
            raise FormatError(f"{path}: no such file or folder; check the path.")
        if is_folder(path) and not isinstance(path, Address):
            raise FormatError(f"{path} is a folder; name the model file inside it.")
        if exists(path) and not is_file(path):
            input_size(path)  # refuses pipes and devices
        _refuse_list(path)
        if remedy := _REMEDIES.get(path.suffix.lower()):
            raise FormatError(f"{path}: nanogs does not read {path.suffix} files; {remedy}.")
        if found := _recognised(path):
            raise FormatError(
                f"{path} begins like a {found.suffix} file; give it the suffix {found.suffix}."
            )
        suffixes = _suffixes_read()
        meant = _meant(path, suffixes)
        raise FormatError(
            f"{path}: unknown suffix{meant}; nanogs reads {', '.join(suffixes)}; give it the suffix"
            " of its format."
        )
    return known


def _refuse_list(path: Path) -> None:
    """Refuse a list of levels, and name the file of the finest one.

    Raises:
        FormatError: It is one.
    """
    if path.name != LEVEL_LIST or isinstance(path, Address):
        return
    if finest := sorted(path.parent.glob("level_0.*")):
        raise FormatError(
            f"{path} is the list of levels that `nanogs lod` wrote; name a level, such as"
            f" {finest[0]}."
        )


def refuse_level(path: Path, level: int) -> NoReturn:
    """Refuse to read a level of detail of a file that has none, and name the file that holds it.

    Raises:
        OptionError: Always.
    """
    beside = [] if isinstance(path, Address) else sorted(path.parent.glob(f"level_{level}.*"))
    if beside and path not in beside and is_file(path.parent / LEVEL_LIST):
        raise OptionError(
            f"{path} holds one level of detail, and level {level} is in a file beside it; name"
            f" {beside[0]}."
        )
    raise OptionError(
        f"{path} has no levels of detail, so there is no level {level}; leave `level` out."
    )


def _meant(path: Path, suffixes: Sequence[str]) -> str:
    """Return a "did you mean" text with the closest suffix; empty if none is close."""
    if path.suffix.lower() == ".json":  # too similar to all names in .json, and to .sog
        return did_you_mean(path.name, [s for s in suffixes if s.endswith(".json")], cutoff=0.85)
    return did_you_mean(path.suffix, suffixes)


def writer(path: Path, options: FormatOptions | None = None) -> Writer:
    """Return the function that writes a model, or a source of one, to a file of a path's suffix.

    Args:
        path: The output.
        options: Options of the format, by name; None means the default.

    Raises:
        OptionError: nanogs does not write the format of this suffix, or the format has no such
            option or does not allow that value.
    """
    known = writable(path)
    if known.write is None:
        raise OptionError(
            f"{known.suffix} describes a folder of files; use a format with a single file, such as"
            " .sog."
        )
    write = known.write if known.streams else partial(_write_whole, known.write)
    return partial(write, **keywords(known, options))


def _write_whole(
    write: Writer,
    model: Splats | Source,
    file: BinaryIO,
    **given: Any,  # noqa: ANN401 - as the writer takes it
) -> None:
    write(source_of(model).load(), file, **given)


def keywords(known: Format, options: FormatOptions | None) -> dict[str, Any]:
    """Convert options by name to keyword arguments of a format's writer; None means the default.

    Raises:
        OptionError: The format has no such option or does not allow that value, or options
            contradict each other or are no dictionary.
    """
    chosen, given = {}, given_options(options)
    for name, value in given.items():
        if (option := known.options.get(name)) is None:
            raise OptionError(_foreign(name, known))
        # Floats are refused by type, because 6.0 equals 6.
        if isinstance(value, bool | float) or value not in option.values:
            raise OptionError(f"`{name}` must be {option.allowed}, not {value!r}.")
        chosen[option.keyword] = value
    known.check_options(given)
    return chosen


def add_target_frame(
    path: Path, options: FormatOptions | None, frame: tuple[str, str] | None
) -> FormatOptions | None:
    """Add the frame that a model is turned to to the options, if its format can state it.

    Args:
        path: The output.
        options: Format options that were given.
        frame: Names of the frames that the model is turned from and to; None if it is not turned.
    """
    known, given = find(path), given_options(options)
    if frame is None or known is None or not known.states_frame(given):
        return options
    name = frame[1].lower()
    return {**given, "frame": name} if name in known.options["frame"].values else options


def _foreign(name: str, known: Format) -> str:
    suffixes = [other.suffix for other in formats() if name in other.options]
    if not suffixes:
        meant = did_you_mean(name, {option for other in formats() for option in other.options})
        return f"There is no option {name!r}{meant} for writing files."
    return f"`{name}` is for {listed(suffixes, 'and')} files, not for {known.suffix}; leave it out."


def sizer(path: Path) -> Sizer:
    """Return the function that computes the size of a file of a path's suffix beforehand.

    Raises:
        OptionError: As for `writable`, or the size of such files is only known once written.
    """
    known = writable(path)
    if known.file_bytes is None:
        raise OptionError(
            f"The size of a {known.suffix} file is only known once it is written; give a ratio or a"
            " count."
        )
    return known.file_bytes


def losses_by_format(splats: Splats) -> dict[str, tuple[str, ...]]:
    """For each format that nanogs writes, return sentences on what it cannot hold of a model."""
    refused = refused_splats(splats)
    return {
        known.suffix: losses_of(known, splats, refused) for known in formats() if known.writable
    }


def losses_of(known: Format, splats: Splats, refused: int) -> tuple[str, ...]:
    """Return a sentence if a format refuses a model, and what else it cannot hold of it.

    Args:
        known: The format.
        splats: The model.
        refused: Number of its splats with values that only formats with `any_value` hold.
    """
    refusals = () if known.any_value else refusal(refused, known.suffix)
    columns = refused_columns(known, source_of(splats))
    return (*refusals, *columns, *known.losses(splats))


def refused_columns(known: Format, source: Source) -> tuple[str, ...]:
    """Return the reason why a format cannot hold the extra columns of a model, if it cannot."""
    try:
        known.check_columns(source.columns)
    except OutputError as error:
        return (str(error),)
    return ()


def writable(path: Path) -> Format:
    """Return the format for writing a file or a folder.

    Raises:
        OptionError: nanogs does not write the format of this suffix.
    """
    known = find(path)
    if known is not None and known.suffix in _OF_LEVELS:
        raise OptionError(f"{path} describes levels of detail; make them with `nanogs lod`.")
    if known is None and path.suffix.lower() in PICTURES:
        raise OptionError(f"{path} names a picture; make pictures with `nanogs render`.")
    if known is None and not isinstance(path, Address) and is_folder(path):
        raise OptionError(f"{path} is a folder; name a file in it, such as {path / 'scene.ply'}.")
    if known is None and path.name.strip(".") == path.name and not path.suffix:
        raise OptionError(
            f"{path}: the suffix says which format is written; name a file with one, such as"
            f" {path}.ply or {path / 'scene.ply'}."
        )
    if known is None or not known.writable:
        raise OptionError(f"{path}: nanogs does not write this format{_instead(path)}.")
    return known


def file_of(format: str, *, to_read: bool = False) -> Path:  # noqa: A002 - the name in `load`
    """Return an example file name of a format, for functions that take a path.

    Args:
        format: The format's name, with or without a dot.
        to_read: Whether a file is to be read; otherwise it is to be written.

    Raises:
        FormatError: nanogs does not read such a format.
        OptionError: nanogs does not write such a format, or it is no name.
    """
    suffix = suffix_of(format)
    path = Path(f"model{suffix}")
    known = find(path)
    if to_read and known is None:
        if remedy := _REMEDIES.get(suffix):
            raise FormatError(f"nanogs does not read {suffix} files; {remedy}.")
        suffixes = _suffixes_read()
        raise FormatError(
            f"nanogs does not read a format {format!r}{_meant(path, suffixes)}; it reads"
            f" {', '.join(suffixes)}."
        )
    if not to_read and known is not None and known.suffix in _OF_LEVELS:
        raise OptionError(f"{format} describes levels of detail; make them with `nanogs lod`.")
    if not to_read and (known is None or not known.writable):
        raise OptionError(f"nanogs does not write a format {format!r}{_instead(path)}.")
    return path


def _suffixes_read() -> list[str]:
    return [known.suffix for known in formats() if known.readable]


def _instead(path: Path) -> str:
    """Return the end of an error about a format: the closest name, and all that are written."""
    suffixes = [known.suffix for known in formats() if known.writable]
    meant = _meant(path, suffixes) if find(path) is None else ""
    return f"{meant}; it writes {', '.join(suffixes)}"
