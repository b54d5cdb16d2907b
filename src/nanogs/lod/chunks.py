"""The base of layouts that divide levels into chunks: sorting splats by cell, and the interface."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np

from nanogs._types import I64, Array, F
from nanogs.block_layouts import PLACED, BlockChunks, Encoding
from nanogs.errors import OptionError
from nanogs.io.json_fields import is_plain
from nanogs.lod.cells import Cells, divide
from nanogs.progress import PartProgress, ignore_progress
from nanogs.splats import Splats

Made = Iterator[tuple[Any, Mapping[str, bytes]]]
"""Yields chunks: the plain data that describe a chunk, and the contents of its files by name."""
_OUTSIDE = 12_000_000  # bytes that libraries take for a file, besides those for each splat
_DESCRIBED = 2 * 8_000  # bytes to describe a chunk at all levels; twice, as some are half full


class SortedLevel:
    """The splats of a level, or of some neighbouring blocks of it, sorted by cell.

    Attributes:
        cells: The cells of the first block.
        leaves: (N,) the leaf of each splat; leaves are numbered through all blocks.
        counts: (L,) splats of each leaf; the leaves of a block follow those of the one before.
    """

    def __init__(self, splats: Splats, blocks: Sequence[tuple[int, Cells]]) -> None:
        """Sort the splats.

        Args:
            splats: N splats, all finite, block after block.
            blocks: Number of splats and cells of each block.
        """
        # Chunks do not hold these, so they are not copied.
        self._splats = replace(splats, extras={}, comments=(), elements=(), notes=())
        self.cells = blocks[0][1]
        leaves, at, first = [], 0, 0
        for count, cells in blocks:
            leaves.append(first + cells.leaf_of(splats.means[at : at + count]))
            at, first = at + count, first + cells.count
        self.leaves = np.concatenate(leaves)
        self.counts = np.bincount(self.leaves, minlength=first)
        self._order = np.argsort(self.leaves, kind="stable")
        self._starts = np.concatenate([[0], np.cumsum(self.counts)])

    def take(self, first: int, end: int) -> tuple[Splats, I64]:
        """Return the splats of a range of leaves, and the leaf of each, ascending."""
        rows = self._order[self._starts[first] : self._starts[end]]
        return self._splats.take(rows), self.leaves[rows]


class ChunkTree(NamedTuple):
    """The cells and chunks of the scene, or of a block of it.

    Attributes:
        cells: The cells that divide it.
        levels: Chunks of each level, the finest first, as plain data of the `ChunkLayout`. Those of
            a block may hold splats of the blocks after it, which then have none of their own.
    """

    cells: Cells
    levels: Sequence[Sequence[Any]]


@dataclass(frozen=True, slots=True)
class ChunkLayout(ABC):
    """A layout that divides levels into chunks; see `block_layouts.Chunked`.

    Attributes:
        most: Most splats of the finest level in a chunk.
        least: Least splats of the finest level in a chunk, unless there are fewer in all.
    """

    most: int
    least: int = 1
    name: ClassVar[str]  # of the file that describes the others
    suffix: ClassVar[str]  # of the model files
    weight: ClassVar[float]  # seconds of a machine per million splats
    chunks_a_file: ClassVar[int] = 1
    # Memory to make a file: a factor of the size of its splats, and bytes per splat.
    held: ClassVar[tuple[float, int]]

    def __post_init__(self) -> None:
        """Check the sizes of chunks.

        Raises:
            OptionError: One is below 1, or the least is more than half of the most.
        """
        for bound in (self.most, self.least):
            if bound < 1:
                raise OptionError(f"A chunk must hold at least 1 splat, not {bound}.")
        if 2 * self.least > self.most + 1:
            raise OptionError(
                f"Chunks of {self.least:,} to {self.most:,} splats cannot always be made, since a"
                " larger one is cut in halves: the least must be at most half of the most."
            )

    def divide(self, means: F) -> dict[str, Array]:
        """Divide space around centres and return the fields of `Cells`; see `Chunked`."""
        return asdict(divide(means, self.most, self.least))

    @property
    def fewest(self) -> int:
        """Least splats of a block's result; 0 because files do not span blocks; see `Chunked`."""
        return 0

    def encode(
        self,
        splats: Splats,
        blocks: Sequence[tuple[int, Mapping[str, Array]]],
        finer: Sequence[Any] | None,
        prefix: str,
        on_progress: PartProgress = ignore_progress,
    ) -> BlockChunks:
        """Make the files of a block, or of neighbouring ones, lazily; see `Chunked`."""
        level = SortedLevel(splats, [(count, Cells(**cells)) for count, cells in blocks])
        chunks = list[Any]()
        losses = self.losses(splats) if len(splats) else ()

        def files() -> Iterator[tuple[str, bytes]]:
            for chunk, files in self._made(level, finer, prefix, on_progress):
                chunks.append(chunk)
                yield from files.items()

        return BlockChunks(blocks[0][1], len(splats), losses, files(), chunks)

    def encoding(self, row: int, degree: int, splats: int, shares: Sequence[float]) -> Encoding:
        """Estimate memory and time for all chunks, from measurements of a file; see `Chunked`."""
        largest, (over, each) = max(shares), self.held
        at_once = min(self.most * self.chunks_a_file, splats * largest)
        return Encoding(
            file=_OUTSIDE + at_once * (over * row + each),
            each=min(1.0, 2 * largest) * (row + PLACED),
            joined=2 * self.fewest * (row + PLACED),
            described=splats * largest / self.most * _DESCRIBED,
            seconds=sum(int(share * splats) for share in shares) * self._seconds[degree > 0],
        )

    @property
    @abstractmethod
    def _seconds(self) -> tuple[float, float]:
        """Seconds of one CPU core per splat, without and with SH above degree 0."""

    @abstractmethod
    def _made(
        self,
        level: SortedLevel,
        finer: Sequence[Any] | None,
        prefix: str,
        on_progress: PartProgress,
    ) -> Made:
        """Make the chunks of a level; see `encode`."""

    @abstractmethod
    def switch_pixel(self, level: int, deviation: float) -> float:
        """Return the size of a pixel, in scene units, at which a viewer switches to a level.

        Args:
            level: 1 or more.
            deviation: Standard deviation of a typical splat of the level along its longest axis,
                scene units.
        """

    @abstractmethod
    def losses(self, splats: Splats) -> tuple[str, ...]:
        """Name the parts of a model that the files leave out, one sentence each."""

    @abstractmethod
    def describe(
        self, trees: Sequence[ChunkTree], counts: Sequence[int], environment: bool = False
    ) -> str:
        """Return the contents of the file that describes the others.

        Args:
            trees: One or more, neighbours in space next to each other.
            counts: Number of splats of each level.
            environment: Whether there are `environment_files`.
        """

    def environment_files(self, splats: Splats) -> Mapping[str, bytes]:
        """Make the files of the environment, by name; only for layouts that support one."""
        raise NotImplementedError


def plain_paths(names: Iterable[object]) -> list[str]:
    """Keep only paths below the folder, because an edited description may contain others."""
    return [name for name in names if isinstance(name, str) and all(map(is_plain, name.split("/")))]
