"""`.npz` to be unpacked: its arrays as they are, deflated or not; their checksums are looked at."""

from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path

import numpy as np

from nanogs._types import Array
from nanogs.io.info import FileInfo
from nanogs.io.npz.read import (
    MODE,
    Member,
    inspect,
    load_array,
    members_of,
    model_of,
    opened,
    ours,
    read,
)
from nanogs.io.parts import Column, ColumnReader, FileSource, Packed, Whole
from nanogs.splats import Splats

_PIECE = 1 << 20  # bytes, or a row


def open_npz(path: Path) -> FileSource:
    """A model that nanogs saved, or arrays of the same names, shapes and types.

    Raises:
        FormatError: The file cannot be read, is damaged, or its arrays are no model.
    """
    with opened(path) as archive:
        members = members_of(path, archive)
        mode = load_array(archive, members[MODE]) if MODE in members else None
    arrays = {name: member for name, member in members.items() if ours(name) and name != MODE}
    counts = {member.shape[:1] for member in arrays.values()}
    if not all(map(_is_rowwise, arrays.values())) or len(counts) > 1:
        return Whole(path, inspect, read)
    found = _Arrays(path, arrays, mode, (*members,))
    found.model({name: np.empty((0, *m.shape[1:]), m.dtype) for name, m in arrays.items()})
    return found


def _is_rowwise(member: Member) -> bool:
    return bool(member.dtype.itemsize) and (len(member.shape) == 1 or not member.fortran)


class _Arrays(Packed):
    """The arrays of a model, which lie row after row, as many in each."""

    def __init__(
        self, path: Path, arrays: dict[str, Member], mode: Array | None, names: tuple[str, ...]
    ) -> None:
        super().__init__(path)
        self._arrays, self._mode, self._names = arrays, mode, names

    @cached_property
    def info(self) -> FileInfo:
        """The description, from the headers of the arrays."""
        return inspect(self.path)

    @cached_property
    def stored(self) -> Mapping[str, Column]:
        """The arrays; see `Packed`."""
        return {name: Column(m.dtype.str, m.shape) for name, m in self._arrays.items()}

    @property
    def memory(self) -> int:
        """Pieces and buffers."""
        return 8 << 20

    def unpack(self, _notes: list[str]) -> Iterator[Array]:
        """All arrays; see `Packed`."""
        with opened(self.path) as archive:
            for member in self._arrays.values():
                row = np.dtype((member.dtype, member.shape[1:])).itemsize
                step = max(_PIECE // row, 1)
                with archive.open(member.info) as file:
                    file.read(member.start)
                    for start in range(0, member.shape[0], step):
                        rows = min(step, member.shape[0] - start)
                        data = file.read(rows * row)
                        if len(data) < rows * row:
                            raise EOFError("an array is cut short")
                        yield np.frombuffer(data, member.dtype).reshape(rows, *member.shape[1:])
                    file.read(1)  # at the end, where the checksum is looked at

    def decode(self, columns: ColumnReader, start: int, stop: int) -> Splats:
        """Some rows; see `Packed`."""
        return self.model({name: columns(name, start, stop) for name in self._arrays})

    def model(self, arrays: dict[str, Array]) -> Splats:
        """The model of some rows of the arrays, which are turned into native order in place."""
        mode = {} if self._mode is None else {MODE: self._mode}
        own = {name: _native(array) for name, array in arrays.items()}
        return model_of(self.path, own | mode, self._names)


def _native(array: Array) -> Array:
    if array.dtype.isnative:
        return array
    return array.byteswap(inplace=True).view(array.dtype.newbyteorder("="))
