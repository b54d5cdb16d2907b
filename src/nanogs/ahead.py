"""Compile ahead: on a first run, a second process compiles what the first will need later.

Numba compiles one function at a time in a process, and half of what a preset that renders takes
to compile is needed only once the original has been looked at. Both put what they compiled into
the same cache on disk. Should the second be late or fail, the first compiles for itself.
"""

import atexit
import os
import subprocess
import sys
from functools import cache

from nanogs.cleanup import clean_at_end, undisturbed


@cache
def compile_ahead() -> None:
    """Start the second process, where there is a processor for it; it ends with this one.

    Called again, it does nothing.
    """
    if (os.cpu_count() or 1) < 2:
        return
    with undisturbed():
        process = subprocess.Popen(
            [sys.executable, "-m", "nanogs.ahead"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        clean_at_end(process.kill)
    atexit.register(process.kill)  # the cache's files are written beside their places and renamed


def compile_later_stages() -> None:
    """Run what follows the look at the original, on a model of no importance."""
    import numpy as np

    import nanogs
    from nanogs.datasets.synthetic import make_scene
    from nanogs.method.match import match
    from nanogs.metrics import ssim

    nanogs.simplify(make_scene(200), ratio=0.1, preset="fast", rounds=1)
    chain = np.arange(1000, dtype=np.int32)  # of which rounds leave most to the sorted walk
    match(np.stack((chain[:-1], chain[1:])).T, chain[1:].astype(np.float32), 1000, 500)
    grey = np.zeros((16, 16), np.float32)
    ssim(grey, grey)


def compile_fitting() -> None:
    """Fit a model of no importance, once the first process has compiled how to render."""
    import nanogs
    from nanogs.datasets.synthetic import make_scene

    scene = make_scene(200)
    nanogs.simplify(scene, ratio=0.1, preset="fast", steps=1, views=2, view_size=16)


if __name__ == "__main__":
    compile_later_stages()
    compile_fitting()
