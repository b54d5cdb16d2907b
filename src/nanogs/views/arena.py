"""Memory for projected splats: one piece of it, in pages that parts of pictures take and give back.

So what is held never exceeds what was set aside, however the splats fall to the parts.
"""

import numpy as np

from nanogs._types import F32, F64, I64
from nanogs.kernels.listing import list_tiles
from nanogs.kernels.radix import sorted_rows
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import Projection

_HELD = 88  # bytes of a projected splat: geometry, features and its box
_SORTED, _ENTRY = 48, 4  # and while a part is drawn: its place, keys and order; in a tile's list
_FEW = 2  # tiles of a splat, where all the room is one part's
_MOST_PAGE, _LEAST_PAGES = 4096, 64  # splats of a page, and how many pages there are at least


class Arena:
    """Room for projected splats.

    Attributes:
        bytes: What is set aside, with what it takes to draw any one part.
        page: Splats of a page.
    """

    def __init__(self, budget: int, count: int, parts: int) -> None:
        """Set memory aside; it counts as used only once it is filled.

        Args:
            budget: Bytes.
            count: Splats of a part at most.
            parts: How many parts are gathered at once, at most.
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

    def times(self, count: int, tiles: int) -> float:
        """How many times what may be held at once a part takes; it may be drawn up to 1.

        Args:
            count: Its splats.
            tiles: The tiles that these have in all.
        """
        pages = -(-count // self.page) * self.page
        working = count * _SORTED + tiles * _ENTRY
        return max(pages / self._capacity, working / max(self._working, 1))

    def take(self, pages: int) -> list[int] | None:
        """So many free pages; None where there are not enough."""
        if pages > len(self._free):
            return None
        return [self._free.pop() for _ in range(pages)]

    def give(self, pages: list[int]) -> None:
        """Give pages back."""
        self._free += pages
        pages.clear()

    def places(self, pages: list[int], start: int, stop: int) -> I64:
        """(stop - start,) rows of the room in which some of the splats on these pages are."""
        numbers = np.arange(start, stop)
        at, numbers = np.divmod(numbers, self.page)
        numbers += np.array(pages, np.int64)[at] * self.page
        return numbers

    def put(self, places: I64, geometry: F64, features: F32, boxes: I64) -> None:
        """Write projected splats, (M, ...) as `Projection` has them, to rows of the room."""
        self._geometry[places], self._features[places] = geometry, features
        self._boxes[places] = boxes

    def projection(self, pages: list[int], count: int, camera: Camera) -> Projection:
        """The first splats on these pages, in the order of depth and then of the pages."""
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
