"""Output sinks: the interface through which results are written to a file or a folder of levels.

The pipeline is given a sink: `lod` has one for each layout of levels, and `OneFile` is here. A sink
is opened at a temporary path, takes results in turn, the finest first, and its output is moved to
the final path when it is complete.
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
from nanogs.errors import OptionError, shown_as
from nanogs.io import check_writable, losses, registry, write_model
from nanogs.io.atomic import atomic_write, move_into_place, writing
from nanogs.io.format import FormatOptions
from nanogs.io.temporary import temporary
from nanogs.progress import PartProgress, ignore_progress
from nanogs.protocol import Judged
from nanogs.report import SimplifyReport
from nanogs.source import Source
from nanogs.splats import Splats
from nanogs.switches import PixelOf, SwitchQuality

Read = Callable[[], Splats]
"""Function that reads a model; called only if the model is needed."""


class EnvironmentWritten(NamedTuple):
    """Record of an environment that was written beside all results.

    Attributes:
        source: Name of its file, or "auto" if it was found in the model.
        splats: Number of its splats.
        bytes: Total size of its files.
        requests: Number of these files.
        moved: Number of splats of the model that were moved into it.
    """

    source: str
    splats: int
    bytes: int
    requests: int
    moved: int


class Written(NamedTuple):
    """Record of a result that was written.

    Attributes:
        splats: Number of splats.
        files: Files of the result, as paths relative to the folder, with slashes.
        bytes: Total size of these files and of the files that they refer to.
        losses: The parts of the model that they leave out, and options without an effect, one
            sentence each.
        sha256: Hexadecimal hash of the file, if there is a single one.
        judged: PSNR in dB and SSIM against the original model, and the number of views; None if not
            measured.
        notes: Reasons for what was not measured or is not as asked, one sentence each.
        costs: Costs of drawing the result and the original model: the numbers of `DrawCost` without
            the views; None if not measured.
        requests: Number of files that a viewer requests, for a result in chunks: the files above
            and those that they refer to.
        switch: The fields of `SwitchQuality`; None if not measured.
        environment: The fields of `EnvironmentWritten`; empty without an environment.
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
    switch: tuple[float, float, float, int, float] | None = None
    environment: Sequence[Any] = ()

    @property
    def beside(self) -> EnvironmentWritten | None:
        """The environment beside all results; None without one."""
        return EnvironmentWritten(*self.environment) if self.environment else None

    @property
    def switched(self) -> SwitchQuality | None:
        """Scores at the distance at which a viewer starts to draw it; None if not measured."""
        return None if self.switch is None else SwitchQuality(*self.switch)

    @property
    def drawn(self) -> tuple[DrawCost, ...]:
        """The costs of the result and of the model with their views; empty if not measured."""
        return tuple(DrawCost.usual(*each) for each in self.costs or ())

    @property
    def scores(self) -> Judged | None:
        """PSNR and SSIM with the protocol of the measurement; None if not measured."""
        return None if self.judged is None else Judged.usual(*self.judged)

    @property
    def measured(self) -> dict[str, Any]:
        """Scores and draw costs by the fields of `SimplifyReport`; None if not measured."""
        cost, original = self.drawn or (None, None)
        return {"judged": self.scores, "cost": cost, "original_cost": original}


@dataclass(frozen=True, slots=True, eq=False)
class Environment:
    """A model that viewers draw with every result, such as the sky.

    Attributes:
        source: Its source: the name of its file, or "auto".
        count: Number of its splats before simplification.
        own: Whether these were taken out of the model itself.
        original: Reads it unsimplified, in the frame of the model.
        made: Reads it in the form that is written.
        notes: Notes about its files for the user, one sentence each.
    """

    source: str
    count: int
    own: bool
    original: Read
    made: Read
    notes: tuple[str, ...] = ()


class Judge(Protocol):
    """Measures written files against the original model."""

    @property
    def notes(self) -> Sequence[str]:
        """Reasons why files were not measured so far, one sentence each."""

    def of(self, path: Path, level: int = 0) -> Judged | None:
        """Measure PSNR and SSIM of a file, or of a level in it; None if that is impossible."""

    def costs(self, path: Path, level: int = 0) -> Sequence[DrawCost]:
        """Return the costs of drawing the file and the original; empty if not measured."""

    def quality_at_switch(self, path: Path, level: int, pixel_of: PixelOf) -> SwitchQuality | None:
        """Measure a level at the distance at which a viewer starts to draw it; None if not done."""


