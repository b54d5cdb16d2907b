"""Where results go: a file, or a folder of levels of detail, whoever makes them.

A sink is handed to whoever makes results: `lod` has one for each layout of levels, and `OneFile` is
here. It is opened at a place of its own, takes results one after the other, the finest first, and
its name is given to what it made when that is complete.
"""

import os
import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from nanogs.block_layouts import BlockChunks, BlockTree, Chunked, Linked
from nanogs.costs import DrawCost
from nanogs.errors import OptionError
from nanogs.io import check_writable, losses, registry, save
from nanogs.io.atomic import atomic_write, writing
from nanogs.io.format import FormatOptions
from nanogs.io.temporary import temporary
from nanogs.progress import Parts, untold
from nanogs.protocol import Judged
from nanogs.report import SimplifyReport
from nanogs.source import Source
from nanogs.splats import Splats
from nanogs.switches import PixelOf, Switch

Read = Callable[[], Splats]
"""Reads a model."""


class Written(NamedTuple):
    """A result as it was written.

    Attributes:
        splats: In it.
        files: Each model's file, as a path from the folder with slashes.
        bytes: Size of these files and of those that they name.
        losses: The parts of the model that they leave out, one sentence each.
        sha256: Of the file where it is one, hexadecimal.
        judged: PSNR in dB and SSIM against the model it was made of, and over how many views; None
            where that was not measured.
        notes: Why it was not, one sentence each.
        costs: What it takes to draw, and the model it was made of: the numbers of `DrawCost` but
            for the views; None where that was not measured.
        requests: Files that a viewer asks for, of those in chunks: those named here and those that
            they name.
        switch: The fields of `Switch`; None where that was not measured.
        environment: Of an environment that is beside all results: where it is from, its splats,
            its bytes, its files, and how many splats of the model have become it; nothing without.
    """

    splats: int
    files: Sequence[str]
    bytes: int
    losses: Sequence[str] = ()
    sha256: str = ""
    judged: tuple[float, float, int] | None = None
    notes: Sequence[str] = ()
    costs: Sequence[Sequence[float]] | None = None
    requests: int = 0
    switch: tuple[float, float | None, float, int, float] | None = None
    environment: Sequence[Any] = ()

    @property
    def switched(self) -> Switch | None:
        """How it looks where a viewer begins to draw it."""
        return None if self.switch is None else Switch(*self.switch)

    @property
    def drawn(self) -> tuple[DrawCost, ...]:
        """The same with the views: of the result, and of the model; none without."""
        return tuple(DrawCost.usual(*each) for each in self.costs or ())

    @property
    def marks(self) -> Judged | None:
        """The same with the protocol by which it was measured."""
        return None if self.judged is None else Judged.usual(*self.judged)


@dataclass(frozen=True, slots=True, eq=False)
class Environment:
    """A model that viewers draw with every result, such as the sky.

    Attributes:
        source: Where it is from: the name of its file, or "auto".
        count: Splats of it before any were merged.
        own: Whether they were taken out of the model itself.
        original: Reads it as it was, in the frame of the model.
        made: Reads it as it is written.
    """

    source: str
    count: int
    own: bool
    original: Read
    made: Read


class Judge(Protocol):
    """Measures files."""

    @property
    def notes(self) -> Sequence[str]:
        """Why one was not measured so far, one sentence each."""

    def of(self, path: Path, level: int = 0) -> Judged | None:
        """Scores of a file, or of a level in there; None where nothing can be measured."""

    def costs(self, path: Path, level: int = 0) -> Sequence[DrawCost]:
        """Costs of drawing it and the model; none where they are not measured."""

    def at_switch(self, path: Path, level: int, pixel_of: PixelOf) -> Switch | None:
        """A level where a viewer begins to draw it; None where that is not measured."""


class Filling(ABC):
    """A sink that has been opened, and is being filled.

    Attributes:
        written: Results so far.
    """

    def __init__(self) -> None:
        self.written: list[Written] = []

    @abstractmethod
    def add(self, model: Splats | Source, tell: Parts = untold) -> None:
        """Write the next result, which is one block, and tell how much of it is written."""

    def add_blocks(self, blocks: Iterable[BlockChunks]) -> None:
        """Write the next result, of whose blocks the sink's chunks have made the files."""
        raise NotImplementedError

    def add_trees(
        self, trees: Sequence[BlockTree], levels: int, some: Splats, tell: Parts = untold
    ) -> None:
        """Take what a sink's layout has linked; results are added afterwards.

        Args:
            trees: Of each block.
            levels: How many results they have, the finest first.
            some: As `Linked.link` took it.
            tell: Told how much has been written, which is done in the end.
        """
        raise NotImplementedError

    @abstractmethod
    def finish(self, reports: Sequence[SimplifyReport], judge: Judge | None = None) -> object:
        """Measure each result, and write what describes all of them.

        Args:
            reports: Of each.
            judge: Measures files; by default nothing is measured.
        """

    def measure(
        self,
        judge: Judge | None,
        files: Sequence[tuple[Path, int]],
        pixel_of: PixelOf | None = None,
    ) -> None:
        """Add to what was written how it was measured.

        Args:
            judge: Measures files, or None.
            files: Each result's file, and its level in there.
            pixel_of: How a viewer chooses among them; None where none does.
        """
        if judge is None:
            return
        for number, file in enumerate(files):
            found = judge.of(*file)
            if found is not None:
                judged = found.psnr, found.ssim, found.protocol.views
                costs = [each.numbers for each in judge.costs(*file)] or None
                switch = judge.at_switch(*file, pixel_of) if number and pixel_of else None
                self.written[number] = self.written[number]._replace(
                    judged=judged, costs=costs, switch=astuple(switch) if switch else None
                )
        notes = (*self.written[0].notes, *judge.notes)
        self.written[0] = self.written[0]._replace(notes=notes)


