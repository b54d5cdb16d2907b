"""How much memory there is for the splats of pictures, where models are not held. No Numba here."""

from collections.abc import Sequence

from nanogs.memory import Memory, refuse_too_large
from nanogs.needs import streaming_bytes
from nanogs.source import Source

LEAST = 32_000_000  # bytes: a tile of a picture may draw some hundred thousand splats


def room_for_splats(
    what: str, models: Sequence[Source], pictures: int, memory: Memory, remedy: str
) -> int:
    """Bytes for the splats that pictures draw, where models are read some rows at a time.

    Args:
        what: The work, to begin a sentence.
        models: Read one after the other.
        pictures: Bytes of the pictures that are held.
        memory: What the work may take.
        remedy: What to do where that is too little, to end the sentence.

    Raises:
        FormatError: A file cannot be read.
        NotEnoughMemoryError: There is too little.
    """
    each = [streaming_bytes(model) for model in models]
    others = pictures + max(held for held, _ in each)
    first = max(before for _, before in each)
    refuse_too_large(what, others + max(first, LEAST), memory, remedy)
    return memory.bytes - others
