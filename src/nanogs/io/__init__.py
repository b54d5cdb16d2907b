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
from nanogs.io.around import Fetched
from nanogs.io.file_objects import as_named, read_file, write_file
from nanogs.io.folder import check_folder_writable
from nanogs.io.format import Format, FormatOptions, nothing_lost
from nanogs.io.info import FileInfo
from nanogs.io.parts import FileSource
from nanogs.io.retag import checked_mode, retagged
from nanogs.io.stand_ins import at_hand, check_sendable
from nanogs.io.urls import Address, place
from nanogs.progress import Progress, Stage, Tracker
from nanogs.source import Source, source_of
from nanogs.splats import Splats, refuse_other

__all__ = [
    "FileInfo",
    "as_packed",
    "as_stored",
    "bytes_on_disk",
    "check_writable",
    "encoded_bytes",
    "inspect",
    "load",
    "losses",
    "open",
    "save",
]


def load(
    path: str | PathLike[str] | BinaryIO,
    *,
    level: int = 0,
    format: str | None = None,  # noqa: A002 - what it is called everywhere
    render_mode: str | None = None,
) -> Splats:
    """Read a model from a file of any format that nanogs knows.

    Args:
        path: The file, its URL, or one that is open for reading bytes, such as `io.BytesIO`, which
            is read from where it stands to its end.
        level: Of a streamed model, which level of detail; 0 is the finest.
        format: Suffix of the format; by default that of the name, or, of an open file without
            one, by its first bytes.
        render_mode: "default" or "mip" in place of a wrong tag of the file, or a missing one; see
            `open`.

    Raises:
        FormatError: The suffix is unknown, the file cannot be read, is damaged, or holds
            something that cannot be kept.
        OptionError: There is no such level, or nothing says the format of an open file; or the
            model cannot have that render mode.
        OutputError: An open file cannot be copied to a temporary one.
    """
    if not isinstance(path, str | PathLike):
        if level != 0:
            raise OptionError("An open file has no levels of detail; leave the level out.")
        return read_file(path, format, render_mode)
    with open(path, level=level, format=format, render_mode=render_mode) as source:
        return source.load()


def open(  # noqa: A001 - what it is called everywhere
    path: str | PathLike[str],
    *,
    level: int = 0,
    format: str | None = None,  # noqa: A002 - as `load` has it
    render_mode: str | None = None,
) -> FileSource:
    """Open a model of which some rows are read at a time, and which is never held whole.

    Rows of .ply, .compressed.ply, .splat, .ksplat and glTF files are read where they are. Files
    that are packed as a whole, .spz, .sog, .npz and those of text, are unpacked into a temporary
    file when rows are first asked for; close the source, or use `with`, to remove it. Other formats
    are read whole then.

    A URL, as text, is fetched into a temporary file, which closing the source removes.

    Args:
        path: The file, or its URL: https, or what fsspec knows, such as "s3://bucket/scene.ply".
        level: Of a streamed model, which level of detail; 0 is the finest.
        format: Suffix of the format; by default that of the name, or, of a URL without one, by its
            first bytes.
        render_mode: "default" or "mip" in place of the render mode that the file names: it is drawn
            so, and files made of it say so. A note tells of it. By default the file's own.

    Returns:
        The source: its `count`, `columns` and `info`, `read(start, stop)` and `take(rows)`.

    Raises:
        FormatError: The suffix is unknown, or the file cannot be read or is damaged; some of it
            only shows when rows are read.
        OptionError: There is no such level, or the model cannot have that render mode.
    """
    checked_mode(render_mode)
    path = place(path)
    if not isinstance(path, Address):
        return _opened(path, level, format, render_mode)
    with ExitStack() as stack:
        [file], _ = stack.enter_context(at_hand([path], format=format))
        opened = _opened(file, level, format, render_mode)
        return Fetched(opened, stack.pop_all().close)


