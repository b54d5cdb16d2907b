"""Memory that is freed and taken again is not cleared by the system each time."""

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
    for _ in range(20):
        np.empty(size, np.uint8).fill(1)
    return getrusage(RUSAGE_SELF).ru_minflt - before

for size in (40 << 20, 100 << 20):
    faults(size)
    print(faults(size))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other libraries do as they do")
def test_arrays_of_a_view_are_taken_again_and_larger_ones_given_back():
    found = {}
    for manner in ("usual", "kept"):
        done = subprocess.run(
            [sys.executable, "-c", FAULTS, manner], capture_output=True, check=True, text=True
        )
        found[manner] = list(map(int, done.stdout.split()))
    assert found["usual"][0] >= 20  # at least one a time, of a huge page or a small one
    assert found["kept"][0] < 20
    assert found["kept"][1] >= 20
