"""Estimates of the blocks, memory, disk and time that a job takes, computed without reading rows.

No Numba here: `--dry-run` uses it.
"""

from dataclasses import dataclass, replace
from enum import StrEnum
from math import ceil

from nanogs.block_layouts import Chunked, Encoding, Linked
from nanogs.errors import OptionError
from nanogs.memory import LIBRARIES
from nanogs.method.parameters import ForestParameters
from nanogs.pipeline.estimates.memory_blocks import block_stages, scratch_bytes
from nanogs.pipeline.options.presets import renders
from nanogs.pipeline.tasks.unpack import Cost
from nanogs.source import Layout
from nanogs.store.columns import row_bytes

_KEYS = 96  # bytes for each row of a segment: codes, order, temporary centres and scales
_SEGMENT = 1 << 21  # rows at most; more make sorting no faster
_LEAST = 4096  # splats of a block at least
_SHARE = 0.95  # of the allowed memory that is planned with
# Seconds of one processor for each splat (`docs/scale.md`): for the first level; for each further
# one; and for each level, for rendering and choosing, and for each step of a fit.
_SECONDS, _LEVEL_SECONDS, _LOOKED, _STEP = 6.5e-6, 2.5e-6, 1.5e-5, 5e-7
# And for each view of each block, however few splats it has, and for each of its pixels: 500,000
# splats took 26 s in 3 blocks and 54 s in 21 (`default`, 30 views of 896 pixels), a fifth of both
# because the machine was busy; six blocks of 38,000 splats took 9.9 s, and 3.4 s with 128 pixels.
_VIEW, _PIXEL = 0.005, 4.7e-8


class MemoryLimit(StrEnum):
    """The limit on the memory of a process, as the beginning of a message about its number."""

    GIVEN = "`max_memory` is {}"
    FREE = "The free memory for each process is {}"
    DEFAULT = "`max_memory` is {} by default with workers"


@dataclass(frozen=True, slots=True)
class BlockPlan:
    """Blocks, memory, disk and time that a job takes.

    Attributes:
        splats: Rows that filters leave of all inputs.
        block: Largest number of splats of a block.
        segment: Largest number of rows that are sorted at a time.
        blocks: Number of blocks, about.
        memory: Peak memory of a process, bytes, Python and its libraries included.
        scratch: Size of the intermediate files at the end, bytes, the result included.
        seconds: About how long, on one processor like the one it was measured on.
    """

    splats: int
    block: int
    segment: int
    blocks: int
    memory: int
    scratch: int
    seconds: float

    def unpacking(
        self, cost: Cost, max_memory: int | None, limit: MemoryLimit = MemoryLimit.GIVEN
    ) -> "BlockPlan":
        """Return the plan with the cost of unpacking the inputs first.

        Args:
            cost: Of unpacking.
            max_memory: Bytes that a process may take; not needed if the block size is given.
            limit: The reason for this number.

        Raises:
            OptionError: The memory is too little.
        """
        if max_memory is not None and cost.memory > _bytes_for_splats(max_memory):
            raise OptionError(
                f"{_must_be(_least(cost.memory), max_memory, limit)} to unpack {cost.path}; allow"
                " more, or convert the file to .ply."
            )
        memory = max(self.memory, LIBRARIES + cost.memory)
        return replace(self, memory=memory, scratch=self.scratch + cost.scratch)


