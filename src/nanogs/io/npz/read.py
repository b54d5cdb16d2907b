"""Reading `.npz`, the arrays of a model for NumPy; nothing in the file is ever executed.

A zip archive of `.npy` arrays, as `numpy.savez` writes it and `numpy.load` reads it with
`allow_pickle=False`: `means`, `log_scales`, `quats` (wxyz), `opacity_logits` and `sh` (N, K, 3)
with the shapes and types of `Splats`, `render_mode` as a text, and each extra column as
`extra:<name>`. Members may be stored or deflated; their checksums are verified.

Layouts: https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html and APPNOTE.TXT of
PKWARE. The `.npy` header is matched by a pattern, not evaluated as NumPy does, because only simple
types are stored.
"""

import math
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from nanogs._types import Array
from nanogs.errors import FormatError, ModelError
from nanogs.io.files import check_expansion, input_size, unreadable
from nanogs.io.info import FileInfo
from nanogs.io.parts import Column, ColumnReader, Packed
from nanogs.io.ply.header import TYPE_NAMES
from nanogs.io.texts import printable, reason
from nanogs.splats import RenderMode, Splats

REQUIRED = ("means", "log_scales", "quats", "opacity_logits", "sh")
MODE, EXTRA, ARRAY = "render_mode", "extra:", ".npy"
SIMPLE = re.compile(r"[<>|][biufcSUmM][0-9]{1,9}(\[[0-9]{0,9}[A-Za-z]{1,2}\])?")
_MAGIC = b"\x93NUMPY"
_HEADER = re.compile(
    r"\{'descr': '([^'\\]{2,40})', 'fortran_order': (True|False),"
    r" 'shape': \(([0-9, ]{0,80})\), \}\s*"
)
_PIECE = 1 << 20  # bytes read at a time; at least one row
_ZIP_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    RuntimeError,  # an encrypted member, or a way of packing that is not known
    ValueError,
    OverflowError,
)


@dataclass(frozen=True, slots=True)
class _Member:
    """An array of the archive, whose header has been checked against its size.

    Attributes:
        info: Its entry in the archive.
        dtype: Its type.
        shape: Its shape.
        fortran: Whether it is stored in Fortran order.
        start: Bytes of the `.npy` header, after which the data begins.
    """

    info: zipfile.ZipInfo
    dtype: np.dtype[np.generic]
    shape: tuple[int, ...]
    fortran: bool
    start: int

    @property
    def data_bytes(self) -> int:
        """Size of the data in bytes, without the header."""
        return self.info.file_size - self.start

    @property
    def zero(self) -> Array:
        """A zero of the array's type, in native byte order."""
        return np.zeros((), self.dtype.newbyteorder("="))


class NpzFile(Packed):
    """The source of an `.npz` file: a model saved by nanogs, or arrays of the same names and types.

    Raises:
        FormatError: The file cannot be read, is damaged, or its arrays are no model.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        with _opened(path) as archive:
            members = _members(path, archive)
            mode = _loaded(archive, members[MODE]) if MODE in members else None
        self._mode = RenderMode.DEFAULT if mode is None else _mode(path, mode)
        self._arrays = {n: m for n, m in members.items() if n in REQUIRED or n.startswith(EXTRA)}
        unknown = [printable(name) for name in members if name not in {*self._arrays, MODE}]
        note = f"Arrays nanogs does not know were left out: {', '.join(unknown)}."
        self._notes = [note] * any(unknown)
        # Arrays in Fortran order are held whole; of others, pieces and buffers.
        by_column = (m.data_bytes for m in self._arrays.values() if m.fortran)
        self.memory = (8 << 20) + 2 * max(by_column, default=0)
        self.stored = {name: Column(m.dtype.str, m.shape) for name, m in self._arrays.items()}
        # Checks shapes and types without reading data: each array is a broadcast zero.
        whole = self._model({n: np.broadcast_to(m.zero, m.shape) for n, m in self._arrays.items()})
        self.info = FileInfo(
            path=path,
            format="npz",
            encoding="zip",
            file_bytes=input_size(path),
            splats=len(whole),
            sh_degree=whole.sh_degree,
            double_means=whole.means.dtype == np.float64,
            properties=tuple(
                (name.removeprefix(EXTRA), TYPE_NAMES.get(m.dtype.str[1:], m.dtype.str))
                for name, m in self._arrays.items()
            ),
            extras=tuple(whole.extras),
            render_mode=self._mode,
            render_tag="" if mode is None else f"its array {MODE}",
        )

    def unpack(self, _notes: list[str]) -> Iterator[Array]:
        """Yield all arrays decompressed, in rows; see `Packed`."""
        with _opened(self.path) as archive:
            for member in self._arrays.values():
                if member.fortran:
                    yield _loaded(archive, member).astype(member.dtype)
                else:
                    yield from _pieces(archive, member)

    def decode(self, columns: ColumnReader, start: int, stop: int) -> Splats:
        """Decode rows `start` to `stop`; see `Packed`."""
        return self._model({name: _native(columns(name, start, stop)) for name in self._arrays})

    def _model(self, arrays: Mapping[str, Array]) -> Splats:
        """Make a model from the same rows of all arrays."""
        own: dict[str, Any] = {name: arrays[name] for name in REQUIRED}
        extras = {n.removeprefix(EXTRA): a for n, a in arrays.items() if n not in REQUIRED}
        try:
            _check_types(own)
            return Splats(**own, extras=extras, render_mode=self._mode, notes=self._notes)
        except ModelError as error:
            raise FormatError(f"{self.path}: {error} Save the arrays that way.") from None


def _check_types(arrays: dict[str, Any]) -> None:
    """Refuse arrays of other types than float32, or float64 for centres.

    `Splats` would convert them, but blocks of a file are read by the types that the file states.
    """
    for name, array in arrays.items():
        double = name == "means" and array.dtype == np.float64
        if array.dtype != np.float32 and not double:
            raise ModelError(f"{name} must be an array of float32, not of {array.dtype}.")


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open the archive for a `with` block; errors of a damaged one become `FormatError`."""
    input_size(path)
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except _ZIP_ERRORS as error:
        raise FormatError(
            f"{path} is damaged ({reason(error)}); save or download it again."
        ) from None
    except OSError as error:
        raise unreadable(path, error) from error


