"""Reading and writing scene files; the format follows from the suffix of the name."""

from contextlib import ExitStack
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO

from nanogs.cleanup import temporary_folder
from nanogs.errors import OptionError
from nanogs.findings import join_findings
from nanogs.io import atomic, registry
from nanogs.io.file_objects import as_named, read_file, stream_name, write_file
from nanogs.io.folder import check_folder_writable
from nanogs.io.format import Format, FormatOptions, nothing_lost
from nanogs.io.info import FileInfo
from nanogs.io.limits import refuse_empty, refused_splats
from nanogs.io.parts import FileSource
from nanogs.io.rate_distortion import Curvatures, rounded
from nanogs.io.retag import checked_mode, retagged
from nanogs.io.url_files import check_sendable, local_copies
from nanogs.io.urls import Address, as_path
from nanogs.io.wrapper import Downloaded
from nanogs.progress import Progress, Stage, Tracker
from nanogs.ranges import as_switch, is_number
from nanogs.source import Source, refuse_no_model, source_of
from nanogs.splats import Splats

__all__ = [
    "FileInfo",
    "bytes_on_disk",
    "check_writable",
    "derived_options",
    "economical",
    "encoded_bytes",
    "inspect",
    "load",
    "losses",
    "open",
    "round_trip",
    "round_trip_with_size",
    "save",
    "write_model",
]


def load(
    path: str | PathLike[str] | BinaryIO,
    *,
    level: int = 0,
    format: str | None = None,  # noqa: A002 - the usual name of this
    render_mode: str | None = None,
) -> Splats:
    """Read a model from a file of any format that nanogs knows.

    Args:
        path: A path, a URL, or a file object that is open for reading bytes, such as `io.BytesIO`,
            which is read from its current position to its end.
        level: Level of detail to read of a streamed model; 0 is the finest.
        format: Suffix of the format. By default that of the file name; the format of a file
            object without a name is detected from its first bytes.
        render_mode: "default" or "mip", to override a wrong or missing render mode tag of the
            file; see `open`.

    Raises:
        FormatError: The suffix is unknown, the file cannot be read, is damaged, or holds
            something that cannot be kept.
        OptionError: There is no such level, the format of a file object cannot be determined, or
            the model cannot have that render mode.
        OutputError: A file object cannot be copied to a temporary file.
    """
    if not isinstance(path, str | PathLike):
        if level != 0:
            raise OptionError("An open file has no levels of detail; leave the level out.")
        return read_file(path, format, render_mode)
    with open(path, level=level, format=format, render_mode=render_mode) as source:
        return source.load()


def open(  # noqa: A001 - the usual name of this
    path: str | PathLike[str],
    *,
    level: int = 0,
    format: str | None = None,  # noqa: A002 - the name in `load`
    render_mode: str | None = None,
) -> FileSource:
    """Open a model for reading some of its rows at a time, without holding all of it in memory.

    Rows of .ply, .compressed.ply, .splat, .ksplat, .lcc and glTF files are read directly from the
    file, those of .rad files chunk by chunk. Files that are compressed as a whole (.spz, .sog,
    .npz) and .ply files of text are unpacked to a temporary file when some rows are first read;
    close the source, or use `with`, to remove it. Other files are loaded whole at that point.

    A URL, as text, is downloaded to a temporary file, which closing the source removes.

    Args:
        path: The file, or its URL: https, or any that fsspec supports, such as
            "s3://bucket/scene.ply".
        level: Level of detail to open of a streamed model; 0 is the finest.
        format: Suffix of the format. By default that of the file name; the format of a URL without
            a known suffix is detected from the first bytes of the file.
        render_mode: "default" or "mip", to replace the render mode that the file states: the model
            is drawn in this mode, and files written from it state this mode. A note on the model
            records the change. By default the file's own.

    Returns:
        The source: its `count`, `columns` and `info`, `read(start, stop)` and `take(rows)`.

    Raises:
        FormatError: The suffix is unknown, or the file cannot be read or is damaged; some of it
            only shows when rows are read.
        OptionError: There is no such level, or the model cannot have that render mode.
    """
    checked_mode(render_mode)
    if not is_number(level, whole=True):
        raise OptionError(f"`level` must be a whole number, not {level!r}.")
    path = as_path(path)
    if not isinstance(path, Address):
        return _opened(path, level, format, render_mode)
    with ExitStack() as stack:
        [file], _ = stack.enter_context(local_copies([path], format=format))
        opened = _opened(file, level, format, render_mode)
        return Downloaded(opened, stack.pop_all().close)


