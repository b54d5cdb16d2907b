"""Open files in place of names: `io.BytesIO`, members of archives, what `open` gives.

Readers map and seek in files, so what is read goes into a temporary one first; what is written goes
into a temporary one too, so that nothing half-written reaches the caller's.
"""

import io
import os
import shutil
from pathlib import Path
from tempfile import SpooledTemporaryFile
from typing import BinaryIO, cast

from nanogs.cleanup import temporary_folder
from nanogs.errors import NanogsError, OptionError, OutputError
from nanogs.io import registry
from nanogs.io.format import FormatOptions
from nanogs.io.registry import sniff
from nanogs.io.retag import retagged
from nanogs.source import Source
from nanogs.splats import Splats

_IN_MEMORY = 1 << 28  # bytes of a file that is written before it goes to the disk


def as_named(path: Path, format: str | None) -> Path:  # noqa: A002 - as `load` has it
    """A name whose suffix says the format: the path's own, or one of the format given."""
    return path if format is None else Path(f"model{registry.suffix_of(format)}")


def read_file(
    file: BinaryIO,
    format: str | None,  # noqa: A002 - as `load` has it
    render_mode: str | None = None,
) -> Splats:
    """The model in an open file, from where it stands to its end.

    Args:
        file: Opened for reading bytes.
        format: Suffix of its format; by default by its name or its first bytes.
        render_mode: As `load` has it.

    Raises:
        FormatError: As for `load`.
        OptionError: It is no file, opened as text, or does not say its format.
        OutputError: It cannot be copied.
    """
    _check_open(file, "read")
    with temporary_folder("nanogs-") as folder:
        copy = folder / "stream"
        try:
            with copy.open("xb") as target:
                shutil.copyfileobj(file, target)
        except OSError as error:
            reason = error.strerror or str(error)
            raise OutputError(
                f"The open file cannot be copied to a temporary one ({reason})."
            ) from (error)
        suffix = _suffix(file, format) or sniff(copy)
        if suffix is None:
            raise OptionError(
                "The open file does not say its format; name it, as in nanogs.load(file,"
                ' format=".splat").'
            )
        named = copy.rename(copy.with_name(f"stream{suffix}"))
        try:
            return retagged(registry.reader(named).open(named), render_mode).load()
        except NanogsError as error:  # which names a folder that the user has never seen
            inside = f"{folder}{os.sep}"
            error.args = tuple(str(part).replace(inside, "") for part in error.args)
            raise


def write_file(
    splats: Splats | Source,
    file: BinaryIO,
    format: str | None,  # noqa: A002 - as `save` has it
    options: FormatOptions,
) -> None:
    """Write a model into an open file, all of it or nothing.

    Args:
        splats: The model.
        file: Opened for writing bytes; the model comes where it stands.
        format: Suffix of its format; by default by its name.
        options: Of the format.

    Raises:
        NanogsError: As for `save`; and it is no file, opened as text, or does not say its format.
    """
    _check_open(file, "write")
    suffix = _suffix(file, format)
    if suffix is None:
        raise OptionError(
            "An open file has no format by itself; name it, as in nanogs.save(splats, file,"
            ' format=".ply").'
        )
    write = registry.writer(Path(f"stream{suffix}"), options)
    with SpooledTemporaryFile(_IN_MEMORY) as made:
        write(splats, cast("BinaryIO", made))
        made.seek(0)
        try:
            shutil.copyfileobj(made, file)
        except OSError as error:
            reason = error.strerror or str(error)
            raise OutputError(f"The open file cannot be written ({reason}).") from error


def _suffix(file: BinaryIO, format: str | None) -> str | None:  # noqa: A002
    """The suffix that is given, or that the file's name ends in, or None."""
    if format is not None:
        return registry.suffix_of(format)
    name = getattr(file, "name", None)  # a number, of files without one
    known = registry.find(Path(name)) if isinstance(name, str) else None
    return known.suffix if known and known.suffix.startswith(".") else None


def _check_open(file: object, method: str) -> None:
    if isinstance(file, io.TextIOBase):
        raise OptionError(f'The file is opened as text; open it with "{method[0]}b".')
    if not hasattr(file, method):
        kind = type(file).__name__
        raise OptionError(f"A path or an open file is needed to {method} a model, not {kind}.")
