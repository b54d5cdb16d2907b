"""Compile ahead: on a first run, helper processes compile the kernels that are needed later.

Numba compiles one function at a time in a process. So while the main process compiles kernels as it
needs them, helpers compile them in the reverse order. All share one cache on disk, and no process
compiles a kernel that another one is compiling. If a helper fails, the main process compiles the
kernel itself.
"""

import atexit
import gc
import os
import subprocess
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path

from nanogs.cleanup import defer_exit, on_signal
from nanogs.kernels.compiling import when_compiling
from nanogs.threads import processors

_MOST = 3  # helper processes: more would only wait for the longest kernel


def prepare_kernels(preset: str) -> None:
    """Call `compile_ahead` now if no kernel is cached, or else when one has to be compiled."""
    if nothing_compiled():
        compile_ahead(preset)
    else:
        when_compiling(lambda: compile_ahead(preset))


@cache
def compile_ahead(preset: str) -> None:
    """Start the helper processes, if there are processors for them; they end with this process.

    Further calls for the same preset do nothing.

    Args:
        preset: Preset whose kernels are compiled; see `nanogs.kernels.needed`.
    """
    for _ in range(min(processors() - 1, _MOST)):
        with defer_exit():
            process = subprocess.Popen(  # noqa: S603 - itself
                [sys.executable, "-m", "nanogs.ahead", preset],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            on_signal(process.kill)
        # Killing is safe: files of the cache are written under another name and then renamed.
        atexit.register(process.kill)


def nothing_compiled() -> bool:
    """Return whether the cache on disk certainly holds no kernel; does not import Numba.

    False if the cache may be in another folder; then the first missing kernel starts the
    compilation ahead.
    """
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        return False
    named = os.environ.get("NUMBA_CACHE_DIR")
    if named:
        return not any(Path(named).glob("kernels_*/*.nbi"))
    folder = Path(__file__).parent / "kernels"
    return os.access(folder, os.W_OK) and not any(folder.glob("__pycache__/*.nbi"))


def compile_from_the_end(preset: str) -> None:
    """Compile all kernels that are neither cached nor being compiled, in reverse order of need."""
    from nanogs.kernels.needed import needed

    for one in reversed(needed(preset)):
        with suppress(Exception):  # the main process reports the error when it needs the kernel
            one.compile(wait=False)


if __name__ == "__main__":
    gc.disable()  # compiled code is never freed anyway
    compile_from_the_end(sys.argv[1])
