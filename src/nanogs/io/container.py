"""The files of a SOG model, in a folder or in one zip; only those asked for are read."""

import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

from nanogs.errors import FormatError
from nanogs.io.files import input_size, reading
from nanogs.io.texts import reason

_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 0x1
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest that a zip can state
_DAMAGE = (OSError, EOFError, ValueError, NotImplementedError, zipfile.BadZipFile, zlib.error)


class Folder:
    """Files by plain name, in one folder."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def where(self, name: str) -> str:
        """The file as the user may call it, for messages."""
        return str(self._path / name)

    def size(self, name: str) -> int:
        """Bytes of a file, unpacked.

        Raises:
            FormatError: There is no such file, or it is no plain one.
        """
        return input_size(self._path / name)

    def bytes_on_disk(self, names: Iterable[str]) -> int:
        """Bytes of the files of those names as they are stored, with what holds them.

        Raises:
            FormatError: As for `size`.
        """
        return sum(map(self.size, names))

    def read(self, name: str, limit: int) -> bytes:
        """The first `limit` bytes of a file, or all of it where it is shorter.

        Raises:
            FormatError: As for `size`, or the file cannot be read.
        """
        self.size(name)
        with reading(self._path / name) as file:
            return file.read(limit)


class Bundle(Folder):
    """Files by plain name, in one zip, or in a folder in there.

    Args:
        path: The zip, for messages.
        file: The zip, open for reading.
        inside: The folder, with a slash at its end; empty for the zip's own.

    Raises:
        FormatError: The file is no zip or is damaged.
    """

    def __init__(self, path: Path, file: BinaryIO, inside: str = "") -> None:
        super().__init__(path)
        self._inside = inside
        try:
            self._zip = zipfile.ZipFile(file)
        except _DAMAGE as error:
            raise FormatError(
                f"{path} is no zip file or is cut short ({reason(error)}); export or download it"
                " again."
            ) from error

    def where(self, name: str) -> str:
        """The file's name after that of the zip."""
        return f"{self._path}: {self._inside}{name}"

    def size(self, name: str) -> int:
        """Bytes of a file as the zip states them; see `Folder`."""
        return self._entry(name).file_size

    def bytes_on_disk(self, names: Iterable[str]) -> int:
        """Bytes of the zip, in which the files must be; of a folder in there, of them alone."""
        packed = sum(self._entry(name).compress_size for name in names)
        return packed if self._inside else input_size(self._path)

    def read(self, name: str, limit: int) -> bytes:
        """The beginning of a file, its checksum checked at its end; see `Folder`."""
        entry = self._entry(name)
        try:
            with self._zip.open(entry) as file:
                data = file.read(min(limit, entry.file_size))
        except _DAMAGE as error:
            raise self._error(name, f"is damaged ({reason(error)})") from error
        if len(data) < min(limit, entry.file_size):
            raise self._error(name, "is cut short")
        return data

    def _entry(self, name: str) -> zipfile.ZipInfo:
        try:
            entry = self._zip.getinfo(self._inside + name)
        except KeyError:
            raise self._error(name, "is missing") from None
        if entry.flag_bits & _ENCRYPTED or entry.compress_type not in _METHODS:
            raise self._error(name, "is encrypted or packed in a way other than deflate")
        return entry

    def _error(self, name: str, what: str) -> FormatError:
        return damaged(self.where(name), what)


def damaged(where: str, what: str) -> FormatError:
    """The error for a file of a model that is not as it was written.

    Args:
        where: The file, as the user may call it.
        what: What is wrong with it, to follow that.
    """
    return FormatError(f"{where} {what}; export or download the model again.")


def plain_entry(name: str) -> zipfile.ZipInfo:
    """The entry of a file that is put into a zip as it is: the same at any time and anywhere."""
    entry = zipfile.ZipInfo(name, _EPOCH)
    entry.create_system = 3  # the same bytes on every system
    entry.external_attr = 0o644 << 16
    return entry
