"""Writing `.npz`; the layout is described in `read`.

The same model gives the same bytes: members are stored without compression and without timestamps.
"""

import io
import math
import zipfile
from functools import partial
from typing import Any, BinaryIO

import numpy as np

from nanogs._types import Array
from nanogs.errors import OutputError
from nanogs.io import limits
from nanogs.io.by_column import encoded_columns
from nanogs.io.npz.read import ARRAY, EXTRA, MODE, REQUIRED, SIMPLE
from nanogs.source import Layout, Source, source_of
from nanogs.splats import Splats

_SUFFIX = ".npz"


def write(model: Splats | Source, file: BinaryIO) -> None:
    """Write a model, holding only some rows in memory; comments and extra elements are dropped.

    Raises:
        OutputError: There is no splat, or the file cannot hold an extra column's name or type;
            nothing has been written then.
        OSError: The system refuses to write.
    """
    source = source_of(model)
    limits.refuse_empty(source, _SUFFIX)
    arrays = _arrays(source.read(0, 1))
    names = [name for name in arrays if name != MODE]
    columns = encoded_columns(source, [partial(_column, name) for name in names])
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            info = zipfile.ZipInfo(name + ARRAY)  # dated 1980 by default, for equal bytes
            info.create_system, info.external_attr = 3, 0o600 << 16
            shape = (source.count, *array.shape[1:]) if name != MODE else ()
            with archive.open(info, "w", force_zip64=True) as member:
                member.write(_header(array, shape))
                for piece in [array.tobytes()] if name == MODE else next(columns):
                    member.write(piece)


def _column(name: str, block: Splats) -> Array:
    """Return the rows of a block for an array of the file, by its name."""
    extra = name.removeprefix(EXTRA)
    column: Array = getattr(block, name) if extra == name else block.extras[extra]
    return column


def file_bytes(splats: Splats, count: int) -> int:
    """Return the file size in bytes for `count` splats; from 2 GiB on, a few bytes too many.

    Raises:
        OutputError: As for `write`.
    """
    total = 22  # the end of the directory
    for name, array in _arrays(splats).items():
        shape = (count, *array.shape[1:]) if array.ndim else ()
        data = len(_header(array, shape)) + array.itemsize * math.prod(shape)
        total += data + 30 + 20 + 46 + 2 * len((name + ARRAY).encode())
        total += 28 if total > zipfile.ZIP64_LIMIT else 0
    return total + (76 if total > zipfile.ZIP64_LIMIT else 0)


def losses(splats: Splats) -> tuple[str, ...]:
    """Name what the file leaves out, one sentence each."""
    return tuple(limits.left_out(splats, _SUFFIX, extras=False))


def _arrays(splats: Splats) -> dict[str, Array]:
    """Return all arrays of the file by name, in the order they are written."""
    arrays: dict[str, Array] = {name: getattr(splats, name) for name in REQUIRED}
    arrays[MODE] = np.array(splats.render_mode.value)
    for name, column in splats.extras.items():
        _check_column(name, column.dtype)
        arrays[EXTRA + name] = column
    return arrays


def check_columns(layout: Layout) -> None:
    """Refuse extra columns whose type or name the file cannot hold.

    Args:
        layout: The columns of a model.

    Raises:
        OutputError: There is one.
    """
    for name, code in layout.extras:
        _check_column(name, np.dtype(code))


def _check_column(name: str, dtype: "np.dtype[Any]") -> None:
    if not SIMPLE.fullmatch(dtype.str):
        raise OutputError(
            f"Extra column {name[:40]!r} is {dtype}, which {_SUFFIX} cannot hold without pickling"
            " it; convert it to numbers or text."
        )
    if not _storable(name):
        raise OutputError(f"A {_SUFFIX} file cannot hold the name {name[:40]!r}; rename it.")


def _storable(name: str) -> bool:
    try:
        encoded = name.encode()
    except UnicodeEncodeError:
        return False
    return not {"\0", "\\"} & set(name) and len(encoded) < 1 << 15


def _header(array: Array, shape: tuple[int, ...]) -> bytes:
    """Return the `.npy` header of an array like this one but of the given shape."""
    out = io.BytesIO()
    fields = {**np.lib.format.header_data_from_array_1_0(array), "shape": shape}
    np.lib.format.write_array_header_1_0(out, fields)
    return out.getvalue()
