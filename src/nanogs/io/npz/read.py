"""`.npz`: the arrays of a model as they are, for NumPy; nothing in the file is ever executed.

A zip archive of `.npy` arrays, as `numpy.savez` writes it and `numpy.load` reads it with
`allow_pickle=False`: `means`, `log_scales`, `quats` (wxyz), `opacity_logits` and `sh` (N, K, 3)
with the shapes and types of `Splats`, `render_mode` as a text, and each further column as
`extra:<name>`. The same model gives the same bytes: members are stored, without their time.

Layouts: https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html and APPNOTE.TXT of
PKWARE. The `.npy` header is matched, not evaluated as NumPy does: simple types are all we store.
"""

import math
import re
import struct
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np

from nanogs._types import Array
from nanogs.errors import FormatError, ModelError, OutputError
from nanogs.io import limits
from nanogs.io.by_column import encoded_columns
from nanogs.io.files import check_expansion, input_size, unreadable
from nanogs.io.info import FileInfo
from nanogs.io.ply.header import TYPE_NAMES, printable
from nanogs.source import Source, source_of
from nanogs.splats import RenderMode, Splats

_SUFFIX = ".npz"
_REQUIRED = ("means", "log_scales", "quats", "opacity_logits", "sh")
MODE, _EXTRA = "render_mode", "extra:"
_ARRAY = ".npy"
_MAGIC = b"\x93NUMPY"
_HEADER = re.compile(
    r"\{'descr': '([^'\\]{2,40})', 'fortran_order': (True|False),"
    r" 'shape': \(([0-9, ]{0,80})\), \}\s*"
)
_SIMPLE = re.compile(r"[<>|][biufcSUmM][0-9]{1,9}(\[[0-9]{0,9}[A-Za-z]{1,2}\])?")
_CHUNK = 1 << 20
_ZIP_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    NotImplementedError,  # an unknown kind of compression
    RuntimeError,  # an encrypted member
    ValueError,
    OverflowError,
)


@dataclass(frozen=True, slots=True)
class Member:
    """One array of the archive, its header checked against its size."""

    info: zipfile.ZipInfo
    dtype: np.dtype[np.generic]
    shape: tuple[int, ...]
    fortran: bool
    start: int

    @property
    def data_bytes(self) -> int:
        """Its size, the header aside."""
        return self.info.file_size - self.start


def read(path: Path) -> Splats:
    """Read arrays that do not lie row after row, see `packed`.

    Raises:
        FormatError: The file cannot be read, is damaged, or its arrays are no model.
    """
    with opened(path) as archive:
        members = members_of(path, archive)
        arrays: dict[str, Any] = {
            name: load_array(archive, member) for name, member in members.items() if ours(name)
        }
    return model_of(path, arrays, members)


def model_of(path: Path, arrays: dict[str, Any], names: Iterable[str]) -> Splats:
    """The model that arrays make.

    Args:
        path: The file, for the message.
        arrays: Those that nanogs knows, by name.
        names: Of all arrays of the file.

    Raises:
        FormatError: They make none.
    """
    arrays = dict(arrays)
    mode = arrays.pop(MODE, np.array(RenderMode.DEFAULT.value))
    extras = {n.removeprefix(_EXTRA): arrays.pop(n) for n in [*arrays] if n.startswith(_EXTRA)}
    unknown = [printable(name) for name in names if not ours(name)]
    notes = [f"Arrays nanogs does not know were left out: {', '.join(unknown)}."] if unknown else []
    try:
        _check_types(arrays)
        return Splats(**arrays, extras=extras, render_mode=_mode(path, mode), notes=notes)
    except ModelError as error:
        raise FormatError(f"{path}: {error} Save the arrays that way.") from None


def _check_types(arrays: dict[str, Any]) -> None:
    """`Splats` would convert them, but a file is read in blocks by the types that it states."""
    for name, array in arrays.items():
        double = name == "means" and array.dtype == np.float64
        if array.dtype != np.float32 and not double:
            raise ModelError(f"{name} must be an array of float32, not of {array.dtype}.")


