"""Settings of glibc's allocator for processes that render.

Each view allocates arrays of the same sizes as the view before. glibc returns freed ones to the
system, which zeroes memory before it hands it out again: a tenth of the time of `default` on a
million splats. A setting applies to the whole process, so it is made only in processes that nanogs
starts itself and that render: with it, packing a file takes a tenth more memory.
"""

import ctypes
import sys

_TRIM, _MMAP = -1, -3  # M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of glibc's malloc.h
_KEPT = 512 << 20  # bytes that may stay free at the end of the heap
# Larger arrays do not belong to a view, and are returned at once. Older versions of glibc refuse
# more than half of a heap, which is 64 MiB there.
_LARGEST = (64 << 20, 32 << 20)


def keep_freed_memory() -> None:
    """Make this process keep freed memory instead of returning it; without glibc, do nothing."""
    if sys.platform != "linux":
        return
    library = ctypes.CDLL(None)
    # With the second setting alone, glibc would keep less than with neither.
    if hasattr(library, "gnu_get_libc_version") and any(
        library.mallopt(_MMAP, largest) for largest in _LARGEST
    ):
        library.mallopt(_TRIM, _KEPT)