def _opened(
    path: Path,
    level: int,
    format: str | None,  # noqa: A002 - as `load` has it
    render_mode: str | None,
) -> FileSource:
    """As `open`, of a file."""
    known = registry.reader(as_named(path, format))
    if known.open_level is not None:
        return retagged(known.open_level(path, level), render_mode)
    if level != 0:
        raise OptionError(
            f"{path} has no levels of detail, so there is no level {level}; leave it out."
        )
    return retagged(known.open(path), render_mode)


def save(
    splats: Splats | Source,
    path: str | PathLike[str] | BinaryIO,
    *,
    overwrite: bool = False,
    format: str | None = None,  # noqa: A002 - what it is called everywhere
    format_options: FormatOptions | None = None,
    progress: Progress | None = None,
) -> None:
    """Write a model to a file, which appears whole or not at all.

    Of a source, as `open` gives one, formats that list splats one after the other or column by
    column hold no more than some rows: .ply, .splat, .npz, .spz, .glb and .gltf; .compressed.ply
    the centres too. Others read all of it.

    `folder/meta.json` makes the folder of a SOG model; of a folder that exists, nothing is replaced
    but what nanogs made.

    Args:
        splats: The model, or a source of one.
        path: The file; a URL that fsspec writes to, such as "s3://bucket/scene.sog", which the
            whole file is sent to at the end; or a file that is open for writing bytes, such as
            `io.BytesIO`, into which it is written where that stands.
        overwrite: Replace a file that exists.
        format: Suffix of the format; by default that of the name. An open file without a name
            needs it.
        format_options: Of the format, by name. Of .spz `spz_version`, 2, 3 or 4 (by default 3, 2
            with fewer `bits`, or 4 where the file states something beside), and `sh_bits` of a
            colour coefficient of degree 1, 2 to 8 (by default 5), those above having one less; of
            .sog and .spz `palette`, entries for the higher colour coefficients, of .sog 1 to
            65,536, by default two for three splats, and of .spz 1 to 1,048,576, by default each
            splat its own; `bits`, how fine all values are, 4 (coarse) to 8 (by default 7, of .spz
            8); and `spare_bits`, 0 to 6, that centres do without (by default they are as fine as
            splats are small).
        progress: Called with each `nanogs.progress.Step` of a file whose writing takes long.

    Raises:
        ModelError: It is no model, or the format cannot hold it at all.
        OptionError: nanogs does not write the format that the suffix stands for, or the format has
            no such option.
        OutputError: The file or folder exists and `overwrite` is off, or it cannot be written.
    """
    if not isinstance(splats, Source):
        refuse_other(splats)
    if not isinstance(path, str | PathLike):
        write_file(splats, path, format, format_options or {})
        return
    path = place(path)
    named = as_named(path, format)
    known = registry.writable(named)
    if isinstance(path, Address):
        options: dict[str, Any] = {"format_options": format_options, "progress": progress}
        with at_hand([], path, overwrite=overwrite, format=format) as (_, file):
            save(splats, file or path, format=format, **options)
        return
    if known.write_folder:
        folder, chosen = _folder_of(path, known), registry.keywords(known, format_options or {})
        known.write_folder(source_of(splats).load(), folder, overwrite=overwrite, **chosen)
        return
    write = registry.writer(named, format_options)
    tracker = Tracker(progress, [Stage("write", 1.0)])
    told = {"tell": tracker.part} if known.tells else {}
    with atomic.atomic_write(path, overwrite=overwrite) as file:
        write(splats, file, **told)
    tracker.finish()


def encoded_bytes(
    splats: Splats,
    path: str | PathLike[str],
    format_options: FormatOptions | None = None,
) -> int:
    """Bytes of the file that `save` would write, by writing it to memory.

    Raises:
        NanogsError: As for `save`.
    """
    buffer = BytesIO()
    registry.writer(place(path), format_options)(splats, buffer)
    return buffer.getbuffer().nbytes


