"""Tensors from a file of `torch.save`, without PyTorch and without running what the file names.

Such a file is a zip: `<name>/data.pkl`, a pickle of the saved object, and `<name>/data/<key>`, the
storages that its tensors are parts of. A pickle can call whatever it names. Here it can name a few
things only, none of which is run: a tensor becomes a description of itself, what else PyTorch and
NumPy leave in checkpoints an empty stand-in, and any other name refuses the file.

Layout: https://github.com/pytorch/pytorch, torch/serialization.py and torch/_utils.py.
"""

import io
import math
import pickle
import pickletools
import zipfile
from collections import OrderedDict
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal, NamedTuple, NoReturn

import numpy as np

from nanogs._types import Array
from nanogs.errors import FormatError
from nanogs.io.files import input_size, unreadable
from nanogs.io.ply_header import printable

_STORAGES = {
    "FloatStorage": "f4",
    "DoubleStorage": "f8",
    "HalfStorage": "f2",
    "BFloat16Storage": "bf",
    "LongStorage": "i8",
    "IntStorage": "i4",
    "ShortStorage": "i2",
    "CharStorage": "i1",
    "ByteStorage": "u1",
    "BoolStorage": "?",
}
_STAND_INS = {
    ("torch", "Size"),
    ("torch", "device"),
    ("torch._utils", "_rebuild_qtensor"),
    *(("torch", f"{kind}{bits}") for kind in ("int", "float") for bits in (8, 16, 32, 64)),
    ("torch", "bfloat16"),
    ("torch", "bool"),
    ("torch", "uint8"),
    ("_codecs", "encode"),
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    *((f"numpy.{core}.multiarray", "scalar") for core in ("core", "_core")),
    *((f"numpy.{core}.multiarray", "_reconstruct") for core in ("core", "_core")),
}
# An object takes up to 72 times its bytes in the pickle; a tensor has 130, a model some ten.
_MAX_PICKLE = 1 << 21
_MAX_WEIGHT = 10_000_000  # objects in an object
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
    TypeError,
    ValueError,
)


class Storage(NamedTuple):  # and not a dataclass: a pickle could set the fields of one
    """Numbers of one type in a member of the zip."""

    key: str
    kind: str
    size: int


class Tensor(NamedTuple):
    """What a file says of a tensor; `TorchFile.array` reads its numbers."""

    storage: Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


class _StandIn:
    """Takes the place of an object that is of no use here; ignores all that it is given."""

    __slots__ = ()

    def __init__(self, *_given: object) -> None:
        pass

    def __setstate__(self, _state: object) -> None:
        pass


