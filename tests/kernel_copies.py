"""Caches of compiled kernels in which a few are missing: compiling all takes half a minute."""

import os
import shutil
import subprocess
import sys

from nanogs.kernels.needed import needed

FOLDERS = "from nanogs.kernels.needed import *; print(*(one.folder for one in needed()), sep='\\n')"


def copy_kernels(cache, missing):
    """Copy this process's cache of kernels, but for some, to be another's NUMBA_CACHE_DIR.

    Args:
        cache: The new folder.
        missing: How the names of the missing kernels begin.

    Returns:
        Those kernels of the table that are missing.
    """
    theirs = subprocess.run(
        [sys.executable, "-c", FOLDERS], env=os.environ | {"NUMBA_CACHE_DIR": str(cache)},
        capture_output=True, text=True, check=True,
    ).stdout.splitlines()  # fmt: skip
    ours = [one.folder for one in needed()]
    for folder, target in dict(zip(ours, theirs, strict=True)).items():
        shutil.copytree(folder, target, dirs_exist_ok=True)
    for index in cache.rglob("*.nbi"):
        if index.name.startswith(missing):
            index.unlink()
    return [one for one in needed() if one.name.startswith(missing)]
