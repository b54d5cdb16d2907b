"""Access to the files of a SOG model, in a folder or in a zip; each is read only on request."""

import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

from nanogs.errors import FormatError
from nanogs.io.files import input_size, reading
from nanogs.io.json_fields import refused
from nanogs.io.texts import reason

_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 0x1
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest time that a zip can store
_DAMAGE = (OSError, EOFError, ValueError, NotImplementedError, zipfile.BadZipFile, zlib.error)


class Folder:
    """The files of a model in a folder, accessed by plain name."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def where(self, name: str) -> str:
        """Return the path of a file for messages."""
        return str(self._path / name)

    def size(self, name: str) -> int:
        """Return the uncompressed size of a file in bytes.

        Raises:
            FormatError: There is no such file, or it is no regular one.
        """
        return input_size(self._path / name)

    def bytes_on_disk(self, names: Iterable[str]) -> int:
        """Return the stored size of the files in bytes, with that of the container around them.

        Raises:
            FormatError: As for `size`.
        """
        return sum(map(self.size, names))

    def read(self, name: str, limit: int) -> bytes:
        """Read the first `limit` bytes of a file, or all of it if it is shorter.

        Raises:
            FormatError: As for `size`, or the file cannot be read.
        """
        self.size(name)
        with reading(self._path / name) as file:
            return file.read(limit)


class Bundle(Folder):
    """The files of a model in a zip, or in a folder inside a zip, accessed by plain name.

    Args:
        path: The zip, for messages.
        file: The zip, open for reading.
        inside: The folder in the zip, with a slash at its end; empty for the root of the zip.

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
        """Return the path of the zip and the name of a file in it, for messages."""
        return f"{self._path}: {self._inside}{name}"

    def size(self, name: str) -> int:
        """Return the uncompressed size of a file that the zip states, in bytes; see `Folder`."""
        return self._entry(name).file_size

    def bytes_on_disk(self, names: Iterable[str]) -> int:
        """Return the size of the whole zip in bytes; for a folder in it, of the files alone.

        The files must be there.
        """
        packed = sum(self._entry(name).compress_size for name in names)
        return packed if self._inside else input_size(self._path)

    def read(self, name: str, limit: int) -> bytes:
        """Read the first `limit` bytes of a file; reading all of it checks its checksum."""
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
            raise self._error(name, "is encrypted or compressed by another method than deflate")
        return entry

    def _error(self, name: str, what: str) -> FormatError:
        return refused(self.where(name), what)


def plain_entry(name: str) -> zipfile.ZipInfo:
    """Return the zip entry of an uncompressed file, without time or system, for equal bytes."""
    entry = zipfile.ZipInfo(name, _EPOCH)
    entry.create_system = 3  # Unix: the same bytes on every system
    entry.external_attr = 0o644 << 16
    return entry