def as_stored(
    splats: Splats,
    path: str | PathLike[str],
    format_options: FormatOptions | None = None,
) -> Splats:
    """The model as `load` would give it back after `save`, by way of a temporary file.

    Itself where nothing changes, in `.ply` files, and where nanogs does not read the format.

    Raises:
        NanogsError: As for `save`.
    """
    known = registry.writable(place(path))
    if known.suffix == ".ply" or not known.readable:
        return splats
    return as_packed(splats, path, format_options)[0]


def as_packed(
    splats: Splats,
    path: str | PathLike[str],
    format_options: FormatOptions | None = None,
    *,
    progress: Progress | None = None,
) -> tuple[Splats, int]:
    """The model as a file of a readable format gives it back, and the bytes of that file.

    `progress` is called with each step of a file whose writing takes long.

    Raises:
        NanogsError: As for `save`.
    """
    known = registry.writable(place(path))
    if known.suffix == ".ply" and known.file_bytes is not None:
        return splats, known.file_bytes(splats, len(splats))  # which changes nothing
    with temporary_folder("nanogs-") as folder:
        file = folder / "model" / known.suffix
        if not known.write_folder:
            file = file.with_name(f"model{known.suffix}")
            file.parent.mkdir()
        save(splats, file, format_options=format_options, progress=progress)
        size = bytes_on_disk(file)
        return load(file), size


def settled(
    model: Splats | Source, path: str | PathLike[str], format_options: FormatOptions
) -> FormatOptions:
    """Options that follow from a model unless they are given, by which another is written like it.

    Raises:
        NanogsError: As for `save`.
    """
    found = registry.writable(place(path)).settled(source_of(model), format_options)
    return {name: value for name, value in found.items() if format_options.get(name) is None}


def losses(splats: Splats | Source, path: str | PathLike[str]) -> tuple[str, ...]:
    """Name what `save` would leave out, a sentence each; quantisation, which formats imply, is not.

    A source is read once, block by block, unless the format holds all of every model.

    Raises:
        OptionError: As for `save`.
    """
    name = registry.writable(place(path)).losses
    if name is nothing_lost:
        return ()
    if isinstance(splats, Splats):
        return name(splats)
    return join_findings(map(name, splats.blocks()))


def inspect(path: str | PathLike[str], *, level: int = 0) -> FileInfo:
    """Describe a scene file without reading its body.

    Args:
        path: The file.
        level: Of a streamed model, which level of detail; 0 is the finest.

    Raises:
        FormatError: As for `load`, except for what only the rows show.
        OptionError: There is no such level.
    """
    with open(path, level=level) as source:
        return source.info


def bytes_on_disk(path: str | PathLike[str]) -> int:
    """Bytes of a model that has been written: of its file, or of all the files of its folder.

    Raises:
        FormatError: As for `inspect`.
    """
    path = place(path)
    known = registry.find(path)
    if known is not None and known.ours:
        return known.open(path).info.file_bytes
    return path.stat().st_size


def check_writable(
    path: str | PathLike[str],
    *,
    overwrite: bool = False,
    format_options: FormatOptions | None = None,
) -> None:
    """Fail before any computing if `save` could not write to `path`.

    Raises:
        OptionError: As for `save`.
        OutputError: As for `save`, except for a full disk.
    """
    path = place(path)
    known = registry.writable(path)
    registry.keywords(known, format_options or {})
    known.check()
    if isinstance(path, Address):
        check_sendable(path, overwrite=overwrite)
    elif known.ours:
        check_folder_writable(_folder_of(path, known), known.ours, overwrite=overwrite)
    else:
        atomic.check_writable(path, overwrite=overwrite)


def _folder_of(path: Path, known: Format) -> Path:
    """The folder that a file describes.

    Raises:
        OptionError: The file is not called what the format has it called.
    """
    if path.name != known.suffix:
        raise OptionError(
            f"{path}: the file that describes a folder is called {known.suffix}; name it"
            f" {path.parent / path.stem / known.suffix}."
        )
    return path.parent
