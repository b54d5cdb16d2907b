"""How results lie that are made block by block: divided into chunks, or linked to a tree.

Plain data that `lod` makes and `pipeline` hands to whoever works on a block, with the memory and
the time that each takes.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from nanogs._types import I64, Array, F
from nanogs.progress import Parts, untold
from nanogs.source import Source
from nanogs.splats import Splats

PLACED = 24  # bytes a splat of a level that is divided: its cell and place


@dataclass(frozen=True, slots=True)
class BlockChunks:
    """A block of a result in chunks: all of it, or what one block of a job is left with.

    Attributes:
        cells: What divides it, as `Chunked.divide` gives it; empty where there is nothing at all.
            Its files may hold splats of the blocks after it too, which then have no files.
        splats: In it.
        losses: The parts that its files leave out, one sentence each.
        files: Name and contents of each file, one at a time.
        chunks: Plain data that tell its layout of the chunks; complete once all files are taken.
    """

    cells: Mapping[str, Array]
    splats: int = 0
    losses: Sequence[str] = ()
    files: Iterable[tuple[str, bytes]] = ()
    chunks: list[Any] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Encoding:
    """Memory and time that it takes to make chunks; none where there are none.

    Attributes:
        file: Bytes for the file that is being made.
        joined: Bytes for splats of further blocks that files of one hold too.
        each: Bytes for each splat of a block.
        described: Bytes for what describes the folder, which is held whole in the end.
        seconds: Of one processor, for all files.
        sized: Whether the size of chunks can be chosen.
    """

    file: float = 0.0
    each: float = 0.0
    described: float = 0.0
    seconds: float = 0.0
    joined: float = 0.0
    sized: bool = True

    def held(self, block: int) -> float:
        """Most bytes at any time, with blocks of so many splats."""
        return max(self.file + self.joined + block * self.each, self.described)

    def most(self, room: float, block: int) -> int:
        """Splats of a block for which there is room, and no more than so many."""
        if self.each == 0:
            return block
        if self.described > room:
            return 0
        return max(min(block, int((room - self.file - self.joined) / self.each)), 0)

    def remedy(self) -> str:
        """Advice on what takes less, to end a sentence about memory."""
        if self.each == 0:
            return "."
        if not self.sized:
            return f" and {self.held(0) / 1e6:,.0f} MB for the file that is written."
        size = "larger" if self.described > self.file else "smaller"
        return f" and {self.held(0) / 1e6:,.0f} MB for chunks; a {size} `chunk` takes less."


@runtime_checkable
class Chunked(Protocol):
    """A layout that divides results into chunks: plain data, which travel to any worker."""

    @property
    def weight(self) -> float:
        """Seconds of a machine for a million splats."""

    @property
    def fewest(self) -> int:
        """Splats of a result below which a block is put together with the next; 0 for never."""

    def divide(self, means: F) -> dict[str, Array]:
        """Divide space around (N, 3) finite centres, N at least 1, of the finest result."""

    def encode(
        self,
        splats: Splats,
        blocks: Sequence[tuple[int, Mapping[str, Array]]],
        finer: Sequence[Any] | None,
        prefix: str,
        tell: Parts = untold,
    ) -> BlockChunks:
        """The files of a block, or of neighbouring ones, which are made as they are taken.

        Args:
            splats: N splats, all finite, block after block.
            blocks: How many splats each has, and as `divide` gives them the cells of its finest
                result; one block, where `fewest` is 0.
            finer: Chunks of this block's next finer result; None for the finest.
            prefix: How names of files begin.
            tell: Told of the parts that are done.
        """

    def encoding(self, row: int, degree: int, splats: int, shares: Sequence[float]) -> Encoding:
        """Memory and time for all chunks.

        Args:
            row: Bytes of a splat.
            degree: Of the spherical harmonics.
            splats: Of the whole model.
            shares: Shares that the results keep of them; a block can keep more than others.
        """


@dataclass(frozen=True, slots=True)
class BlockTree:
    """A tree of the levels of a block, down from several roots; not all are splats of the result.

    Attributes:
        layers: The splats of each, the finest first and the roots last, children of one row side by
            side and in the order of their parents.
        children: Tells of each layer how many children the rows from one to before another have.
        roots: Moments of the roots, by name, each with a row for each root.
    """

    layers: Sequence[Source]
    children: Sequence[Callable[[int, int], I64]]
    roots: Mapping[str, Array]


@runtime_checkable
class Linked(Protocol):
    """A layout that links results to a tree: plain data, which travel to any worker."""

    @property
    def weight(self) -> float:
        """Seconds of a machine for a million splats."""

    def link(self, levels: Sequence[Source], some: Splats, threads: int, steps: int) -> BlockTree:
        """The tree of a block.

        Args:
            levels: What results leave of it, the finest first, of 1 splat or more each.
            some: Splats of the finest result, the same for all blocks.
            threads: To search with.
            steps: How often splats of the coarsest are merged, so that there are few roots.

        Raises:
            OptionError: A splat would stand for too many others.
        """

    def encoding(self, row: int, degree: int, splats: int, shares: Sequence[float]) -> Encoding:
        """As `Chunked` says, of linking."""

    def whole(self, row: int) -> int:
        """Bytes for each splat of the finest result, of a model in memory, beside its own."""