def _members(path: Path, archive: zipfile.ZipFile) -> dict[str, _Member]:
    """Return the arrays of the archive by name, after checking their declared sizes."""
    infos = [info for info in archive.infolist() if info.filename.endswith(ARRAY)]
    names = [info.filename.removesuffix(ARRAY) for info in infos]
    if missing := [name for name in REQUIRED if name not in names]:
        raise FormatError(
            f"{path} lacks the arrays {', '.join(missing)}, so it is no model; export one."
        )
    packed = sum(info.compress_size for info in infos)
    if len(set(names)) < len(names) or packed > input_size(path):
        raise FormatError(f"{path} holds arrays that overlap; save it again.")
    check_expansion(str(path), sum(info.file_size for info in infos), input_size(path))
    members = {n: _member(path, archive, info) for n, info in zip(names, infos, strict=True)}
    if 0 in members["means"].shape[:1] or any(not members[name].shape for name in REQUIRED):
        raise FormatError(f"{path} holds no splats; export a model with splats.")
    return members


def _member(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> _Member:
    where = f"{path}: array {printable(info.filename)!r}"
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise FormatError(f"{where} is packed in a way that NumPy never uses; save it again.")
    with archive.open(info) as file:
        dtype, shape, fortran, start = _parse(where, file)
    member = _Member(info, dtype, shape, fortran, start)
    if member.data_bytes != math.prod(shape) * dtype.itemsize:
        raise FormatError(f"{where} does not have the size that its header states; save it again.")
    return member


def _parse(where: str, file: IO[bytes]) -> tuple[np.dtype[np.generic], tuple[int, ...], bool, int]:
    """Parse the header of an array: its type, shape, whether in Fortran order, and header size."""
    start = file.read(8)
    width = 2 if start[6:7] == b"\x01" else 4
    size = int.from_bytes(file.read(width), "little")
    text = file.read(min(size, 1 << 12)).decode("latin-1")
    match = _HEADER.fullmatch(text)
    if not start.startswith(_MAGIC) or match is None or not SIMPLE.fullmatch(match[1]):
        raise FormatError(f"{where} is no plain array of numbers; save it as one.")
    try:
        dtype = np.dtype(match[1])
        shape = tuple(int(part) for part in match[3].split(",") if part.strip())
        np.broadcast_to(np.zeros((), dtype), shape)  # raises for what no array can have
    except (TypeError, ValueError):
        raise FormatError(f"{where} has an unknown type or shape; save it again.") from None
    return dtype, shape, match[2] == "True", 8 + width + size


def _loaded(archive: zipfile.ZipFile, member: _Member) -> Array:
    """Load an array in native byte order; memory grows with the data that is really there."""
    out = bytearray()
    with archive.open(member.info) as file:
        file.read(member.start)
        while piece := file.read(_PIECE):
            out += piece
    if len(out) != member.data_bytes:
        raise EOFError("an array is cut short")
    flat = np.frombuffer(out, member.dtype)
    shaped = flat.reshape(member.shape, order="F" if member.fortran else "C")
    return np.ascontiguousarray(shaped, member.dtype.newbyteorder("=")).reshape(member.shape)


def _mode(path: Path, stored: Array) -> RenderMode:
    try:
        return RenderMode(str(stored.item()))
    except ValueError:
        known = ", ".join(RenderMode)
        raise FormatError(f"{path}: its render_mode is none of {known}; save it again.") from None


def _pieces(archive: zipfile.ZipFile, member: _Member) -> Iterator[Array]:
    """Yield the rows of an array in pieces, in the byte order of the file."""
    row = np.dtype((member.dtype, member.shape[1:])).itemsize
    step = max(_PIECE // max(row, 1), 1)
    with archive.open(member.info) as file:
        file.read(member.start)
        for start in range(0, member.shape[0], step):
            rows = min(step, member.shape[0] - start)
            data = file.read(rows * row)
            if len(data) < rows * row:
                raise EOFError("an array is cut short")
            yield np.frombuffer(data, member.dtype).reshape(rows, *member.shape[1:])
        file.read(1)  # reaches the end, where the checksum is verified, in any version of zlib


def _native(array: Array) -> Array:
    """Convert an array to native byte order, in place."""
    if array.dtype.isnative:
        return array
    return array.byteswap(inplace=True).view(array.dtype.newbyteorder("="))
