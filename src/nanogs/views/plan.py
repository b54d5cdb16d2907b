"""Memory budget for the splats of images when a model is streamed. Does not import Numba."""

from collections.abc import Sequence

from nanogs.memory import Memory, allowed_memory, refuse_too_large
from nanogs.memory_estimates import (
    drawn_bytes,
    models_bytes,
    pictures_bytes,
    shown_bytes,
    streaming_bytes,
)
from nanogs.protocol import PIXELS, VIEWS
from nanogs.raster.camera import Camera
from nanogs.source import Source, source_of
from nanogs.splats import Splats

LEAST = 32_000_000  # least budget, bytes: a tile may draw some hundred thousand splats

FEWER_CAMERAS = "give fewer cameras or smaller ones, or automatic views"  # a remedy


def rendering_remedy(wanted: str | Sequence[Camera]) -> str:
    """Return what helps if rendering takes too much memory, as the end of a message.

    Args:
        wanted: Cameras, which have sizes of their own, or the kind of automatic views.
    """
    if isinstance(wanted, str):
        return "render smaller pictures (`pixels`) or a smaller model"
    return f"{FEWER_CAMERAS}, or render a smaller model"


def budget_for_pictures(
    model: Splats | Source,
    pixels: int,
    views: int,
    max_memory: int | None,
    *,
    photographs: int = 0,
    remedy: str,
) -> int | None:
    """Compute the budget for the splats of images, if a model does not fit and must be streamed.

    Args:
        model: The model.
        pixels: Number of pixels of the largest view.
        views: Number of images that are kept.
        max_memory: Bytes that this process may use; by default the free memory, less a tenth.
        photographs: Bytes of photographs that will be held too.
        remedy: Advice if there is not enough, as the end of the message.

    Returns:
        Bytes, or None if the model fits.

    Raises:
        NotEnoughMemoryError: There is not enough memory even for streaming.
    """
    given, memory = max_memory is not None, allowed_memory(max_memory)
    pictures = photographs + shown_bytes(pixels, views)
    held = models_bytes([model], all_of_it=given)
    if held + drawn_bytes(source_of(model).count) + pictures <= memory.bytes:
        return None
    pictures += held if isinstance(model, Splats) else 0
    read = source_of(model)
    return budget_for_splats(f"Rendering {read.name}", [read], pictures, memory, remedy)


def budget_for_measuring(
    model: Source, max_memory: int | None, remedy: str = "leave out the measurement"
) -> int:
    """Compute the budget for the splats of the views when streamed models are measured.

    Args:
        model: One of the models, which are streamed in turn.
        max_memory: Bytes that this process may use; by default the free memory, less a tenth.
        remedy: What to do without the measurement, as the end of the message.

    Raises:
        NotEnoughMemoryError: There is not enough memory.
    """
    pictures, remedy = pictures_bytes(PIXELS**2, VIEWS), f"provide more, or {remedy}"
    return budget_for_splats("Measuring", [model], pictures, allowed_memory(max_memory), remedy)


def budget_for_splats(
    what: str, models: Sequence[Source], pictures: int, memory: Memory, remedy: str
) -> int:
    """Compute the budget, in bytes, for the splats of images when models are streamed.

    Args:
        what: The work, as the beginning of a message.
        models: The models, which are streamed in turn.
        pictures: Bytes of the images that are held.
        memory: Memory that the work may use.
        remedy: Advice if that is not enough, as the end of the message.

    Raises:
        FormatError: A file cannot be read.
        NotEnoughMemoryError: There is not enough memory.
    """
    each = [streaming_bytes(model) for model in models]
    others = pictures + max(held for held, _ in each)
    first = max(before for _, before in each)
    refuse_too_large(what, others + max(first, LEAST), memory, remedy)
    return memory.bytes - others
