"""Photographs that models are compared with."""

from collections.abc import Sequence
from pathlib import Path

from nanogs.errors import OptionError
from nanogs.formatting import counted
from nanogs.memory import allowed_memory, refuse_too_large
from nanogs.memory_estimates import photographs_bytes
from nanogs.protocol import Background
from nanogs.scoring.scores import ReferenceView
from nanogs.views.plan import LEAST


def photographs(
    folder: Path,
    images: str | None,
    split: str,
    background: Background | None,
    max_memory: int | None = None,
) -> tuple[Background, list[ReferenceView]]:
    """Load the cameras and photographs of a data set's split.

    Args:
        folder: NeRF-Synthetic or COLMAP data set.
        images: Folder of the photographs in a COLMAP data set.
        split: "test" or "train".
        background: RGB in [0, 1] behind transparent parts; None for the data set's own.
        max_memory: Bytes that this process may take; by default the free memory.

    Returns:
        The background, and at least one photograph, composited over it.

    Raises:
        NotEnoughMemoryError: The photographs do not fit in memory.
        NanogsError: The folder holds no such data set, split or photograph.
    """
    from nanogs.datasets.dataset import Split, open_dataset

    splits: dict[str, Split] = {"test": "test", "train": "train"}
    if split not in splits:
        raise OptionError(f"The split must be test or train, not {split!r}.")
    dataset = open_dataset(folder, images=images)
    frames = dataset.split(splits[split])
    pixels = [frame.camera.width * frame.camera.height for frame in frames]
    refuse_too_large(
        f"Comparing with {counted(len(frames), 'photograph')}",
        photographs_bytes(pixels),
        allowed_memory(max_memory),
        'use smaller photographs, as with `images="images_4"`',
    )
    behind = background or dataset.background(frames)
    return behind, [
        ReferenceView(frame.camera, dataset.load_photo(frame, behind)) for frame in frames
    ]


def room_beside_photographs(
    room: int | None, frames: Sequence[ReferenceView], *, packed: bool = False
) -> int | None:
    """Return the bytes left for splats while rendering when photographs are in memory.

    Args:
        room: Bytes without photographs; None, which is returned, if models are loaded whole.
        frames: The photographs, if any.
        packed: Whether packed files of the models are scored too, for which the models' renders are
            kept in memory.
    """
    if room is None:
        return None
    taken = sum(frame.image.nbytes for frame in frames)
    return max(room - (2 if packed else 1) * taken, LEAST)