class Sink(Protocol):
    """Where results go."""

    @property
    def place(self) -> Path:
        """The file or folder to make."""

    @property
    def overwrite(self) -> bool:
        """Whether what is there is replaced, as far as it may be."""

    @property
    def chunks(self) -> Chunked | Linked | None:
        """How results are divided, or linked; None where each is one file."""

    @property
    def environment(self) -> Environment | None:
        """The environment that is drawn with every result, or None."""

    @property
    def suffix(self) -> str:
        """Format of the files in which results can be measured."""

    def refuse_large(self, count: int, row: int, max_memory: int | None) -> None:
        """Refuse results that would have to be held whole and are too large for that.

        Args:
            count: Splats of the largest.
            row: Bytes of a splat.
            max_memory: Bytes, or None for no limit.

        Raises:
            OptionError: They are too large, or their format is not written.
        """

    def check(self) -> None:
        """Look whether results can be written.

        Raises:
            OutputError: They cannot.
        """

    def open(self, making: Path, options: FormatOptions) -> Filling:
        """Begin at a place with the same suffix; what is there of a run before is removed.

        Args:
            making: The place.
            options: Of the format, beside those that were given.
        """

    def move(self, made: Path) -> None:
        """Give its name to what was made, across file systems if need be.

        Raises:
            OutputError: There is something of that name which stays, or it cannot be written.
        """

    def files(self, made: Path) -> Sequence[str]:
        """Name all files of what was made, as paths from it; that which tells of them first."""


@dataclass(frozen=True, slots=True)
class OneFile:
    """A sink of one result.

    Attributes:
        place: The file to write.
        overwrite: Whether a file that exists is replaced.
        format_options: As `save` takes them.
    """

    place: Path
    overwrite: bool
    format_options: FormatOptions | None = None
    chunks: None = None
    environment: None = None

    @property
    def suffix(self) -> str:
        """As `Sink` says."""
        known = registry.find(self.place)
        return known.suffix if known else self.place.suffix

    def refuse_large(self, count: int, row: int, max_memory: int | None) -> None:
        """As `Sink` says; folders are refused too."""
        refuse_large(self.place, count, row, max_memory, self.format_options)

    def check(self) -> None:
        """As `Sink` says."""
        check_writable(self.place, overwrite=self.overwrite, format_options=self.format_options)

    def open(self, making: Path, options: FormatOptions) -> Filling:
        """As `Sink` says."""
        return _File(making, {**(self.format_options or {}), **options})

    def move(self, made: Path) -> None:
        """As `Sink` says."""
        self.check()
        move_file(made, self.place, overwrite=self.overwrite)

    def files(self, made: Path) -> Sequence[str]:  # noqa: ARG002 - it is one
        """As `Sink` says."""
        return (".",)


class _File(Filling):
    def __init__(self, making: Path, format_options: FormatOptions | None) -> None:
        super().__init__()
        self._making, self._options = making, format_options

    def add(self, model: Splats | Source, tell: Parts = untold) -> None:
        tell(0, 1)
        save(model, self._making, overwrite=True, format_options=self._options)
        size, left_out = self._making.stat().st_size, losses(model, self._making)
        self.written.append(Written(len(model), (self._making.name,), size, left_out))

    def finish(self, reports: Sequence[SimplifyReport], judge: Judge | None = None) -> None:  # noqa: ARG002
        """A file speaks for itself."""
        self.measure(judge, [(self._making, 0)])


@contextmanager
def made_beside(sink: Sink, suffix: str) -> Iterator[Path]:
    """A name for making a sink's file beside its place, which it takes at the end without an error.

    Raises:
        OutputError: The file may not be replaced, or it cannot be written.
    """
    sink.check()
    target = Path(os.path.realpath(sink.place))
    with writing(sink.place), temporary(target, Path.mkdir) as folder:
        made = folder / f"levels{suffix}"
        yield made
        sink.move(made)


def move_file(made: Path, place: Path, *, overwrite: bool) -> None:
    """Give its name to a file, across file systems if need be.

    Raises:
        OutputError: There is a file of that name which stays, or it cannot be written.
    """
    target = Path(os.path.realpath(place))
    if not target.exists() and made.stat().st_dev == target.parent.stat().st_dev:
        made.replace(target)
        return
    with atomic_write(place, overwrite=overwrite) as out, made.open("rb") as source:
        shutil.copyfileobj(source, out, 1 << 22)
    made.unlink()


def refuse_large(
    path: Path,
    count: int,
    row: int,
    max_memory: int | None,
    options: FormatOptions | None = None,
) -> None:
    """Refuse a result that would have to be held whole and is too large for that.

    Args:
        path: What is to be written.
        count: Splats of it.
        row: Bytes of a splat.
        max_memory: Bytes, or None for no limit.
        options: Of the format.

    Raises:
        OptionError: It is too large, a folder, or in a format that is not written.
    """
    registry.writer(path)  # which refuses folders
    known = registry.writable(path)
    most = held_splats(path, row, max_memory)
    if known.holds_whole(options or {}) and most is not None and count > most:
        so = " with a palette" if known.streams else ""
        raise OptionError(
            f"{path}: {known.suffix}{so} is not written block by block, and {count:,} splats are"
            " too many to be held whole; name a .ply file, or raise `max_memory`."
        )


def held_splats(path: Path, row: int, max_memory: int | None) -> int | None:
    """Splats of a file that a writer may hold whole; None for any number.

    Args:
        path: What is to be written.
        row: Bytes of a splat.
        max_memory: Bytes, or None for no limit.
    """
    if max_memory is None:
        return None
    return max_memory // (row + registry.writable(path).beside(row))
