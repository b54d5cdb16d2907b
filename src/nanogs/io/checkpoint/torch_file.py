"""Reading tensors from a file of `torch.save` without PyTorch; `torch_pickle` reads its pickles.

Since PyTorch 1.6 such a file is a zip: `<name>/data.pkl`, a pickle of the saved object, and
`<name>/data/<key>`, the storages of which its tensors are views. The legacy format, which can still
be requested, is five pickles one after another (a magic number, a version, facts about the system,
the object, the keys of the storages), followed by the storages: each an 8-byte count and its
numbers.

Layout: https://github.com/pytorch/pytorch, torch/serialization.py.
"""

import math
import pickle
import struct
import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, NoReturn

import numpy as np

from nanogs._types import Array
from nanogs.errors import FormatError
from nanogs.io.checkpoint.torch_pickle import Storage, Tensor, end_of_pickle, unpickled
from nanogs.io.files import input_size, reading
from nanogs.io.texts import printable, reason

# An unpickled object takes up to 72 times its bytes in the pickle; a tensor has 130 bytes there,
# and a model has some ten tensors.
_MAX_PICKLE = 1 << 21
_LEGACY_MAGIC, _LEGACY_VERSION = 0x1950A86A20F9469CFC6C, 1001
PICKLE = "data.pkl"
LEGACY_START = b"\x80\x02\x8a\nl\xfc\x9cF"
_COUNT = struct.Struct("<q")
_DAMAGE = (
    OSError,
    zipfile.BadZipFile,
    NotImplementedError,
    RuntimeError,  # an encrypted member, or a pickle nested too deeply
    pickle.UnpicklingError,
    EOFError,
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    struct.error,
    TypeError,
    ValueError,
)


