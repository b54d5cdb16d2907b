"""The device that renders and fits: selecting it, and the errors if it is not available."""

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING

from nanogs.errors import NotEnoughMemoryError, OptionError

if TYPE_CHECKING:
    from nanogs.card.engine import Engine

CPU, CUDA, AUTO = "cpu", "cuda", "auto"
DEVICES = (CPU, CUDA, AUTO)
WARP_CPU = "warp-cpu"  # the card's kernels on the CPU, in one thread, slow: for tests

_NONE = (
    "No graphics card that CUDA can use was found, or nanogs[cuda] is not installed: the CPU did"
    " its work."
)
_FULL = "Failed to allocate"  # part of Warp's error message if a card has no memory left

_engine: "ContextVar[Engine | None]" = ContextVar("engine", default=None)


@contextmanager
def use_device(name: str | None) -> Iterator[str]:
    """Render and fit on a device within the block (a context manager).

    Args:
        name: "cpu"; "cuda" for a graphics card; "auto" for a graphics card if one can be used, or
            else the CPU; "warp-cpu" to test the card's kernels on the CPU. None keeps the device
            in use.

    Yields:
        The device in use: "cpu", "warp-cpu" or "cuda" with the card's name.

    Raises:
        NotEnoughMemoryError: The block needs more memory than the card has.
        OptionError: There is no such device, no card, or the package that it needs is missing.
    """
    if name is None:
        engine = _engine.get()
        yield CPU if engine is None else engine.name
        return
    engine = _found(name)
    token = _engine.set(engine)
    try:
        yield CPU if engine is None else engine.name
    except RuntimeError as error:
        if engine is None or _FULL not in str(error):
            raise
        raise NotEnoughMemoryError(
            f'The memory of {engine.name} is too small for this model; use `device="cpu"`, or fewer'
            " pixels."
        ) from error
    finally:
        _engine.reset(token)


def check_device(name: str | None) -> None:
    """Raise an error if a device is not available; argument and errors as in `use_device`."""
    with use_device(name):
        pass


def device_notes(asked: str | None, used: str) -> tuple[str, ...]:
    """Return a report's notes on the device: none for the CPU, unless "auto" found no card.

    Args:
        asked: The device that `use_device` was asked for.
        used: The device that it returned.
    """
    if used == CPU:
        return (_NONE,) if asked == AUTO else ()
    return (f"Pictures were made on {used}.",)


def engine_in_use() -> "Engine | None":
    """Return the device that renders and fits; None for the CPU with the Numba kernels."""
    return _engine.get()


def _found(name: str) -> "Engine | None":
    if name not in (*DEVICES, WARP_CPU):
        raise OptionError(f"The device must be {', '.join(DEVICES[:-1])} or {AUTO}, not {name!r}.")
    if name == CPU or (name == AUTO and not (has_driver() and _installed())):
        return None
    if name == CUDA and not has_driver():
        raise OptionError(
            "There is no graphics card that CUDA can use, or its driver is not installed; use"
            ' `device="cpu"`, or `device="auto"`, which uses a card if there is one.'
        )
    if not _installed():
        raise OptionError(f'`device={name}` needs the package Warp: pip install "nanogs[cuda]".')
    from nanogs.card.engine import engine_of

    engine = engine_of("cpu" if name == WARP_CPU else CUDA)
    if engine is None and name == CUDA:
        raise OptionError(
            "Warp finds no graphics card that it can use, although there is a driver; is"
            ' CUDA_VISIBLE_DEVICES hiding it? Otherwise use `device="cpu"`.'
        )
    return engine


def _installed() -> bool:
    from importlib.util import find_spec

    return find_spec("warp") is not None


def has_driver() -> bool:
    """Return whether there is a CUDA driver, without Warp, which prints a warning if not."""
    name = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
    try:
        return int(ctypes.CDLL(name).cuInit(0)) == 0
    except (OSError, AttributeError):
        return False
