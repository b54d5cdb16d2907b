"""`keep_freed_memory`: memory that is freed and allocated again causes no new page faults."""

import platform
import subprocess
import sys

import pytest

FAULTS = """
import sys
from resource import RUSAGE_SELF, getrusage

import numpy as np

if sys.argv[1] == "kept":
    from nanogs.allocation import keep_freed_memory

    keep_freed_memory()

def faults(size):
    before = getrusage(RUSAGE_SELF).ru_minflt
    for _ in range(8):
        np.empty(size, np.uint8).fill(1)
    return getrusage(RUSAGE_SELF).ru_minflt - before

for size in (40 << 20, 100 << 20):
    faults(size)
    print(faults(size))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other libraries do as they do")
def test_memory_of_40_mb_is_kept_and_memory_of_100_mb_is_returned():
    page_faults = {}
    for mode in ("usual", "kept"):
        result = subprocess.run(
            [sys.executable, "-c", FAULTS, mode], capture_output=True, check=True, text=True
        )
        page_faults[mode] = list(map(int, result.stdout.split()))
    # At least one page fault for each array, whether pages are huge or small.
    assert page_faults["usual"][0] >= 8
    assert page_faults["kept"][0] < 8
    assert page_faults["kept"][1] >= 8
