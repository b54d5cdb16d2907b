"""Photographs as views, read one at a time."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, overload

from nanogs.protocol import Background
from nanogs.raster.camera import Camera

if TYPE_CHECKING:  # these import Numba
    from nanogs.datasets.dataset import Dataset
    from nanogs.datasets.frame import Frame
    from nanogs.scoring.scores import ReferenceView


class PhotoViews(Sequence["ReferenceView"]):
    """Photographs as views, each read on access, because hundreds would not fit in memory."""

    def __init__(
        self, dataset: "Dataset", frames: "Sequence[Frame]", background: Background
    ) -> None:
        self._dataset = dataset
        self._frames = tuple(frames)
        self._background = background

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras of the views; no photograph is read."""
        return tuple(frame.camera for frame in self._frames)

    def __len__(self) -> int:
        return len(self._frames)

    @overload
    def __getitem__(self, index: int) -> "ReferenceView": ...
    @overload
    def __getitem__(self, index: slice) -> "PhotoViews": ...
    def __getitem__(self, index: int | slice) -> "ReferenceView | PhotoViews":
        from nanogs.scoring.scores import ReferenceView

        if isinstance(index, slice):
            return PhotoViews(self._dataset, self._frames[index], self._background)
        frame = self._frames[index]
        return ReferenceView(frame.camera, self._dataset.load_photo(frame, self._background))

    def __iter__(self) -> "Iterator[ReferenceView]":
        return (self[index] for index in range(len(self)))