class OpenSink(ABC):
    """An open sink, to which results are written.

    Attributes:
        written: Records of the results so far.
    """

    def __init__(self) -> None:
        self.written: list[Written] = []

    @abstractmethod
    def add(self, model: Splats | Source, on_progress: PartProgress = ignore_progress) -> None:
        """Write the next result, given whole, and report the progress."""

    def add_blocks(self, blocks: Iterable[BlockChunks]) -> None:
        """Write the next result, given as blocks whose files the sink's layout has made."""
        raise NotImplementedError

    def add_trees(
        self,
        trees: Sequence[BlockTree],
        levels: int,
        some: Splats,
        on_progress: PartProgress = ignore_progress,
    ) -> None:
        """Accept the trees that the sink's layout has linked; results are added afterwards.

        Args:
            trees: The tree of each block.
            levels: Number of results in the trees.
            some: The sample of splats that `Linked.link` was given.
            on_progress: Progress callback for the writing, which happens at the end.
        """
        raise NotImplementedError

    @abstractmethod
    def finish(self, reports: Sequence[SimplifyReport], judge: Judge | None = None) -> object:
        """Measure each result, and write the manifest.

        Args:
            reports: The report of each result.
            judge: Measures files; by default nothing is measured.
        """

    def measure(
        self,
        judge: Judge | None,
        files: Sequence[tuple[Path, int]],
        pixel_of: PixelOf | None = None,
    ) -> None:
        """Measure the results, and add the scores to their records in `written`.

        Args:
            judge: Measures files, or None.
            files: File of each result, and the level in it.
            pixel_of: Rule by which a viewer chooses a level; None if no viewer switches levels.
        """
        if judge is None:
            return
        for number, file in enumerate(files):
            found = judge.of(*file)
            if found is not None:
                judged = found.psnr, found.ssim, found.protocol.views
                costs = [each.numbers for each in judge.costs(*file)] or None
                switch = judge.quality_at_switch(*file, pixel_of) if number and pixel_of else None
                self.written[number] = self.written[number]._replace(
                    judged=judged, costs=costs, switch=astuple(switch) if switch else None
                )
        notes = (*self.written[0].notes, *judge.notes)
        self.written[0] = self.written[0]._replace(notes=notes)


class Sink(Protocol):
    """A destination for results: a file, or a folder of levels."""

    @property
    def place(self) -> Path:
        """The file or folder to make."""

    @property
    def overwrite(self) -> bool:
        """Whether an existing output is replaced, if it is of a kind that may be."""

    @property
    def block_layout(self) -> Chunked | Linked | None:
        """The layout that divides or links results; None if each result is one file."""

    @property
    def environment(self) -> Environment | None:
        """The environment that is drawn with every result, or None."""

    @property
    def suffix(self) -> str:
        """Suffix of the file format in which results can be measured."""

    @property
    def format_options(self) -> FormatOptions | None:
        """Options of that format; None for layouts that have no such options."""

    def refuse_large(self, count: int, row: int, max_memory: int | None) -> None:
        """Refuse results that the format's writer must hold whole and that are too large for that.

        Args:
            count: Number of splats of the largest result.
            row: Bytes of a splat.
            max_memory: Bytes of memory, or None for no limit.

        Raises:
            OptionError: They are too large, or their format cannot be written.
        """

    def check(self) -> None:
        """Check that results can be written.

        Raises:
            OutputError: They cannot.
        """

    def open(self, making: Path, options: FormatOptions) -> OpenSink:
        """Open the sink at a temporary path; the remains of an earlier run there are removed.

        Args:
            making: The path, with the same suffix as `place`.
            options: Options of the format, in addition to those of the sink.
        """

    def move(self, made: Path) -> None:
        """Move the finished output to its final path, across file systems if necessary.

        Raises:
            OutputError: Something exists there that is not replaced, or it cannot be written.
        """

    def files(self, made: Path) -> Sequence[str]:
        """List all files of the output as paths relative to it, the manifest first."""


class InOneFile(ABC):
    """The base of sinks whose whole output is one file; see `Sink`."""

    __slots__ = ()
    place: Path
    overwrite: bool

    @abstractmethod
    def check(self) -> None:
        """Check that the file can be written; see `Sink.check`."""

    def move(self, made: Path) -> None:
        """Move the finished file to its final path; see `Sink.move`."""
        self.check()
        move_file(made, self.place, overwrite=self.overwrite)

    def files(self, made: Path) -> Sequence[str]:  # noqa: ARG002 - it is one
        """Return the output itself as the only file; see `Sink.files`."""
        return (".",)


