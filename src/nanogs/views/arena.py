"""A memory arena for projected splats, in pages that parts of images allocate and free.

So the memory in use never exceeds the budget, for any distribution of the splats over the parts.
"""

import numpy as np

from nanogs._types import F32, F64, I64
from nanogs.kernels.listing import list_tiles
from nanogs.kernels.radix import sorted_rows
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import Projection

_HELD = 88  # bytes of a projected splat: geometry, features and its box
# Extra bytes while a part is drawn: for a splat's row, keys and order; for an entry of a tile list.
_SORTED, _ENTRY = 48, 4
_FEW = 2  # assumed number of tiles of a splat, if one part uses the whole arena
_MOST_PAGE, _LEAST_PAGES = 4096, 64  # most splats of a page, and least number of pages


class Arena:
    """A paged memory arena for projected splats.

    Attributes:
        bytes: The budget, which includes the memory for drawing one part.
        page: Number of splats of a page.
    """

    def __init__(self, budget: int, count: int, parts: int) -> None:
        """Allocate the arena; the system commits its memory only when it is written.

        Args:
            budget: Bytes in all.
            count: Most splats of a part.
            parts: Most parts that are gathered at once.
        """
        self.bytes = budget
        planned = max(budget // (_HELD + _SORTED + _FEW * _ENTRY), 1)
        self.page = max(1, min(_MOST_PAGE, planned // _LEAST_PAGES))
        pages = min(planned // self.page, (count // self.page + 1) * parts)
        self._capacity = pages * self.page
        self._working = budget - _HELD * planned
        self._geometry = np.empty((self._capacity, 8), np.float64)
        self._features = np.empty((self._capacity, 4), np.float32)
        self._boxes = np.empty(self._capacity, np.int64)
        self._free = list(range(pages))[::-1]

    def needed_share(self, count: int, tiles: int) -> float:
        """Return the memory of a part over that of the arena; a part can be drawn up to 1.

        Args:
            count: Number of splats of the part.
            tiles: Number of tile list entries of these.
        """
        pages = -(-count // self.page) * self.page
        working = count * _SORTED + tiles * _ENTRY
        return max(pages / self._capacity, working / max(self._working, 1))

    def take(self, pages: int) -> list[int] | None:
        """Allocate pages; None if not enough are free."""
        if pages > len(self._free):
            return None
        return [self._free.pop() for _ in range(pages)]

    def give(self, pages: list[int]) -> None:
        """Free pages, and clear the list."""
        self._free += pages
        pages.clear()

    def places(self, pages: list[int], start: int, stop: int) -> I64:
        """Return the (stop - start,) rows of the arena of splats `start` to `stop` on the pages."""
        numbers = np.arange(start, stop)
        at, numbers = np.divmod(numbers, self.page)
        numbers += np.array(pages, np.int64)[at] * self.page
        return numbers

    def put(self, places: I64, geometry: F64, features: F32, boxes: I64) -> None:
        """Write projected splats, (M, ...) arrays as in `Projection`, to rows of the arena."""
        self._geometry[places], self._features[places] = geometry, features
        self._boxes[places] = boxes

    def projection(self, pages: list[int], count: int, camera: Camera) -> Projection:
        """Return the first `count` splats on the pages, sorted by depth and then by page order."""
        places = self.places(pages, 0, count)
        keys = self._features[places, 3].view(np.uint32).astype(np.uint64)
        keys <<= np.uint64(32)
        keys |= np.arange(count, dtype=np.uint64)
        order = places[sorted_rows(keys)]
        del keys, places
        starts, entries = list_tiles(
            self._geometry, self._boxes, order, camera.width, camera.height
        )
        return Projection(self._geometry, self._boxes, self._features, order, starts, entries)