def _opened(
    path: Path,
    level: int,
    format: str | None,  # noqa: A002 - the name in `load`
    render_mode: str | None,
) -> FileSource:
    """Open a local file; see `open`."""
    known = registry.reader(as_named(path, format, to_read=True))
    if known.open_level is None and level != 0:
        registry.refuse_level(path, level)
    registry.refuse_misnamed(path, known, None if format is None else str(path))
    source = known.open_level(path, level) if known.open_level else known.open(path)
    return retagged(source, render_mode)


def save(
    splats: Splats | Source,
    path: str | PathLike[str] | BinaryIO,
    *,
    overwrite: bool = False,
    format: str | None = None,  # noqa: A002 - the usual name of this
    format_options: FormatOptions | None = None,
    progress: Progress | None = None,
) -> tuple[str, ...]:
    """Write a model to a file, which appears whole or not at all; return what it leaves out.

    Of a source, such as `open` returns, formats that store splats row by row or column by column
    are written with only some rows in memory: .ply, .splat, .npz, .spz, .rad, .glb and .gltf;
    .compressed.ply holds all centres as well. Other formats load the whole source.

    `folder/meta.json` writes a SOG model as a folder; an existing folder is only replaced if
    nanogs made all files in it.

    Args:
        splats: The model, or a source of one.
        path: The file; a URL that fsspec writes to, such as "s3://bucket/scene.sog", to which the
            whole file is uploaded at the end; or a file object that is open for writing bytes,
            such as `io.BytesIO`, which is written from its current position on.
        overwrite: Replace a file that exists.
        format: Suffix of the format; by default that of the file name. It is required for a file
            object without a name.
        format_options: Options of the format, by name. For .spz: `spz_version`, 2, 3 or 4 (by
            default 3; 2 with fewer `bits`; 4 if the file states a frame or other extension
            records); and `frame`, the name of the coordinate frame of the model, such as "rub",
            which the file then states. For .sog and .spz: `palette`, number of entries for the
            higher colour coefficients, in .sog 1 to 65,536, by default two for three splats, and in
            .spz 1 to 1,048,576, by default one for each splat; `sh_bits`, the bits of these
            coefficients, 2 to 8, in .spz one less above degree 1 (by default 5; 6 in a .sog whose
            palette is not of merged coefficients); `bits`, the precision of all other values, 4
            (coarse) to 8 (by default 7, in .spz 8); and `spare_bits`, 0 to 6, the number of bits
            dropped from centres (by default the smaller the splats, the fewer).
        progress: Called with each `nanogs.progress.Step`, if the format takes long to write.

    Returns:
        A sentence for each thing that the file leaves out or clamps, such as extra columns, as
        `nanogs.io.losses` gives them; () if it holds all of the model. Quantisation is not named. A
        source is read once more for this, unless the format loses nothing of any model.

    Raises:
        ModelError: It is no model, or the format cannot hold it at all.
        OptionError: nanogs does not write the format of this suffix, or the format has no such
            option.
        OutputError: The file or folder exists and `overwrite` is off, or it cannot be written.
    """
    refuse_no_model(splats)
    if isinstance(path, str | PathLike):
        check_writable(path, overwrite=overwrite, format=format, format_options=format_options)
        named = as_named(as_path(path), format)
    else:
        named = stream_name(path, format)
    left_out = losses(splats, named, format_options)  # now: a source's file may be replaced
    write_model(
        splats, path, overwrite=overwrite, format=format, format_options=format_options,
        progress=progress,
    )  # fmt: skip
    return left_out


