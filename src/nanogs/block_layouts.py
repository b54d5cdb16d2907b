"""Layouts of results that are made block by block: divided into chunks, or linked into a tree.

The interfaces here are implemented in `lod`; `pipeline` sends their instances, which are plain
data, to the workers that process blocks, and plans with the memory and time that they state.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from nanogs._types import I64, Array, F
from nanogs.progress import PartProgress, ignore_progress
from nanogs.source import Source
from nanogs.splats import Splats

PLACED = 24  # bytes for each splat of a level while it is divided: its cell and row
TOGETHER = 4  # splats that become one in each step of merging above the coarsest level of a tree


@dataclass(frozen=True, slots=True)
class BlockChunks:
    """A block of a result in chunks: the whole result, or the part of one block of a job.

    Attributes:
        cells: The division of space from `Chunked.divide`; empty if the result is empty.
        splats: Number of splats in the block.
        losses: The parts of the model that its files leave out, one sentence each.
        files: Name and contents of each file, made one at a time. They may also hold splats of the
            blocks after it, which then have no files.
        chunks: Plain data that describe the chunks to their layout; complete once all files have
            been consumed.
    """

    cells: Mapping[str, Array]
    splats: int = 0
    losses: Sequence[str] = ()
    files: Iterable[tuple[str, bytes]] = ()
    chunks: list[Any] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Encoding:
    """Memory and time for making chunks; all zero if there are none.

    Attributes:
        file: Bytes for the file that is being made.
        joined: Bytes for splats of further blocks that share the files of one.
        each: Bytes for each splat of a block.
        described: Bytes for the manifest of the folder, which is held whole at the end.
        seconds: Seconds of one processor, for all files.
        sized: Whether the size of chunks can be chosen.
    """

    file: float = 0.0
    each: float = 0.0
    described: float = 0.0
    seconds: float = 0.0
    joined: float = 0.0
    sized: bool = True

    def held(self, block: int) -> float:
        """Return the peak of memory in bytes, with blocks of `block` splats."""
        return max(self.file + self.joined + block * self.each, self.described)

    def most(self, available: float, block: int) -> int:
        """Return the most splats of a block, at most `block`, that `available` bytes can hold."""
        if self.each == 0:
            return block
        if self.described > available:
            return 0
        return max(min(block, int((available - self.file - self.joined) / self.each)), 0)

    def remedy(self) -> str:
        """Return the end of a sentence about memory: what is needed, and a remedy."""
        if self.each == 0:
            return "."
        if not self.sized:
            return f" and {self.held(0) / 1e6:,.0f} MB for the file that is written."
        size = "larger" if self.described > self.file else "smaller"
        return f" and {self.held(0) / 1e6:,.0f} MB for chunks; a {size} `chunk` takes less."


@runtime_checkable
class Chunked(Protocol):
    """A layout that divides results into chunks; instances are plain data, for any worker."""

    @property
    def suffix(self) -> str:
        """Suffix of the files that hold splats."""

    @property
    def weight(self) -> float:
        """Seconds that a machine takes for a million splats."""

    @property
    def fewest(self) -> int:
        """Fewest splats that a block of a result may have; smaller ones are joined with the next.

        0 joins none.
        """

    def divide(self, means: F) -> dict[str, Array]:
        """Divide space into cells by (N, 3) finite centres, N at least 1, of the finest result."""

    def encode(
        self,
        splats: Splats,
        blocks: Sequence[tuple[int, Mapping[str, Array]]],
        finer: Sequence[Any] | None,
        prefix: str,
        on_progress: PartProgress = ignore_progress,
    ) -> BlockChunks:
        """Make the files of a block, or of neighbouring blocks, lazily.

        Args:
            splats: N splats, all finite, sorted by block.
            blocks: Number of splats of each block, and the cells of its finest result from
                `divide`; a single block if `fewest` is 0.
            finer: Chunks of this block's next finer result; None for the finest.
            prefix: Prefix of the file names.
            on_progress: Progress callback for the parts that are done.
        """

    def encoding(self, row: int, degree: int, splats: int, shares: Sequence[float]) -> Encoding:
        """Estimate memory and time for all chunks.

        Args:
            row: Bytes of a splat.
            degree: Degree of the spherical harmonics.
            splats: Number of splats of the whole model.
            shares: Share of them that each result keeps; a block can keep more than others.
        """


@dataclass(frozen=True, slots=True)
class BlockTree:
    """A tree (forest) of the levels of a block; its nodes include splats that are in no result.

    Attributes:
        layers: The splats of each layer, the finest first and the roots last; children of one
            parent are adjacent, and in the order of their parents.
        children: For each layer a function that returns the number of children of its rows `start`
            to `stop`, exclusive.
        roots: Moments of the roots, by name, each with a row for each root.
    """

    layers: Sequence[Source]
    children: Sequence[Callable[[int, int], I64]]
    roots: Mapping[str, Array]


@runtime_checkable
class Linked(Protocol):
    """A layout that links results into a tree; instances are plain data, for any worker."""

    @property
    def suffix(self) -> str:
        """Suffix of the files that hold splats."""

    @property
    def weight(self) -> float:
        """Seconds that a machine takes for a million splats."""

    def link(self, levels: Sequence[Source], some: Splats, steps: int) -> BlockTree:
        """Build the tree of a block.

        Args:
            levels: The block's part of each result, the finest first, of 1 splat or more each.
            some: A sample of the finest result, the same for all blocks.
            steps: Number of times that splats of the coarsest level are merged again, `TOGETHER` at
                a time, so that there are few roots.

        Raises:
            ManyChildrenError: A node would have too many children.
        """

    def encoding(self, row: int, degree: int, splats: int, shares: Sequence[float]) -> Encoding:
        """Estimate memory and time for linking; see `Chunked.encoding` for the arguments."""

    def whole(self, row: int) -> int:
        """Return the extra bytes for each splat of the finest result, for a model in memory.

        Args:
            row: Bytes of a splat.
        """
