"""The input files of a job: what they were when it began, and whether they still are."""

from pathlib import Path

from nanogs.errors import FormatError
from nanogs.io import FileInfo
from nanogs.io.parts import Packed, Rows
from nanogs.io.registry import reader
from nanogs.scale.settings import Access, InputFile


def input_file(info: FileInfo) -> InputFile:
    """A file as it is now.

    Raises:
        FormatError: It cannot be read.
    """
    known = reader(info.path)
    if known.rows(info.path) is not None:
        access = Access.ROWS
    else:
        access = Access.WHOLE if known.packed(info.path) is None else Access.PACKED
    where = info.path.absolute()  # and no link followed, whose target may have another suffix
    return InputFile(str(where), *_identity(where), info.splats, access)


def check_unchanged(file: InputFile) -> None:
    """Compare a file with what it was.

    Raises:
        FormatError: It has changed, or is gone.
    """
    if not Path(file.path).exists():
        raise FormatError(
            f"{file.path} is not there; the caller and all workers must see the inputs under one"
            " name."
        )
    try:
        same = _identity(Path(file.path)) == (file.bytes, file.modified)
    except (OSError, FormatError):
        same = False
    if not same:
        raise changed(file)


def changed(file: InputFile) -> FormatError:
    """The error for a file that is not what it was."""
    return FormatError(f"{file.path} has changed since the job began; begin it anew.")


def open_rows(file: InputFile) -> Rows:
    """A file whose rows are read in parts.

    Raises:
        FormatError: It cannot be read, or not so any longer.
    """
    path = Path(file.path)
    rows = reader(path).rows(path)
    if rows is None:
        raise changed(file)
    return rows


def open_packed(file: InputFile) -> Packed:
    """A file to be unpacked.

    Raises:
        FormatError: It cannot be read, or not so any longer.
    """
    path = Path(file.path)
    packed = reader(path).packed(path)
    if packed is None:
        raise changed(file)
    return packed


def _identity(path: Path) -> tuple[int, int]:
    """Bytes of all files of a model, and when the last of them was modified, in nanoseconds."""
    found = [each.stat() for each in reader(path).files(path)]
    return sum(each.st_size for each in found), max(each.st_mtime_ns for each in found)