def plan_blocks(
    splats: int,
    layout: Layout,
    parameters: ForestParameters,
    shares: tuple[float, ...],
    max_memory: int | None,
    block: int | None = None,
    block_layout: Chunked | Linked | None = None,
    *,
    beside: int = 0,
    limit: MemoryLimit = MemoryLimit.GIVEN,
    searched: bool = False,
    shown: bool = False,
) -> BlockPlan:
    """Plan blocks as large as the memory allows.

    Args:
        splats: Rows that filters leave of all inputs.
        layout: Of their columns.
        parameters: Of the method.
        shares: Share of the splats that each result keeps.
        max_memory: Bytes that a process may take; not needed if `block` is given.
        block: Splats of a block, in place of what memory allows.
        block_layout: How results are divided or linked, or None if each is one file.
        beside: Bytes that the process holds besides its task.
        limit: The reason for `max_memory`.
        searched: Whether the count of the result is searched for.
        shown: Whether it is kept how much the values of fitted results show.

    Raises:
        OptionError: The memory is too little for any block.
    """
    row, share, encoding = row_bytes(layout), max(shares), Encoding()
    if block_layout is not None:
        encoding = block_layout.encoding(row, layout.sh_degree, splats, shares)
    if block is None:
        available = _bytes_for_splats(max_memory or 0) - beside
        largest = _largest_block(available, splats, layout, parameters, share)
        block = encoding.most(available, largest)
        if block < min(_LEAST, splats):
            tasks = held_bytes(_LEAST, splats, layout, parameters, share)
            least = _least(beside + max(tasks, encoding.held(_LEAST)))
            raise OptionError(
                f"{_must_be(least, max_memory or 0, limit)} for blocks of this model, of which"
                f" {LIBRARIES / 1e6:,.0f} MB are for Python and its libraries{encoding.remedy()}"
            )
    segment = max(min(block, _SEGMENT), 1)
    sorting = min(segment, splats) * (row + _KEYS)
    blocks = -(-splats // max(block - block // 16, 1))
    held = min(block, splats)
    tasks = held_bytes(held, splats, layout, parameters, share)
    scratch = scratch_bytes(
        splats, block, blocks, layout, parameters, shares,
        encoded=block_layout is not None, searched=searched, shown=shown,
    )  # fmt: skip
    return BlockPlan(
        splats=splats,
        block=block,
        segment=segment,
        blocks=blocks,
        memory=LIBRARIES + beside + int(max(tasks, sorting, encoding.held(held))),
        scratch=scratch,
        seconds=splats * _seconds(parameters, len(shares))
        + blocks * _block_seconds(parameters)
        + encoding.seconds,
    )


def _seconds(parameters: ForestParameters, levels: int) -> float:
    """Return the seconds of one processor for each splat."""
    looked = _LOOKED * renders(parameters) + _STEP * parameters.steps
    return _SECONDS + levels * looked + (levels - 1) * _LEVEL_SECONDS


def _block_seconds(parameters: ForestParameters) -> float:
    """Return the seconds of one processor for each block, beside those of its splats."""
    view = _VIEW + _PIXEL * parameters.view_size**2
    return view * (parameters.views + parameters.further) * renders(parameters)


def _bytes_for_splats(max_memory: int) -> float:
    """Return the bytes available for splats, of those that a process may take."""
    return _SHARE * max_memory - LIBRARIES


def _must_be(least: float, allowed: int, limit: MemoryLimit) -> str:
    """Return the beginning of a message on a memory limit that is too low."""
    known = limit.format(f"{allowed / 1e6:,.0f} MB")
    return f"{known} and must be at least {ceil(least / 1e6):,} MB"


def _least(held: float) -> float:
    """Return the memory limit, bytes, under which a process can hold `held` bytes of splats."""
    return (LIBRARIES + held) / _SHARE


def held_bytes(
    block: int, splats: int, layout: Layout, parameters: ForestParameters, share: float
) -> int:
    """Return the peak bytes of any task of a block, without the libraries; see `block_stages`."""
    return max(block_stages(block, splats, layout, parameters, share).values())


def _largest_block(
    available: float, splats: int, layout: Layout, parameters: ForestParameters, share: float
) -> int:
    """Return the most splats of a block whose tasks hold at most `available` bytes; 0 for none."""
    low, high = 0, 2 * splats  # above the number of splats: one block
    while low < high:
        middle = (low + high + 1) // 2
        fits = held_bytes(middle, splats, layout, parameters, share) <= available
        low, high = (middle, high) if fits else (low, middle - 1)
    return low
