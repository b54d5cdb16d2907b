"""Memory and time for making chunks, computed from measurements of one file."""

from collections.abc import Sequence
from dataclasses import dataclass

from nanogs.lod.streamed_sog import CHUNKS_A_FILE
from nanogs.pipeline.settings import SOG, TILES, Chunks

PLACED = 24  # bytes a splat of a block's level: its cell and place
_OUTSIDE = 12_000_000  # bytes for a file in libraries, beside which a splat has pixels there
_PIXELS = 300
_DESCRIBED = 2 * 8_000  # bytes for what is said of a chunk at all levels; some are but half full
# For a file, in bytes of its splats; then seconds of a processor for a splat, without harmonics of
# higher degrees and with them.
_FILE = {SOG: 6.0, TILES: 2.5}
_SECONDS = {SOG: (1e-5, 8e-5), TILES: (1e-6, 1e-6), "spz": (2e-6, 4e-6)}


@dataclass(frozen=True, slots=True)
class Encoding:
    """Memory and time that a job takes for its chunks; none where it has no chunks.

    Attributes:
        file: Bytes for the file that is being made.
        each: Bytes for each splat of a block.
        described: Bytes for what describes the folder, which is held whole in the end.
        seconds: Of one processor, for all files.
    """

    file: float = 0.0
    each: float = 0.0
    described: float = 0.0
    seconds: float = 0.0

    def held(self, block: int) -> float:
        """Most bytes at any time, with blocks of so many splats."""
        return max(self.file + block * self.each, self.described)

    def most(self, room: float, block: int) -> int:
        """Splats of a block for which there is room, and no more than so many."""
        if self.each == 0:
            return block
        if self.described > room:
            return 0
        return max(min(block, int((room - self.file) / self.each)), 0)

    def remedy(self) -> str:
        """Advice on what takes less, to end a sentence about memory."""
        if self.each == 0:
            return "."
        size = "larger" if self.described > self.file else "smaller"
        return f" and {self.held(0) / 1e6:,.0f} MB for chunks; a {size} `chunk` takes less."


NO_CHUNKS = Encoding()


def encoding_of(
    row: int, degree: int, chunks: Chunks | None, splats: int, shares: Sequence[float]
) -> Encoding:
    """Memory and time for the chunks of some levels.

    Args:
        row: Bytes of a splat.
        degree: Of the spherical harmonics.
        chunks: What is made.
        splats: Of the whole model.
        shares: What the levels keep of them; a block can keep more than others.
    """
    if chunks is None:
        return NO_CHUNKS
    results = sum(int(share * splats) for share in shares)
    at_once = chunks.most * (CHUNKS_A_FILE if chunks.layout == SOG else 1)
    pixels = _PIXELS if chunks.layout == SOG else 0
    form = "spz" if chunks.spz else chunks.layout
    return Encoding(
        file=_OUTSIDE + min(at_once, splats * max(shares)) * (_FILE[chunks.layout] * row + pixels),
        each=min(1.0, 2 * max(shares)) * (row + PLACED),
        described=splats * max(shares) / chunks.most * _DESCRIBED,
        seconds=results * _SECONDS[form][degree > 0],
    )
