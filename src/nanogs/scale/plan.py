"""How many blocks a job takes, how much memory and disk, and about how long; computed, not tried.

No Numba here: `--dry-run` uses it.
"""

from dataclasses import dataclass, replace
from typing import TypeGuard

from nanogs.errors import OptionError
from nanogs.io.files import splat_bytes
from nanogs.memory import LIBRARIES
from nanogs.method.parameters import ForestParameters
from nanogs.pipeline.memory import plan_memory
from nanogs.pipeline.presets import PRESETS, Parameters
from nanogs.scale.columns import row_bytes
from nanogs.scale.encoding import encoding_of
from nanogs.scale.settings import MOST_SEEN, Chunks
from nanogs.scale.unpack import Cost
from nanogs.source import Layout

_MANY = 1_000_000
_KEYS = 96  # bytes a row of a segment: codes, order, centres and scales in the making
_SEGMENT = 1 << 21  # rows; more make sorting no faster
_LEAST = 4096  # splats of a block
_SHARE = 0.95  # of the memory is planned with
_SECONDS = 6.5e-6  # a splat, of one processor (`docs/scale.md`), and for each further level:
_LEVEL_SECONDS = 2.5e-6
_PLACES = 4 * 8  # bytes a group: its centre and reach


@dataclass(frozen=True, slots=True)
class ScalePlan:
    """Blocks, memory, disk and time that a job takes.

    Attributes:
        splats: Rows of all inputs.
        block: Most splats of a block.
        segment: Most rows that are sorted at a time.
        blocks: About how many blocks.
        memory: The most that a process takes, bytes, Python and its libraries included.
        scratch: Intermediate files at the end, bytes, the result among them.
        seconds: About how long, of one processor like that it was measured on.
    """

    splats: int
    block: int
    segment: int
    blocks: int
    memory: int
    scratch: int
    seconds: float

    def unpacking(self, cost: Cost, max_memory: int | None) -> "ScalePlan":
        """Add what it takes to unpack the inputs first.

        Args:
            cost: Of that.
            max_memory: Bytes that a process may take; not needed where blocks are given.

        Raises:
            OptionError: That is too little.
        """
        if max_memory is not None and cost.memory > _room(max_memory):
            raise OptionError(
                f"{_must_be(_least(cost.memory), max_memory)} to unpack {cost.path}; raise it, or"
                " convert the file to .ply."
            )
        memory = max(self.memory, LIBRARIES + cost.memory if cost.memory else 0)
        return replace(self, memory=memory, scratch=self.scratch + cost.scratch)


SHORT = ForestParameters().steps  # of a fit that is left out where nothing is rendered


def can_do_without_renders(parameters: Parameters) -> TypeGuard[ForestParameters]:
    """Whether a method can be done in blocks at all: not where a long fit is what was asked for."""
    return isinstance(parameters, ForestParameters) and parameters.steps <= SHORT


def wish_to_render(preset: str, parameters: Parameters) -> str:
    """Name what cannot be done without renders: the preset, or a longer fit than its own."""
    own = PRESETS[preset]
    if (
        isinstance(parameters, ForestParameters)
        and isinstance(own, ForestParameters)
        and parameters.steps != own.steps
    ):
        return f"a fit of {parameters.steps} steps"
    return f"the preset {preset}"


def in_blocks(parameters: ForestParameters) -> ForestParameters:
    """The parameters that blocks are simplified with: nothing is rendered."""
    return replace(parameters, measure=False, steps=0)


def plan_blocks(
    splats: int,
    layout: Layout,
    parameters: ForestParameters,
    shares: tuple[float, ...],
    max_memory: int | None,
    block: int | None = None,
    chunks: Chunks | None = None,
) -> ScalePlan:
    """Blocks as large as the memory allows.

    Args:
        splats: Rows of all inputs.
        layout: Of their columns.
        parameters: Of the method.
        shares: What the results keep of the splats.
        max_memory: Bytes that a process may take; not needed where `block` is given.
        block: Splats of a block, in place of what memory allows.
        chunks: Of the results, or None where each is one file.

    Raises:
        OptionError: The memory is too little for any block.
    """
    row, each = row_bytes(layout), held_bytes(layout, parameters, max(shares))
    encoding = encoding_of(row, layout.sh_degree, chunks, splats, shares)
    if block is None:
        room = _room(max_memory or 0)
        block = encoding.most(room, int(room / each))
        if block < _LEAST:
            least = _least(max(_LEAST * each, encoding.held(_LEAST)))
            raise OptionError(
                f"{_must_be(least, max_memory or 0)} for blocks of this model, of which"
                f" {LIBRARIES / 1e6:,.0f} MB are for Python and its libraries{encoding.remedy()}"
            )
    segment = max(min(block, _SEGMENT), 1)
    blocks = -(-splats // max(block - block // 16, 1))
    held = min(block, splats)
    results = sum(int(share * splats) for share in shares)
    sorted_rows = splats * (row + 8)
    copies = 3 if chunks else 2  # parts, what is encoded of them, and the result
    tables = splats * (12 + len(shares) * 2 * 4) + results * (copies * row + _PLACES)
    return ScalePlan(
        splats=splats,
        block=block,
        segment=segment,
        blocks=blocks,
        memory=LIBRARIES + int(max(held * each, segment * (row + _KEYS), encoding.held(held))),
        scratch=sorted_rows + tables,
        seconds=splats * (_SECONDS + _LEVEL_SECONDS * (len(shares) - 1)) + encoding.seconds,
    )


def _room(max_memory: int) -> float:
    """Bytes that are there for splats, of those that a process may take."""
    return _SHARE * max_memory - LIBRARIES


def _must_be(least: float, allowed: int) -> str:
    """The beginning of a sentence about a limit, which the user or the system has set."""
    return (
        f"`max_memory`, or without it what is free, is {allowed / 1e6:,.0f} MB and must be at least"
        f" {least / 1e6:,.0f} MB"
    )


def _least(held: float) -> float:
    """Bytes that a process must be allowed to take for so many of splats."""
    return (LIBRARIES + held) / _SHARE


def held_bytes(layout: Layout, parameters: ForestParameters, share: float) -> float:
    """Most bytes for each splat of a block that any stage holds.

    Args:
        layout: Of the columns.
        parameters: Of the method.
        share: What the result keeps of the splats of a block; one block can keep more than others.
    """
    extra = row_bytes(layout) - splat_bytes(layout.sh_degree)
    kept = int(min(1.0, 2 * share) * _MANY)
    held = plan_memory(_MANY, layout.sh_degree, extra, in_blocks(parameters), kept)
    codes = 2 * 8  # and their order
    seen = 1 + MOST_SEEN if parameters.rounds else 1
    return (held.peak / _MANY + codes) * seen
