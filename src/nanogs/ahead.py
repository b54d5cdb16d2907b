"""Compile ahead: on a first run, other processes compile what the first will need later.

Numba compiles one function at a time in a process. So others begin with what is needed last, while
the first compiles what it comes to, until they meet. All put what they compiled into the same cache
on disk, and none compiles what another is at. Should one fail, the first compiles for itself.
"""

import atexit
import gc
import os
import subprocess
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path

from nanogs.cleanup import clean_at_end, undisturbed
from nanogs.threads import processors

_MOST = 3  # processes beside the first: more would wait for the longest kernel


@cache
def compile_ahead(preset: str) -> None:
    """Start the others, where there are processors for them; they end with this process.

    Called again, it does nothing.

    Args:
        preset: See `nanogs.kernels.needed`.
    """
    for _ in range(min(processors() - 1, _MOST)):
        with undisturbed():
            process = subprocess.Popen(  # noqa: S603 - itself
                [sys.executable, "-m", "nanogs.ahead", preset],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            clean_at_end(process.kill)
        atexit.register(process.kill)  # the cache's files are written beside their places, renamed


def nothing_compiled() -> bool:
    """Whether surely no kernel is on the disk, told without Numba, whose import takes a while.

    Where kernels may lie elsewhere it is False; then the first that is missing tells.
    """
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        return False
    named = os.environ.get("NUMBA_CACHE_DIR")
    if named:
        return not any(Path(named).glob("kernels_*/*.nbi"))
    folder = Path(__file__).parent / "kernels"
    return os.access(folder, os.W_OK) and not any(folder.glob("__pycache__/*.nbi"))


def compile_from_the_end(preset: str) -> None:
    """Compile what nobody has compiled or is at, what is needed last first."""
    from nanogs.kernels.needed import needed

    for one in reversed(needed(preset)):
        with suppress(Exception):  # whoever needs it says what is wrong
            one.compile(wait=False)


if __name__ == "__main__":
    gc.disable()  # what has been compiled stays
    compile_from_the_end(sys.argv[1])