def inspect(path: Path) -> FileInfo:
    """Describe a `.npz` file from the headers of its arrays.

    Raises:
        FormatError: As for `read`, except for what only the arrays show.
    """
    with opened(path) as archive:
        members = members_of(path, archive)
        mode = load_array(archive, members[MODE]) if MODE in members else None
    means, sh = members["means"], members["sh"]
    coefficients = sh.shape[1] if len(sh.shape) == 3 else 0
    return FileInfo(
        path=path,
        format="npz",
        encoding="zip",
        file_bytes=input_size(path),
        splats=means.shape[0] if means.shape else 0,
        sh_degree=math.isqrt(max(coefficients, 1)) - 1,
        double_means=means.dtype == np.float64,
        properties=tuple(
            (name.removeprefix(_EXTRA), TYPE_NAMES.get(m.dtype.str[1:], m.dtype.str))
            for name, m in members.items()
            if ours(name) and name != MODE
        ),
        extras=tuple(n.removeprefix(_EXTRA) for n in members if n.startswith(_EXTRA)),
        elements=(),
        render_mode=RenderMode.DEFAULT if mode is None else _mode(path, mode),
        comments=(),
    )


def write(model: Splats | Source, file: BinaryIO) -> None:
    """Write a model, no more than some rows of it held; comments and further elements stay behind.

    Raises:
        OutputError: An extra column's name or type does not go into such a file; nothing has been
            written then.
        OSError: The system refuses to write.
    """
    source = source_of(model)
    arrays = _arrays(source.read(0, min(source.count, 1)))
    names = [name for name in arrays if name != MODE]
    columns = encoded_columns(source, [partial(_column, name) for name in names])
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            info = zipfile.ZipInfo(name + _ARRAY)  # of 1980, whatever the clock says
            info.create_system, info.external_attr = 3, 0o600 << 16
            shape = (source.count, *array.shape[1:]) if name != MODE else ()
            with archive.open(info, "w", force_zip64=True) as member:
                member.write(_header(array, shape))
                for piece in [array.tobytes()] if name == MODE else next(columns):
                    member.write(piece)


def _column(name: str, block: Splats) -> Array:
    """The rows of an array of the file, by its name."""
    extra = name.removeprefix(_EXTRA)
    column: Array = getattr(block, name) if extra == name else block.extras[extra]
    return column


def file_bytes(splats: Splats, count: int) -> int:
    """Bytes of the file of a model of `count` splats; from 2 GiB on a few bytes too many.

    Raises:
        OutputError: As for `write`.
    """
    total = 22  # the end of the directory
    for name, array in _arrays(splats).items():
        shape = (count, *array.shape[1:]) if array.ndim else ()
        data = len(_header(array, shape)) + array.itemsize * math.prod(shape)
        total += data + 30 + 20 + 46 + 2 * len((name + _ARRAY).encode())
        total += 28 if total > zipfile.ZIP64_LIMIT else 0
    return total + (76 if total > zipfile.ZIP64_LIMIT else 0)


def losses(splats: Splats) -> tuple[str, ...]:
    """Name what the file leaves out, one sentence each."""
    return tuple(limits.left_out(splats, _SUFFIX, extras=False))


def ours(name: str) -> bool:
    """Whether nanogs knows an array of that name."""
    return name in (*_REQUIRED, MODE) or name.startswith(_EXTRA)


def _arrays(splats: Splats) -> dict[str, Array]:
    """Every array of the file by name, in the order they are written."""
    arrays: dict[str, Array] = {name: getattr(splats, name) for name in _REQUIRED}
    arrays[MODE] = np.array(splats.render_mode.value)
    for name, column in splats.extras.items():
        if not _SIMPLE.fullmatch(column.dtype.str):
            raise OutputError(
                f"Extra column {name[:40]!r} is {column.dtype}, which {_SUFFIX} cannot hold without"
                " pickling it; convert it to numbers or text."
            )
        if not _storable(name):
            raise OutputError(f"A {_SUFFIX} file cannot hold the name {name[:40]!r}; rename it.")
        arrays[_EXTRA + name] = column
    return arrays