def write_model(
    splats: Splats | Source,
    path: str | PathLike[str] | BinaryIO,
    *,
    overwrite: bool = False,
    format: str | None = None,  # noqa: A002 - the name in `save`
    format_options: FormatOptions | None = None,
    progress: Progress | None = None,
) -> None:
    """Write a model as `save` does, for callers that need no losses or find them themselves."""
    refuse_no_model(splats)
    overwrite = as_switch("`overwrite`", overwrite)
    if not isinstance(path, str | PathLike):
        tracker = Tracker(progress, [Stage("write", 1.0)])
        write_file(splats, path, format, format_options or {}, tracker.part)
        tracker.finish()
        return
    path = as_path(path)
    named = as_named(path, format)
    known = registry.writable(named)
    if isinstance(path, Address):
        options: dict[str, Any] = {"format_options": format_options, "progress": progress}
        with local_copies([], path, overwrite=overwrite, format=format) as (_, file):
            write_model(splats, file or path, format=format, **options)
        return
    tracker = Tracker(progress, [Stage("write", 1.0)])
    given = known.reporting(tracker.part)
    if known.write_folder:
        folder = _folder_of(path, known)
        given |= registry.keywords(known, format_options)
        known.write_folder(source_of(splats).load(), folder, overwrite=overwrite, **given)
    else:
        write = registry.writer(named, format_options)
        with atomic.atomic_write(path, overwrite=overwrite) as file:
            write(splats, file, **given)
    tracker.finish()


def encoded_bytes(
    splats: Splats,
    path: str | PathLike[str],
    format_options: FormatOptions | None = None,
) -> int:
    """Compute the size in bytes of the file that `save` would write, by writing it to memory.

    Raises:
        NanogsError: As for `save`.
    """
    refuse_no_model(splats)
    buffer = BytesIO()
    registry.writer(as_path(path), format_options)(splats, buffer)
    return buffer.getbuffer().nbytes


def round_trip(
    splats: Splats,
    path: str | PathLike[str],
    format_options: FormatOptions | None = None,
) -> Splats:
    """Return the model as `load` would read it after `save`, using a temporary file.

    The model is returned unchanged for `.ply`, which loses nothing. For a format that nanogs does
    not read it is what the file shows.

    Raises:
        NanogsError: As for `save`.
    """
    refuse_no_model(splats)
    known = registry.writable(as_path(path))
    if known.suffix == ".ply":
        return splats
    if known.shown is not None:
        return known.shown(splats)
    return round_trip_with_size(splats, path, format_options)[0]


def round_trip_with_size(
    splats: Splats,
    path: str | PathLike[str],
    format_options: FormatOptions | None = None,
    *,
    progress: Progress | None = None,
) -> tuple[Splats, int]:
    """Write a model; return it as read back, see `round_trip`, and the file's size in bytes.

    `progress` is called with each step, if the format takes long to write.

    Raises:
        NanogsError: As for `save`.
    """
    known = registry.writable(as_path(path))
    if known.suffix == ".ply" and known.file_bytes is not None:
        return splats, known.file_bytes(splats, len(splats))  # .ply is lossless
    if known.shown is not None:
        return known.shown(splats), encoded_bytes(splats, path, format_options)
    with temporary_folder("nanogs-") as folder:
        file = folder / "model" / known.suffix
        if not known.write_folder:
            file = file.with_name(f"model{known.suffix}")
            file.parent.mkdir()
        write_model(splats, file, format_options=format_options, progress=progress)
        size = bytes_on_disk(file)
        return load(file), size


def derived_options(
    model: Splats | Source, path: str | PathLike[str], format_options: FormatOptions
) -> FormatOptions:
    """Return the format options that are not given but computed from a model, such as `spare_bits`.

    With these, another model is written with the same precision as this one.

    Raises:
        NanogsError: As for `save`.
    """
    known, source = registry.writable(as_path(path)), source_of(model)
    registry.keywords(known, format_options)  # refuses options that the format does not have
    refuse_empty(source, known.suffix)
    found = known.derived_options(source, format_options)
    return {name: value for name, value in found.items() if format_options.get(name) is None}


