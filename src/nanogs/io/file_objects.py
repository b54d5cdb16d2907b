"""Reading and writing file objects: `io.BytesIO`, members of archives, results of `open`.

Readers map files and seek in them, so the contents of a file object are copied to a temporary file
first. Output goes to a temporary file too, so that the caller's never gets an incomplete model.
"""

import io
import os
import shutil
from pathlib import Path
from tempfile import SpooledTemporaryFile
from typing import BinaryIO, cast

from nanogs.cleanup import temporary_folder
from nanogs.errors import OptionError, OutputError, shown_as
from nanogs.io import registry
from nanogs.io.format import FormatOptions
from nanogs.io.registry import sniff
from nanogs.io.retag import retagged
from nanogs.io.temporary import into_temporary
from nanogs.progress import PartProgress
from nanogs.source import Source
from nanogs.splats import Splats

_IN_MEMORY = 1 << 28  # bytes of output that are held in memory; more go to a file on disk


def as_named(
    path: Path,
    format: str | None,  # noqa: A002 - the name in `load`
    *,
    to_read: bool = False,
) -> Path:
    """Return a path whose suffix says the format: the given one, or `model` with that suffix.

    Args:
        path: The file.
        format: Name of its format; None for that of its suffix.
        to_read: Whether it is to be read; otherwise it is to be written.

    Raises:
        FormatError: nanogs does not read this format.
        OptionError: nanogs does not write this format, or it is no name.
    """
    return path if format is None else registry.file_of(format, to_read=to_read)


def read_file(
    file: BinaryIO,
    format: str | None,  # noqa: A002 - the name in `load`
    render_mode: str | None = None,
) -> Splats:
    """Read a model from a file object, from its current position to its end.

    Args:
        file: Opened for reading bytes.
        format: Suffix of its format; by default taken from its name or detected from its first
            bytes.
        render_mode: Render mode that overrides the file's; see `load`.

    Raises:
        FormatError: As for `load`.
        OptionError: It is no file object, is closed, is not opened for reading bytes, or its format
            is unknown.
        OutputError: It cannot be copied to a temporary file.
    """
    _check_open(file, "read")
    with temporary_folder("nanogs-") as folder:
        copy = folder / "stream"
        try:
            with copy.open("xb") as target:
                shutil.copyfileobj(file, target)
        except io.UnsupportedOperation:
            raise OptionError('The file is not opened for reading; open it with "rb".') from None
        except OSError as error:
            reason = error.strerror or str(error)
            raise OutputError(
                f"The open file cannot be copied to a temporary one ({reason})."
            ) from (error)
        suffix = _suffix(file, format, to_read=True) or sniff(copy)
        if suffix is None:
            raise OptionError(
                "The open file does not say its format; name it, as in nanogs.load(file,"
                ' format=".splat").'
            )
        named = copy.rename(copy.with_name(f"stream{suffix}"))
        known = registry.reader(named)
        registry.refuse_misnamed(named, known, "The open file")
        with shown_as({f"{folder}{os.sep}": ""}):
            return retagged(known.open(named), render_mode).load()


def stream_name(
    file: BinaryIO,
    format: str | None,  # noqa: A002 - the name in `save`
) -> Path:
    """Return a path whose suffix says the format in which a model is written to a file object.

    Args:
        file: Opened for writing bytes.
        format: Suffix of the format; by default taken from the file's name.

    Raises:
        OptionError: It is no file object, is closed, is opened for text, or its format is unknown.
    """
    _check_open(file, "write")
    suffix = _suffix(file, format)
    if suffix is None:
        raise OptionError(
            "An open file has no format by itself; name it, as in nanogs.save(splats, file,"
            ' format=".ply").'
        )
    return Path(f"stream{suffix}")


def write_file(
    splats: Splats | Source,
    file: BinaryIO,
    format: str | None,  # noqa: A002 - the name in `save`
    options: FormatOptions,
    on_progress: PartProgress,
) -> None:
    """Write a model to a file object, once all of it has been encoded.

    Args:
        splats: The model.
        file: Opened for writing bytes; the model is written at its current position.
        format: Suffix of the format; by default taken from the file's name.
        options: Options of the format.
        on_progress: Progress callback, for formats that report it.

    Raises:
        NanogsError: As for `save`; or it is no file object, is closed, is not opened for writing
            bytes, or its format is unknown.
    """
    named = stream_name(file, format)
    write, given = registry.writer(named, options), registry.writable(named).reporting(on_progress)
    with into_temporary(), SpooledTemporaryFile(_IN_MEMORY) as made:
        write(splats, cast("BinaryIO", made), **given)
        made.seek(0)
        try:
            shutil.copyfileobj(made, file)
        except io.UnsupportedOperation:
            raise OptionError('The file is not opened for writing; open it with "wb".') from None
        except OSError as error:
            reason = error.strerror or str(error)
            raise OutputError(f"The open file cannot be written ({reason}).") from error


def _suffix(
    file: BinaryIO,
    format: str | None,  # noqa: A002 - the name in `load`
    *,
    to_read: bool = False,
) -> str | None:
    """Return the suffix of the given format, or that of the file's name, or None."""
    if format is not None:
        registry.file_of(format, to_read=to_read)  # raises if it is not a format
        return registry.suffix_of(format)
    name = getattr(file, "name", None)  # an integer, the descriptor, for files without a name
    known = registry.find(Path(name)) if isinstance(name, str) else None
    return known.suffix if known and known.suffix.startswith(".") else None


def _check_open(file: object, method: str) -> None:
    if isinstance(file, io.TextIOBase):
        raise OptionError(f'The file is opened as text; open it with "{method[0]}b".')
    if not hasattr(file, method):
        kind = type(file).__name__
        raise OptionError(f"A path or an open file is needed to {method} a model, not {kind}.")
    if getattr(file, "closed", False) is True:
        raise OptionError(f"The file is closed already; {method} the model before closing it.")