def _storable(name: str) -> bool:
    try:
        encoded = name.encode()
    except UnicodeEncodeError:
        return False
    return not {"\0", "\\"} & set(name) and len(encoded) < 1 << 15


def _header(array: Array, shape: tuple[int, ...]) -> bytes:
    """The `.npy` header of an array like this one, of that shape."""
    import io

    out = io.BytesIO()
    fields = {**np.lib.format.header_data_from_array_1_0(array), "shape": shape}
    np.lib.format.write_array_header_1_0(out, fields)
    return out.getvalue()


@contextmanager
def opened(path: Path) -> Iterator[zipfile.ZipFile]:
    """The archive, with everything that reading a damaged one may raise as a `FormatError`.

    Raises:
        FormatError: As said.
    """
    input_size(path)
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except _ZIP_ERRORS as error:
        raise FormatError(f"{path} is damaged ({error}); save or download it again.") from None
    except OSError as error:
        raise unreadable(path, error) from error


def members_of(path: Path, archive: zipfile.ZipFile) -> dict[str, Member]:
    """The arrays of the archive by name, once their declared sizes make sense.

    Raises:
        FormatError: They do not, or an array that is needed is missing.
    """
    infos = [info for info in archive.infolist() if info.filename.endswith(_ARRAY)]
    names = [info.filename.removesuffix(_ARRAY) for info in infos]
    if missing := [name for name in _REQUIRED if name not in names]:
        raise FormatError(
            f"{path} lacks the arrays {', '.join(missing)}, so it is no model; export one."
        )
    packed = sum(info.compress_size for info in infos)
    if len(set(names)) < len(names) or packed > input_size(path):
        raise FormatError(f"{path} holds arrays that overlap; save it again.")
    check_expansion(str(path), sum(info.file_size for info in infos), input_size(path))
    members = {n: _member(path, archive, info) for n, info in zip(names, infos, strict=True)}
    if 0 in members["means"].shape[:1] or any(not members[name].shape for name in _REQUIRED):
        raise FormatError(f"{path} holds no splats; export a model with splats.")
    return members


def _member(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> Member:
    where = f"{path}: array {printable(info.filename)!r}"
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise FormatError(f"{where} is packed in a way NumPy never does; save it again.")
    with archive.open(info) as file:
        dtype, shape, fortran, start = _parse(where, file)
    member = Member(info, dtype, shape, fortran, start)
    if member.data_bytes != math.prod(shape) * dtype.itemsize:
        raise FormatError(f"{where} has not the size its header states; save it again.")
    return member


def _parse(where: str, file: IO[bytes]) -> tuple[np.dtype[np.generic], tuple[int, ...], bool, int]:
    """Type, shape, whether in Fortran's order, and length of the header of an array."""
    start = file.read(8)
    width = 2 if start[6:7] == b"\x01" else 4
    size = int.from_bytes(file.read(width), "little")
    text = file.read(min(size, 1 << 12)).decode("latin-1")
    match = _HEADER.fullmatch(text)
    if not start.startswith(_MAGIC) or match is None or not _SIMPLE.fullmatch(match[1]):
        raise FormatError(f"{where} is no plain array of numbers; save it as one.")
    try:
        dtype = np.dtype(match[1])
        shape = tuple(int(part) for part in match[3].split(",") if part.strip())
    except (TypeError, ValueError):
        raise FormatError(f"{where} is of unknown type or shape; save it again.") from None
    return dtype, shape, match[2] == "True", 8 + width + size


def load_array(archive: zipfile.ZipFile, member: Member) -> Array:
    """The array in native byte order; memory grows with what the file really holds.

    Raises:
        EOFError: It is cut short.
    """
    out = bytearray()
    with archive.open(member.info) as file:
        file.read(member.start)
        while piece := file.read(_CHUNK):
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
