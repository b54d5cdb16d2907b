"""Shared by the layouts in chunks: the splats of a level in the order of their cells."""

import json
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from nanogs._types import I64, Array, F
from nanogs._version import __version__
from nanogs.block_layouts import PLACED, BlockChunks, Encoding
from nanogs.errors import OptionError
from nanogs.io.json_fields import is_plain
from nanogs.lod.cells import Cells, divide
from nanogs.progress import Parts, untold
from nanogs.splats import Splats

GENERATOR = "nanogs"
Made = Iterator[tuple[Any, Mapping[str, bytes]]]
"""Chunks one at a time, as plain data, each with the files that are made with it."""
_OUTSIDE = 12_000_000  # bytes for a file in libraries, beside which a splat has pixels there
_DESCRIBED = 2 * 8_000  # bytes for what is said of a chunk at all levels; some are but half full


class SortedLevel:
    """A level, or some neighbouring blocks of it, whose splats are taken cell by cell.

    Attributes:
        cells: Those of the first block.
        counts: (L,) splats of each leaf; the leaves of a block follow those of the one before.
    """

    def __init__(self, splats: Splats, blocks: Sequence[tuple[int, Cells]]) -> None:
        """Sort the splats.

        Args:
            splats: N splats, all finite, those of one block after those of the other.
            blocks: How many splats each block has, and what they are sorted into.
        """
        # What no chunk holds is not copied into any.
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
        """The splats of a range of leaves, and the leaf of each, ascending."""
        rows = self._order[self._starts[first] : self._starts[end]]
        return self._splats.take(rows), self.leaves[rows]


class ChunkTree(NamedTuple):
    """The scene, or a block of it.

    Attributes:
        cells: What divides it.
        levels: Chunks of each level, the finest first, as `ChunkLayout` describes them. Those of
            a block may hold splats of the blocks after it, which then have none of their own.
    """

    cells: Cells
    levels: Sequence[Sequence[Any]]


@dataclass(frozen=True, slots=True)
class ChunkLayout(ABC):
    """A layout that divides levels; see `block_layouts.Chunked`.

    Attributes:
        most: Splats of the finest level in a chunk, at most.
        least: Splats of the finest level in a chunk, at least, unless there are fewer in all.
    """

    most: int
    least: int = 1
    name: ClassVar[str]  # of the file that tells of the others
    suffix: ClassVar[str]  # of a model as its files hold it
    weight: ClassVar[float]  # seconds of a machine for a million splats
    chunks_a_file: ClassVar[int] = 1
    held: ClassVar[tuple[float, int]]  # for a file: bytes over those of its splats, and a splat

    def __post_init__(self) -> None:
        """Refuse what is no size of chunks.

        Raises:
            OptionError: It is below 1, or the least is more than half of the most.
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
        """As `Chunked` says: the fields of `Cells`."""
        return asdict(divide(means, self.most, self.least))

    @property
    def fewest(self) -> int:
        """As `Chunked` says: of files that cannot hold several blocks any number will do."""
        return 0

    def encode(
        self,
        splats: Splats,
        blocks: Sequence[tuple[int, Mapping[str, Array]]],
        finer: Sequence[Any] | None,
        prefix: str,
        tell: Parts = untold,
    ) -> BlockChunks:
        """As `Chunked` says."""
        level = SortedLevel(splats, [(count, Cells(**cells)) for count, cells in blocks])
        chunks = list[Any]()
        losses = self.losses(splats) if len(splats) else ()

        def files() -> Iterator[tuple[str, bytes]]:
            for chunk, files in self._made(level, finer, prefix, tell):
                chunks.append(chunk)
                yield from files.items()

        return BlockChunks(blocks[0][1], len(splats), losses, files(), chunks)

    def encoding(self, row: int, degree: int, splats: int, shares: Sequence[float]) -> Encoding:
        """As `Chunked` says, from measurements of one file."""
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
        """Of a processor for a splat, without and with harmonics of higher degrees."""

    @abstractmethod
    def _made(
        self, level: SortedLevel, finer: Sequence[Any] | None, prefix: str, tell: Parts
    ) -> Made:
        """Make the chunks of a level; see `encode`."""

    @abstractmethod
    def switch_pixel(self, level: int, deviation: float) -> float:
        """Scene units that a pixel shows where a viewer begins to draw a level.

        Args:
            level: 1 or more.
            deviation: Of a typical splat of it along its longest axis, scene units.
        """

    @abstractmethod
    def losses(self, splats: Splats) -> tuple[str, ...]:
        """Name the parts of a model that the files leave out, one sentence each."""

    @abstractmethod
    def describe(
        self, trees: Sequence[ChunkTree], counts: Sequence[int], environment: bool = False
    ) -> str:
        """The contents of the file that tells of the others.

        Args:
            trees: One or more, neighbours beside each other.
            counts: Splats of each level.
            environment: Whether there are `environment_files`.
        """

    def environment_files(self, splats: Splats) -> Mapping[str, bytes]:
        """Name and contents of the files of what belongs to every level, where there may be any."""
        raise NotImplementedError


def generator() -> str:
    """The program and its version, as it names itself in what it writes."""
    return f"{GENERATOR} {__version__}"


def read_own(path: Path, *keys: str) -> dict[str, Any] | None:
    """The JSON object of a file in which nanogs is named under these keys; None for other files."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        named: Any = data
        for key in keys:
            named = named[key]
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return None
    return data if isinstance(named, str) and named.startswith(GENERATOR) else None


def plain_paths(names: Iterable[object]) -> list[str]:
    """Keep paths that lead below the folder: those of a changed description may not."""
    return [name for name in names if isinstance(name, str) and all(map(is_plain, name.split("/")))]