def economical(
    splats: Splats,
    curvatures: Curvatures,
    path: str | PathLike[str],
    format_options: FormatOptions,
    coarseness: float = 1.0,
) -> Splats:
    """Round a model's values to those of a format so that its file packs well.

    Args:
        splats: N splats.
        curvatures: How much their values show.
        path: A file of the format; only its suffix counts.
        format_options: Options that the file will be written with.
        coarseness: More than 1 for a smaller file of less quality; see `rate_distortion.rounded`.

    Returns:
        The model, unchanged if it makes no difference to the format.

    Raises:
        OutputError: The format is not written.
    """
    known = registry.writable(as_path(path))
    if known.quantisation is None:
        return splats
    quantisation = known.quantisation(splats, format_options)
    return rounded(splats, curvatures, quantisation, coarseness)


def losses(
    splats: Splats | Source,
    path: str | PathLike[str],
    format_options: FormatOptions | None = None,
) -> tuple[str, ...]:
    """Return a sentence for each thing that `save` would leave out, or why it would refuse.

    Quantisation is not named. Of the format options, those without an effect are.

    A source is read once, block by block, unless the format loses nothing of any model.

    Raises:
        OptionError: As for `save`.
    """
    refuse_no_model(splats)
    known = registry.writable(as_path(path))
    registry.keywords(known, format_options)  # refuses options that the format does not have
    if not len(splats):
        return (f"The model has no splats, {known.suffix} refuses it.",)
    if known.losses is nothing_lost:
        return registry.refused_columns(known, source_of(splats))
    ignored = known.without_effect(format_options, source_of(splats).columns.sh_degree)

    def name(part: Splats) -> tuple[str, ...]:
        return registry.losses_of(known, part, refused_splats(part))

    if isinstance(splats, Splats):
        return (*name(splats), *ignored)
    return (*join_findings(map(name, splats.blocks())), *ignored)


def inspect(path: str | PathLike[str], *, level: int = 0) -> FileInfo:
    """Describe a scene file without reading its body.

    Args:
        path: The file.
        level: Level of detail of a streamed model; 0 is the finest.

    Raises:
        FormatError: As for `load`, except for errors that only reading the rows shows.
        OptionError: There is no such level.
    """
    with open(path, level=level) as source:
        return source.info


def bytes_on_disk(path: str | PathLike[str]) -> int:
    """Return the size in bytes of a written model: of its file, or of all files of its folder.

    Raises:
        FormatError: As for `inspect`.
    """
    path = as_path(path)
    known = registry.find(path)
    if known is not None and known.ours:
        return known.open(path).info.file_bytes
    return path.stat().st_size


def check_writable(
    path: str | PathLike[str],
    *,
    overwrite: bool = False,
    format: str | None = None,  # noqa: A002 - the name in `save`
    format_options: FormatOptions | None = None,
) -> None:
    """Fail before any computing if `save` could not write to `path`.

    Args:
        path: The file or its URL.
        overwrite: As for `save`.
        format: As for `save`.
        format_options: As for `save`.

    Raises:
        OptionError: As for `save`.
        OutputError: As for `save`, except for a full disk.
    """
    path, overwrite = as_path(path), as_switch("`overwrite`", overwrite)
    known = registry.writable(as_named(path, format))
    registry.keywords(known, format_options)
    known.check()
    if isinstance(path, Address):
        check_sendable(path, overwrite=overwrite, format=format)
    elif known.ours:
        check_folder_writable(_folder_of(path, known), known.ours, overwrite=overwrite)
    else:
        atomic.check_writable(path, overwrite=overwrite)


def _folder_of(path: Path, known: Format) -> Path:
    """Return the folder of a model that is named by its manifest, such as `folder/meta.json`.

    Raises:
        OptionError: The manifest does not have the name that the format requires.
    """
    if path.name != known.suffix:
        raise OptionError(
            f"{path}: the file that describes a folder is called {known.suffix}; name it"
            f" {path.parent / path.stem / known.suffix}."
        )
    return path.parent