@dataclass(frozen=True, slots=True)
class OneFile(InOneFile):
    """A sink for a single result in one file.

    Attributes:
        place: The file to write.
        overwrite: Whether an existing file is replaced.
        format_options: Options of the format; see `save`.
    """

    place: Path
    overwrite: bool
    format_options: FormatOptions | None = None
    block_layout: None = None
    environment: None = None

    @property
    def suffix(self) -> str:
        """Suffix of the file's format."""
        known = registry.find(self.place)
        return known.suffix if known else self.place.suffix

    def refuse_large(self, count: int, row: int, max_memory: int | None) -> None:
        """Refuse a result that is too large to be held whole, and a folder; see `Sink`."""
        refuse_large(self.place, count, row, max_memory, self.format_options)

    def check(self) -> None:
        """Check that the file can be written; see `Sink.check`."""
        check_writable(self.place, overwrite=self.overwrite, format_options=self.format_options)

    def open(self, making: Path, options: FormatOptions) -> OpenSink:
        """Open the sink at a temporary path; see `Sink.open`."""
        return _File(making, self.format_options, options)


class _File(OpenSink):
    def __init__(self, making: Path, asked: FormatOptions | None, chosen: FormatOptions) -> None:
        super().__init__()
        self._making, self._asked, self._options = making, asked, {**(asked or {}), **chosen}

    def add(self, model: Splats | Source, on_progress: PartProgress = ignore_progress) -> None:
        on_progress(0, 1)
        write_model(model, self._making, overwrite=True, format_options=self._options)
        size, left_out = self._making.stat().st_size, losses(model, self._making, self._asked)
        self.written.append(Written(len(model), (self._making.name,), size, left_out))

    def finish(self, reports: Sequence[SimplifyReport], judge: Judge | None = None) -> None:  # noqa: ARG002
        """Measure the file; it needs no manifest."""
        self.measure(judge, [(self._making, 0)])


@contextmanager
def made_beside(sink: Sink, suffix: str) -> Iterator[Path]:
    """Provide a temporary path beside a sink's file, which is moved there if no error occurs.

    Raises:
        OutputError: The file may not be replaced, or it cannot be written.
    """
    sink.check()
    target = Path(os.path.realpath(sink.place))
    with writing(sink.place), temporary(target, Path.mkdir) as folder:
        made = folder / f"levels{suffix}"
        with shown_as({str(made): str(sink.place)}):
            yield made
        sink.move(made)


def move_file(made: Path, place: Path, *, overwrite: bool) -> None:
    """Move a finished file to its final path, across file systems if necessary.

    Raises:
        OutputError: A file exists there that is not replaced, or it cannot be written.
    """
    if made.stat().st_dev == Path(os.path.realpath(place)).parent.stat().st_dev:
        move_into_place(made, place, overwrite=overwrite)
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
    remedy: str = "name a .ply file",
) -> None:
    """Refuse a result that the format's writer must hold whole and that is too large for that.

    Args:
        path: The file to write.
        count: Number of splats of the result.
        row: Bytes of a splat.
        max_memory: Bytes of memory, or None for no limit.
        options: Options of the format.
        remedy: How the caller chooses a format that is written block by block.

    Raises:
        OptionError: It is too large, a folder, or in a format that cannot be written.
    """
    registry.writer(path)  # refuses folders
    known = registry.writable(path)
    most = held_splats(path, row, max_memory)
    if known.needs_whole_model(options or {}) and most is not None and count > most:
        so = " with a palette" if known.streams else ""
        raise OptionError(
            f"{path}: {known.suffix}{so} is not written block by block, and {count:,} splats are"
            f" too many to be held in memory at once; {remedy}, or raise `max_memory`."
        )


def held_splats(path: Path, row: int, max_memory: int | None) -> int | None:
    """Return the number of splats that a format's writer can hold in memory; None for no limit.

    Args:
        path: The file to write.
        row: Bytes of a splat.
        max_memory: Bytes of memory, or None for no limit.
    """
    if max_memory is None:
        return None
    return max_memory // (row + registry.writable(path).extra_memory(row))