class TorchFile:
    """A file of `torch.save`.

    Attributes:
        content: The saved object: dictionaries, lists and numbers, with a `Tensor` for each tensor.

    Raises:
        FormatError: It is none, is damaged, or names code.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file_bytes = input_size(path)
        try:
            with path.open("rb") as file:
                zipped = file.read(4) == b"PK\x03\x04"
        except OSError as error:
            raise unreadable(path, error) from error
        if not zipped:
            raise FormatError(
                f"{path} is no zip file, as torch.save has written since PyTorch 1.6; load and save"
                " it again with a newer one."
            )
        try:
            with zipfile.ZipFile(path) as archive:
                self._members = {info.filename: info for info in archive.infolist()}
                self._root = self._find_root()
                self._order = self._byte_order(archive)
                data = self._read(archive, "data.pkl", _MAX_PICKLE)
            self.content = self._unpickled(data)
        except _DAMAGE as error:
            self._damaged(error)

    def array(self, tensor: Tensor) -> Array:
        """The numbers of a tensor; bfloat16 becomes float32.

        Raises:
            FormatError: Its storage is missing, or does not hold so many.
        """
        kind = tensor.storage.kind
        dtype = np.dtype("u2" if kind == "bf" else kind).newbyteorder(self._order)
        self._check(tensor)
        try:
            with zipfile.ZipFile(self.path) as archive:
                limit = tensor.storage.size * dtype.itemsize
                data = self._read(archive, f"data/{tensor.storage.key}", limit)
            numbers = np.frombuffer(data, dtype, tensor.storage.size)[tensor.offset :]
        except _DAMAGE as error:
            self._damaged(error)
        if 0 in tensor.shape:
            numbers = numbers[:0].reshape(tensor.shape)
        else:
            steps = [step * dtype.itemsize for step in tensor.strides]
            numbers = np.lib.stride_tricks.as_strided(numbers, tensor.shape, steps, writeable=False)
        if kind == "bf":
            return (numbers.astype("<u4") << 16).view("<f4")
        return np.array(numbers, np.dtype(kind))

    def _check(self, tensor: Tensor) -> None:
        """Every number must lie in the storage, and there be no more than it has."""
        spans = zip(tensor.shape, tensor.strides, strict=True)
        last = tensor.offset + sum((size - 1) * step for size, step in spans)
        count = math.prod(tensor.shape)
        if count and (last >= tensor.storage.size or count > tensor.storage.size):
            raise FormatError(
                f"{self.path}: a tensor of {tensor.shape} does not fit its {tensor.storage.size}"
                " numbers; save the checkpoint again."
            )

    def _find_root(self) -> str:
        found = [name for name in self._members if name.endswith("/data.pkl")]
        if len(found) != 1:
            raise FormatError(
                f"{self.path} holds no data.pkl, so it is no file of torch.save; give the"
                " checkpoint itself."
            )
        return found[0].removesuffix("data.pkl")

    def _byte_order(self, archive: zipfile.ZipFile) -> Literal["<", ">"]:
        if f"{self._root}byteorder" not in self._members:
            return "<"
        return ">" if self._read(archive, "byteorder", 8) == b"big" else "<"

    def _read(self, archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
        info = self._members[self._root + name]
        if info.file_size > limit or info.compress_type != zipfile.ZIP_STORED:
            raise ValueError(f"{printable(name)} is packed or has {info.file_size} bytes")
        return archive.read(info)

    def _unpickled(self, data: bytes) -> Any:  # noqa: ANN401 - whatever was saved
        _check_weights(data)
        return _Unpickler(data, self.path).load()

    def _damaged(self, error: Exception) -> NoReturn:
        reason = printable(str(error))[:120] or type(error).__name__
        raise FormatError(
            f"{self.path} is damaged or no file of torch.save ({reason}); save it again."
        ) from error


def _check_weights(data: bytes) -> None:
    """Refuse a pickle that would take far more than its bytes do: room, or time.

    The unpickler makes room for the highest place in its memo, however high it is. A tuple of two
    times one tuple, and so on, has few bytes, and hashing it takes for ever; so the stack is walked
    with the number of objects in each entry in its place, those met twice counted twice.

    Raises:
        ValueError: A place or an object is too large; LookupError if the stack runs empty.
    """
    stack: list[int | None] = []  # None is a mark
    memo: dict[int, int | None] = {}
    for opcode, argument, _ in pickletools.genops(data):
        if opcode.name.endswith("PUT") or opcode.name == "MEMOIZE":
            place = len(memo) if argument is None else int(str(argument))
            if place > len(data):
                raise ValueError(f"a place {place} in {len(data)} bytes")
            memo[place] = stack[-1]
        elif opcode.name.endswith("GET"):
            stack.append(memo[int(str(argument))])
        elif opcode.name == "MARK":
            stack.append(None)
        elif opcode.name == "DUP":
            stack.append(stack[-1])
        else:
            weight = 1 + _take(stack, [kind.name for kind in opcode.stack_before])
            if weight > _MAX_WEIGHT:
                raise ValueError("objects nested in each other many times over")
            stack += [weight] * len(opcode.stack_after)


def _take(stack: list[int | None], kinds: list[str]) -> int:
    """Take what an opcode takes from the stack; the objects in it."""
    total = 0
    if "mark" in kinds:
        while (top := stack.pop()) is not None:
            total += top
        kinds = kinds[: kinds.index("mark")]
    return total + sum(stack.pop() or 0 for _ in kinds)


class _Unpickler(pickle.Unpickler):
    """Builds descriptions, and refuses every name that is not expected."""

    def __init__(self, data: bytes, path: Path) -> None:
        super().__init__(io.BytesIO(data))
        self._path = path

    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401 - a stand-in
        if module == "torch" and name in _STORAGES:
            return name
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _TENSOR
        if (module, name) == ("torch._utils", "_rebuild_parameter"):
            return _PARAMETER
        if (module, name) in _STAND_INS:
            return _StandIn
        named = printable(f"{module}.{name}")[:80]
        raise FormatError(
            f"{self._path} names {named}, which no tensors need and which could run code of the"
            " file, so it is refused; save the state dictionary alone."
        )

    def persistent_load(self, pid: Any) -> Storage:  # noqa: ANN401 - a tuple of torch's
        _, kind, key, _, count = pid
        if not (isinstance(key, str) and isinstance(count, int)):
            raise TypeError("a storage without a name or a size")
        return Storage(key, _STORAGES[kind], count)


class _MakeTensor:
    """In place of PyTorch's function; no function of ours, whose attributes a pickle could set."""

    __slots__ = ()

    def __call__(
        self,
        storage: Storage,
        offset: int,
        shape: Iterable[int],
        strides: Iterable[int],
        *_: object,
    ) -> Tensor:
        sizes, steps = tuple(shape), tuple(strides)
        if not isinstance(storage, Storage) or len(sizes) != len(steps):
            raise TypeError("a tensor without a storage")
        if any(type(number) is not int or number < 0 for number in (offset, *sizes, *steps)):
            raise ValueError("a tensor of an impossible shape")
        return Tensor(storage, offset, sizes, steps)


class _MakeParameter:
    """A parameter is the tensor in it."""

    __slots__ = ()

    def __call__(self, tensor: Tensor, *_: object) -> Tensor:
        return tensor


_TENSOR, _PARAMETER = _MakeTensor(), _MakeParameter()