class TorchFile:
    """A file of `torch.save`.

    Attributes:
        content: The saved object: dictionaries, lists and numbers, with a `Tensor` for each tensor.
        encoding: `zip`, or for the legacy format `binary_little_endian` or `binary_big_endian`.

    Raises:
        FormatError: It is no such file, is damaged, or its pickle refers to unexpected code.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file_bytes = input_size(path)
        with reading(path) as file:
            start = file.read(len(LEGACY_START))
        if not start.startswith((b"PK\x03\x04", LEGACY_START)):
            raise FormatError(
                f"{path} begins neither like a zip file nor like an old file of torch.save; give"
                " the checkpoint itself."
            )
        try:
            kind: type[_Zip | _Legacy] = _Zip if start.startswith(b"PK") else _Legacy
            with warnings.catch_warnings():  # on invalid escapes in texts of damaged pickles
                warnings.simplefilter("ignore")
                self._file = kind(path, self.file_bytes)
        except _DAMAGE as error:
            self._damaged(error)
        self.content, self.encoding = self._file.content, self._file.encoding

    def array(self, tensor: Tensor) -> Array:
        """Read the values of a tensor; bfloat16 becomes float32.

        Raises:
            FormatError: As for `check`, or its storage is missing or too short.
        """
        kind = tensor.storage.kind
        dtype = _dtype(kind).newbyteorder(self._file.order)
        self.check(tensor)
        try:
            data = self._file.numbers(tensor.storage, tensor.storage.size * dtype.itemsize)
            numbers = np.frombuffer(data, dtype, tensor.storage.size)[tensor.offset :]
            numbers = _strided(numbers, tensor.shape, tensor.strides)
        except _DAMAGE as error:
            self._damaged(error)
        if kind == "bf":
            return (numbers.astype("<u4") << 16).view("<f4")
        return np.array(numbers, np.dtype(kind))

    def check(self, tensor: Tensor) -> None:
        """Check that a tensor fits its storage, and the storage the file; no values are read.

        Raises:
            FormatError: It has elements outside its storage, or more elements than that, or the
                storage is larger than the file.
        """
        bytes_ = tensor.storage.size * _dtype(tensor.storage.kind).itemsize
        if bytes_ > self.file_bytes:
            self._damaged(EOFError(f"a storage of {bytes_} bytes"))
        spans = zip(tensor.shape, tensor.strides, strict=True)
        last = tensor.offset + sum((size - 1) * step for size, step in spans)
        count = math.prod(tensor.shape)
        if count and (last >= tensor.storage.size or count > tensor.storage.size):
            raise FormatError(
                f"{self.path}: a tensor of {tensor.shape} does not fit its {tensor.storage.size}"
                " numbers; save the checkpoint again."
            )

    def _damaged(self, error: Exception) -> NoReturn:
        raise FormatError(
            f"{self.path} is damaged or no file of torch.save ({reason(error)}); save it again."
        ) from error


def _strided(numbers: Array, shape: tuple[int, ...], strides: tuple[int, ...]) -> Array:
    """View numbers as a tensor, whose strides count numbers; it must fit them."""
    if 0 in shape:
        return numbers[:0].reshape(shape)
    steps = [step * numbers.itemsize for step in strides]
    return np.lib.stride_tricks.as_strided(numbers, shape, steps, writeable=False)


def _dtype(kind: str) -> "np.dtype[Any]":
    return np.dtype("u2" if kind == "bf" else kind)


class _Zip:
    """The zip format, since PyTorch 1.6."""

    encoding = "zip"

    def __init__(self, path: Path, _size: int) -> None:
        self._path = path
        with zipfile.ZipFile(path) as archive:
            self._members = {info.filename: info for info in archive.infolist()}
            self._root = self._find_root()
            self.order = self._byte_order(archive)
            data = self._read(archive, PICKLE, _MAX_PICKLE)
        self.content = unpickled(data, path)

    def numbers(self, storage: Storage, size: int) -> bytes:
        """Read the bytes of a storage, and refuse more than `size`."""
        with zipfile.ZipFile(self._path) as archive:
            return self._read(archive, f"data/{storage.key}", size)

    def _find_root(self) -> str:
        found = [name for name in self._members if name.endswith(f"/{PICKLE}")]
        if len(found) != 1:
            raise FormatError(
                f"{self._path} holds no data.pkl, so it is no file of torch.save; give the"
                " checkpoint itself."
            )
        return found[0].removesuffix(PICKLE)

    def _byte_order(self, archive: zipfile.ZipFile) -> Literal["<", ">"]:
        if f"{self._root}byteorder" not in self._members:
            return "<"
        return ">" if self._read(archive, "byteorder", 8) == b"big" else "<"

    def _read(self, archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
        info = self._members[self._root + name]
        if info.file_size > limit or info.compress_type != zipfile.ZIP_STORED:
            raise ValueError(f"{printable(name)} is packed or has {info.file_size} bytes")
        return archive.read(info)


class _Legacy:
    """The legacy format: pickles and storages one after another."""

    def __init__(self, path: Path, size: int) -> None:
        self._path = path
        with path.open("rb") as file:
            data = file.read(_MAX_PICKLE)
        magic, at = self._next(data, 0)
        version, at = self._next(data, at)
        if (magic, version) != (_LEGACY_MAGIC, _LEGACY_VERSION):
            raise ValueError(f"version {version}")
        system, at = self._next(data, at)
        self.order: Literal["<", ">"] = "<" if system.get("little_endian", True) else ">"
        self.encoding = f"binary_{'little' if self.order == '<' else 'big'}_endian"
        storages: dict[str, Storage] = {}
        self.content, at = self._next(data, at, storages)
        keys, at = self._next(data, at)
        kinds = {key: storage.kind for key, storage in storages.items()}
        self._places = dict(self._located(keys, kinds, at, size))

    def numbers(self, storage: Storage, size: int) -> bytes:
        """Read at most `size` bytes of a storage."""
        start, count = self._places[storage.key]
        if count != storage.size:
            raise ValueError(f"a storage of {count} numbers in place of {storage.size}")
        with self._path.open("rb") as file:
            file.seek(start)
            return file.read(size)

    def _next(
        self, data: bytes, start: int, storages: dict[str, Storage] | None = None
    ) -> tuple[Any, int]:
        """Read the pickle at an offset; return its object and the offset after it."""
        end = end_of_pickle(data, start)
        return unpickled(data[start:end], self._path, storages), end

    def _located(
        self, keys: list[str], kinds: dict[str, str], at: int, size: int
    ) -> Iterator[tuple[str, tuple[int, int]]]:
        """Yield the key of each storage with its byte offset and its count of numbers."""
        with self._path.open("rb") as file:
            for key in keys:
                file.seek(at)
                (count,) = _COUNT.unpack(file.read(_COUNT.size))
                at += _COUNT.size
                end = at + count * _dtype(kinds[key]).itemsize
                if not at <= end <= size:
                    raise ValueError(f"a storage of {count} numbers ends behind the file")
                yield key, (at, count)
                at = end
