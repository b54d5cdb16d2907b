"""Settings of glibc's allocator for processes that render.

Each view allocates arrays as large as those of the view before. glibc gives them back to the system
when they are freed, which clears the memory before it hands it out anew: a tenth of the time of
`default` on a million splats. A setting holds for the whole process, so it is made in processes of
our own alone, and in those that render: to pack a file takes a tenth more memory with it.
"""

import ctypes
import sys

_TRIM, _MMAP = -1, -3  # M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of glibc's malloc.h
_KEPT = 512 << 20  # bytes that may lie free at the end of the heap
# Larger arrays are not of a view, and go back at once. Older versions of glibc refuse more than
# half of a heap, which is 64 MiB there.
_LARGEST = (64 << 20, 32 << 20)


def keep_freed_memory() -> None:
    """Have this process keep what it frees; without glibc, do nothing."""
    if sys.platform != "linux":
        return
    library = ctypes.CDLL(None)
    # With the second setting alone, glibc would keep less than with neither.
    if hasattr(library, "gnu_get_libc_version") and any(
        library.mallopt(_MMAP, largest) for largest in _LARGEST
    ):
        library.mallopt(_TRIM, _KEPT)
