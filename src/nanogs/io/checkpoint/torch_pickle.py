"""Reading the pickles in files of `torch.save` safely, without running code that they refer to.

A pickle can import and call any function. Here only a few names are allowed, and only `OrderedDict`
is the real one: a tensor becomes a `Tensor`, which describes it, other objects that PyTorch and
NumPy leave in checkpoints become empty placeholders, and a file with any other name is refused.

Layout: https://github.com/pytorch/pytorch, torch/serialization.py and torch/_utils.py.
"""

import io
import pickle
import pickletools
from collections import OrderedDict
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from nanogs.errors import FormatError

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
_MAX_WEIGHT = 10_000_000  # most objects nested in an object, counted with repetition


class Storage(NamedTuple):  # not a dataclass, because a pickle could set its fields
    """A PyTorch storage: its key in the file, the dtype of its numbers, and their count."""

    key: str
    kind: str
    size: int


class Tensor(NamedTuple):
    """The description of a tensor as a view of a storage; `TorchFile.array` reads its values."""

    storage: Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


class _StandIn:
    """A placeholder for an object that is not needed; it ignores its arguments and state."""

    __slots__ = ()

    def __init__(self, *_given: object) -> None:
        pass

    def __setstate__(self, _state: object) -> None:
        pass


def unpickled(data: bytes, path: Path, storages: dict[str, Storage] | None = None) -> Any:  # noqa: ANN401 - whatever was saved
    """Unpickle an object, with a `Tensor` for each tensor.

    Args:
        data: The pickle.
        path: Its file, for the message.
        storages: Filled with all storages that the pickle refers to, by their keys.

    Raises:
        FormatError: It refers to a name that is not allowed.
        Exception: Any error of `pickle` for a damaged pickle.
    """
    _check_weights(data)
    return _Unpickler(data, path, {} if storages is None else storages).load()


def end_of_pickle(data: bytes, start: int) -> int:
    """Return the byte offset after the pickle that begins at `start`.

    Raises:
        Exception: Any error of `pickletools` for a pickle that is damaged or cut short.
    """
    stream = io.BytesIO(data)
    stream.seek(start)
    for _ in pickletools.genops(stream):
        pass
    return stream.tell()


def _check_weights(data: bytes) -> None:
    """Refuse a pickle that would take far more memory or time than its size suggests.

    The unpickler allocates its memo up to the highest index, however high. A tuple that contains
    the same tuple twice, and so on, has few bytes, but hashing it takes exponential time; so the
    opcodes are run on a stack that holds, for each entry, its number of nested objects, counted
    again for each reference.

    Raises:
        ValueError: A memo index or an object is too large; LookupError if the stack runs empty.
    """
    stack: list[int | None] = []  # None for the MARK opcode
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
    """Pop the operands of an opcode from the stack, and return their number of objects."""
    total = 0
    if "mark" in kinds:
        while (top := stack.pop()) is not None:
            total += top
        kinds = kinds[: kinds.index("mark")]
    return total + sum(stack.pop() or 0 for _ in kinds)


class _Unpickler(pickle.Unpickler):
    """An unpickler that builds descriptions of tensors and refuses every unexpected name."""

    def __init__(self, data: bytes, path: Path, storages: dict[str, Storage]) -> None:
        super().__init__(io.BytesIO(data))
        self._path, self._storages = path, storages

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
        named = ascii(f"{module}.{name}")[1:-1][:80]
        raise FormatError(
            f"{self._path} refers to {named}, which tensors do not need and which could run code"
            " from the file, so nanogs refuses it; save only the state dictionary."
        )

    def persistent_load(self, pid: Any) -> Storage:  # noqa: ANN401 - a tuple of torch's
        _, kind, key, _, count = pid[:5]
        if not (isinstance(key, str) and isinstance(count, int)):
            raise TypeError("a storage without a name or a size")
        if pid[5:] not in ((), (None,)):
            raise ValueError("a storage that is part of another")
        self._storages[key] = Storage(key, _STORAGES[kind], count)
        return self._storages[key]


class _MakeTensor:
    """Replaces PyTorch's `_rebuild_tensor_v2` and returns a `Tensor`.

    It is an object with slots, because a pickle could set attributes of a plain function.
    """

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
    """Replaces PyTorch's `_rebuild_parameter` and returns the tensor of the parameter."""

    __slots__ = ()

    def __call__(self, tensor: Tensor, *_: object) -> Tensor:
        return tensor


_TENSOR, _PARAMETER = _MakeTensor(), _MakeParameter()
