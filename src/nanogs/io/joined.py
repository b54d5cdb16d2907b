"""A model that is stored in several files: their metadata and notes, and their rows as one."""

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import accumulate
from pathlib import Path

from nanogs._types import Array
from nanogs.findings import join_findings
from nanogs.io.files import input_size
from nanogs.io.info import FileInfo
from nanogs.io.parts import Column, ColumnReader, Packed
from nanogs.slices import overlapping
from nanogs.splats import RenderMode, Splats, empty_arrays, padded


def joined_info(path: Path, kind: str, infos: Sequence[FileInfo], splats: int) -> FileInfo:
    """Join the metadata of the models of a level.

    Args:
        path: The manifest.
        kind: Name of the format.
        infos: Metadata of each model.
        splats: Number of splats of the level.
    """
    modes = {info.render_mode for info in infos}
    first = max(infos, key=lambda info: info.sh_degree)
    return replace(
        first,
        path=path,
        format=kind,
        file_bytes=input_size(path) + sum(info.file_bytes for info in infos),
        splats=splats,
        render_tag=first.render_tag if len(modes) == 1 else "",
        render_mode=common_mode(modes),
        comments=tuple(dict.fromkeys(line for info in infos for line in info.comments)),
    )


def common_mode(modes: set[RenderMode]) -> RenderMode:
    """Return the render mode that all models have, or the default: a scene can have only one."""
    return modes.pop() if len(modes) == 1 else RenderMode.DEFAULT


def mode_notes(modes: set[RenderMode]) -> list[str]:
    """Return a note for the user if models that make one scene have different render modes."""
    if len(modes) < 2:
        return []
    note = (
        f"Its parts have different render modes ({', '.join(sorted(modes))}), and all are taken for"
        f" {common_mode(modes)}; `render_mode` sets another."
    )
    return [note]


class JoinedPacked(Packed):
    """Packed files whose rows are one model, file after file.

    Args:
        path: The manifest that names the files.
        counts: Number of rows of each file.
    """

    def __init__(self, path: Path, counts: Iterable[int]) -> None:
        super().__init__(path)
        self._ends = [0, *accumulate(counts)]
        self.count = self._ends[-1]

    @property
    @abstractmethod
    def _models(self) -> Sequence[Packed]:
        """The files, in the order of their rows."""

    @cached_property
    def stored(self) -> Mapping[str, Column]:
        """The columns of all files; see `Packed`."""
        return {
            f"{number}:{name}": column
            for number, model in enumerate(self._models)
            for name, column in model.stored.items()
        }

    @cached_property
    def memory(self) -> int:
        """Bytes of memory that unpacking takes for the file that takes most."""
        return max(model.memory for model in self._models)

    def unpack(self, notes: list[str]) -> Iterator[Array]:
        """Unpack one file after another; see `Packed.unpack`."""
        for model in self._models:
            yield from model.unpack(notes)

    def decode(self, columns: ColumnReader, start: int, stop: int) -> Splats:
        """Decode rows `start` to `stop`, which may be in several files; see `Packed.decode`."""
        out = empty_arrays(stop - start, self.info.sh_degree)
        notes: list[Sequence[str]] = []
        at = 0
        for number, low, high in overlapping(self._ends, start, stop):

            def own(name: str, a: int, b: int, number: int = number) -> Array:
                return columns(f"{number}:{name}", a, b)

            part = self._models[number].decode(own, low, high)
            notes.append(part.notes)
            for name, array in out.items():
                column = getattr(part, name)
                column = padded(column, out["sh"].shape[1]) if name == "sh" else column
                array[at : at + high - low] = column
            at += high - low
        notes.append(mode_notes({model.info.render_mode for model in self._models}))
        return Splats(**out, render_mode=self.info.render_mode, notes=join_findings(notes))
