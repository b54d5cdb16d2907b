"""Photographs that models are compared with."""

from pathlib import Path

from nanogs.errors import OptionError
from nanogs.memory_estimates import photographs_bytes
from nanogs.protocol import Background
from nanogs.scoring.photo_views import PhotoViews


def photographs(
    folder: Path, images: str | None, split: str, background: Background | None
) -> PhotoViews:
    """Open the photographs of a data set's split; only their sizes are read.

    Args:
        folder: NeRF-Synthetic, nerfstudio or COLMAP data set.
        images: Folder of the photographs in a COLMAP data set.
        split: "test" or "train".
        background: RGB in [0, 1] behind transparent parts; None for the data set's own.

    Returns:
        At least one photograph, each decoded on access.

    Raises:
        NanogsError: The folder holds no such data set, split or photograph.
    """
    from nanogs.datasets.dataset import Split, open_dataset

    splits: dict[str, Split] = {"test": "test", "train": "train"}
    if split not in splits:
        raise OptionError(f"The split must be test or train, not {split!r}.")
    dataset = open_dataset(folder, images=images)
    frames = dataset.split(splits[split])
    return PhotoViews(dataset, frames, background or dataset.background(frames))


def held_bytes(views: PhotoViews) -> int:
    """Compute the bytes of all photographs in memory."""
    return photographs_bytes([camera.width * camera.height for camera in views.cameras])


def photographs_remedy(views: PhotoViews) -> str:
    """Return what helps if photographs take too much memory, as the end of a message."""
    such = ', as with `images="images_4"`' if views.images else ""
    return f"use smaller photographs{such}, or a smaller model"
