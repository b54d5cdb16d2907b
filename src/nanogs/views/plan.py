"""How much memory there is for the splats of pictures, where models are not held. No Numba here."""

from collections.abc import Sequence

from nanogs.io.models import Model
from nanogs.memory import Memory, allowed_memory, refuse_too_large
from nanogs.needs import drawn_bytes, models_bytes, pictures_bytes, shown_bytes, streaming_bytes
from nanogs.protocol import PIXELS, VIEWS
from nanogs.source import Source, source_of
from nanogs.splats import Splats

LEAST = 32_000_000  # bytes: a tile of a picture may draw some hundred thousand splats


_LESS = "free some, or render smaller pictures (`pixels`) or a smaller model"


def room_for_pictures(
    model: Model, source: Splats | Source, pixels: int, views: int, max_memory: int | None
) -> int | None:
    """Bytes for the splats of pictures, where a model does not fit and is read some rows at a time.

    Args:
        model: The model, or its path.
        source: The same, as it is read.
        pixels: Of the largest view.
        views: Pictures that are kept.
        max_memory: Bytes that this process may take; by default what is free, less a tenth.

    Returns:
        None where the model fits.

    Raises:
        FormatError: The path is no model.
        NotEnoughMemoryError: There is too little memory either way.
    """
    given, memory = bool(max_memory), allowed_memory(max_memory)
    pictures = shown_bytes(pixels, views)
    held = models_bytes([model], all_of_it=given)
    if held + drawn_bytes(len(source)) + pictures <= memory.bytes:
        return None
    pictures += held if isinstance(model, Splats) else 0
    name = source_of(source).name
    return room_for_splats(f"Rendering {name}", [source_of(source)], pictures, memory, _LESS)


def room_for_measuring(model: Source, max_memory: int | None) -> int:
    """Bytes for the splats of views that models are held against, read some rows at a time.

    Args:
        model: Any of the models.
        max_memory: Bytes that this process may take; by default what is free, less a tenth.

    Raises:
        NotEnoughMemoryError: There is too little.
    """
    pictures = pictures_bytes(PIXELS**2, VIEWS)
    remedy = "free some, or leave out what is measured"
    return room_for_splats("Measuring", [model], pictures, allowed_memory(max_memory), remedy)


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
