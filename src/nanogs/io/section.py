"""Byte ranges of a file or of memory, for formats that are embedded in other formats."""

import io
from base64 import b64decode
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, cast

from nanogs.errors import FormatError
from nanogs.io.files import input_size


@dataclass(frozen=True, slots=True)
class Section:
    """A byte range of a file, of base64 text in a file, or of bytes decoded from a file.

    Attributes:
        path: The file, for messages too.
        start: Offset of the first byte in the file, in `data`, or in the decoded base64 text.
        size: Number of bytes.
        data: The decoded bytes, if they are not stored in the file directly.
        text: Offset in the file at which base64 text begins that encodes the bytes.
    """

    path: Path
    start: int
    size: int
    data: bytes | None = None
    text: int | None = None

    def part(self, start: int, size: int) -> "Section":
        """Return a part of this range, which must contain it; `start` is relative to this range."""
        return Section(self.path, self.start + start, size, self.data, self.text)

    @contextmanager
    def opened(self) -> Iterator[BinaryIO]:
        """Open the section as a read-only file that contains nothing else.

        Raises:
            FormatError: The base64 text that is read is invalid.
            OSError: The system refuses to read.
        """
        if self.data is not None:
            yield io.BytesIO(memoryview(self.data)[self.start : self.start + self.size])
            return
        with self.path.open("rb") as file:
            if self.text is not None:
                yield cast("BinaryIO", _Decoded(self.path, file, self.text, self.start, self.size))
                return
            yield cast("BinaryIO", _Window(file, self.start, self.size))


def whole_file(path: Path) -> Section:
    """Return the section that spans a whole file.

    Raises:
        FormatError: As for `input_size`.
    """
    return Section(path, 0, input_size(path))


class _Window(io.RawIOBase):
    """A byte range of an open file, presented as a file of its own."""

    def __init__(self, file: BinaryIO, start: int, size: int) -> None:
        self._file, self._start, self._size = file, start, size
        self._at = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        if whence != io.SEEK_SET:
            raise ValueError("only places from the start are sought")
        self._at = offset
        return offset

    def read(self, size: int = -1) -> bytes:
        left = max(self._size - self._at, 0)
        self._file.seek(self._start + self._at)
        data = self._file.read(left if size < 0 else min(size, left))
        self._at += len(data)
        return data

    def readinto(self, buffer: "memoryview") -> int:  # type: ignore[override]
        data = self.read(len(buffer))
        buffer[: len(data)] = data
        return len(data)


class _Decoded(_Window):
    """A byte range encoded as base64 text; only the parts that are read are decoded."""

    def __init__(self, path: Path, file: BinaryIO, text: int, start: int, size: int) -> None:
        super().__init__(file, start, size)
        self._path, self._text = path, text

    def read(self, size: int = -1) -> bytes:
        left = max(self._size - self._at, 0)
        wanted = left if size < 0 else min(size, left)
        first, skipped = divmod(self._start + self._at, 3)  # four characters are three bytes
        self._file.seek(self._text + 4 * first)
        text = self._file.read((skipped + wanted + 2) // 3 * 4)
        try:
            data = b64decode(text, validate=True)[skipped : skipped + wanted]
        except ValueError:
            data = b""
        if len(data) < wanted:
            raise FormatError(
                f"{self._path} holds a data: URI that is damaged; export or download it again."
            )
        self._at += len(data)
        return data
