"""How many blocks a job takes, how much memory and disk, and about how long; computed, not tried.

No Numba here: `--dry-run` uses it.
"""

from dataclasses import dataclass, replace

from nanogs.errors import OptionError
from nanogs.io.files import splat_bytes
from nanogs.lod.streamed_sog import CHUNKS_A_FILE
from nanogs.scale.columns import row_bytes
from nanogs.scale.settings import MOST_SEEN, SOG, TILES, Chunks, Layout
from nanogs.simplify.memory import LIBRARIES, plan_memory
from nanogs.simplify.presets import ForestParameters

_MANY = 1_000_000
_KEYS = 96  # bytes a row of a segment: codes, order, centres and scales in the making
_SEGMENT = 1 << 21  # rows; more make sorting no faster
_LEAST = 4096  # splats of a block
_SHARE = 0.95  # of the memory is planned with
_SECONDS = 6.5e-6  # a splat, of one processor (`docs/scale.md`), and for each further level:
_LEVEL_SECONDS = 2.5e-6
_PLACES = 4 * 8  # bytes a group: its centre and reach
_PLACED = 24  # bytes a splat of a block's level: its cell and place
# Making the files of chunks (measured): bytes for each byte of the splats that go into one, bytes
# for its pictures, and seconds a splat of one processor without and with higher coefficients.
_ENCODED = {SOG: 6.0, TILES: 2.5}
_PICTURES = 16_000_000
_ENCODING = {SOG: (9e-6, 7e-5), TILES: (1e-6, 1e-6), "spz": (2e-6, 4e-6)}


@dataclass(frozen=True, slots=True)
class ScalePlan:
    """What a job takes.

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


def in_blocks(parameters: ForestParameters) -> ForestParameters:
    """The parameters that blocks are simplified with: nothing is rendered."""
    return replace(parameters, measure=False, recolour=False, refit=False)


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
    encoded, kept = encoding_bytes(layout, chunks, splats, max(shares)), 0.0
    if chunks:
        kept = min(1.0, 2 * max(shares)) * (row + _PLACED)
    if block is None:
        room = _SHARE * (max_memory or 0) - LIBRARIES
        block = int(room / each)
        if chunks:
            block = max(min(block, int((room - encoded) / kept)), 0)
        if block < _LEAST:
            least = (LIBRARIES + max(_LEAST * each, encoded + _LEAST * kept)) / _SHARE
            raise OptionError(
                f"--max-memory must be at least {least / 1e6:,.0f} MB for this model, of which"
                f" {LIBRARIES / 1e6:,.0f} MB are for Python and its libraries"
                + (
                    f" and {encoded / 1e6:,.0f} MB for a file of chunks: a smaller --chunk takes"
                    " less."
                    if chunks
                    else "."
                )
            )
    segment = max(min(block, _SEGMENT), 1)
    blocks = -(-splats // max(block - block // 16, 1))
    results = sum(int(share * splats) for share in shares)
    sorted_rows = splats * (row + 8)
    tables = splats * (12 + len(shares) * 2 * 4) + results * (2 * row + _PLACES)
    return ScalePlan(
        splats=splats,
        block=block,
        segment=segment,
        blocks=blocks,
        memory=LIBRARIES
        + int(
            max(
                min(block, splats) * each,
                segment * (row + _KEYS),
                encoded + min(block, splats) * kept,
            )
        ),
        scratch=sorted_rows + tables,
        seconds=splats * (_SECONDS + _LEVEL_SECONDS * (len(shares) - 1))
        + results * encoding_seconds(layout, chunks),
    )


def encoding_bytes(layout: Layout, chunks: Chunks | None, splats: int, share: float) -> float:
    """Most bytes that the making of one file of chunks takes.

    Args:
        layout: Of the columns.
        chunks: What is made.
        splats: Of the whole model.
        share: What the finest result keeps of them.
    """
    if chunks is None:
        return 0.0
    at_once = CHUNKS_A_FILE if chunks.layout == SOG else 1
    splats_at_once = min(at_once * chunks.most, splats * share)
    return _PICTURES + splats_at_once * _ENCODED[chunks.layout] * row_bytes(layout)


def encoding_seconds(layout: Layout, chunks: Chunks | None) -> float:
    """Seconds of a processor for a splat of the results."""
    if chunks is None:
        return 0.0
    form = "spz" if chunks.spz else chunks.layout
    return _ENCODING[form][bool(layout.sh_degree)]


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
