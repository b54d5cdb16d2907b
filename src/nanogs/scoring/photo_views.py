"""Photographs as views, read one at a time."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, overload

from nanogs.formatting import counted
from nanogs.protocol import Background
from nanogs.raster.camera import Camera, camera_notes

if TYPE_CHECKING:
    from pathlib import Path

    # these import Numba
    from nanogs.datasets.dataset import Dataset
    from nanogs.datasets.frame import Frame
    from nanogs.scoring.scores import ReferenceView


class PhotoViews(Sequence["ReferenceView"]):
    """Photographs as views, each read on access, because hundreds would not fit in memory.

    Attributes:
        background: RGB in [0, 1] behind transparent parts.
    """

    def __init__(
        self, dataset: "Dataset", frames: "Sequence[Frame]", background: Background
    ) -> None:
        self._dataset = dataset
        self._frames = tuple(frames)
        self.background = background

    @property
    def images(self) -> "Path | None":
        """The folder of the photographs; None for a data set whose camera files hold the paths."""
        return self._dataset.images

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras of the views; no photograph is read."""
        return tuple(frame.camera for frame in self._frames)

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks that matter for reading the numbers."""
        notes = camera_notes(self.cameras)
        if masked := sum(frame.masked for frame in self._frames):
            which = f"The masks of {counted(masked, 'photograph')} (mask_path)"
            notes.append(f"{which} are ignored: pixels left out of training count.")
        return tuple(notes)

    def __len__(self) -> int:
        return len(self._frames)

    @overload
    def __getitem__(self, index: int) -> "ReferenceView": ...
    @overload
    def __getitem__(self, index: slice) -> "PhotoViews": ...
    def __getitem__(self, index: int | slice) -> "ReferenceView | PhotoViews":
        from nanogs.scoring.scores import ReferenceView

        if isinstance(index, slice):
            return PhotoViews(self._dataset, self._frames[index], self.background)
        frame = self._frames[index]
        return ReferenceView(frame.camera, self._dataset.load_photo(frame, self.background))

    def __iter__(self) -> "Iterator[ReferenceView]":
        return (self[index] for index in range(len(self)))
