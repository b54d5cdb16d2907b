"""Cameras by source: found from the model, or read from a file."""

from collections.abc import Sequence
from pathlib import Path

from nanogs.errors import OptionError
from nanogs.raster.camera import Camera
from nanogs.scoring.protocol import Kind as Origin
from nanogs.splats import Splats
from nanogs.views.automatic import Kind, Split, automatic_cameras

AUTOMATIC: dict[str, Kind] = {"auto": "auto", "orbit": "orbit", "inside": "inside"}
FOUND: dict[str, Origin] = {**AUTOMATIC, "roam": "roam"}  # all that are found from the model


def cameras_for(
    splats: Splats,
    source: str,
    *,
    count: int,
    width: int,
    height: int,
    up: Sequence[float] | None = None,
    split: Split = "test",
) -> list[Camera]:
    """Cameras for a model.

    Args:
        splats: The model.
        source: A name in `FOUND`, or a camera file or data-set folder; all its cameras.
        count: Number of automatic views.
        width: Width of automatic views, pixels.
        height: Height of automatic views, pixels.
        up: Up direction of automatic views; found from the model by default.
        split: Of automatic views; `fit` and `test` have none in common.

    Returns:
        The cameras; of roaming ones fewer than `count` where no more are found.

    Raises:
        NanogsError: The source is neither, or cannot be read.
    """
    if source in AUTOMATIC:
        return automatic_cameras(
            splats, count, width=width, height=height, kind=AUTOMATIC[source], up=up, split=split
        )
    if source == "roam":
        from nanogs.views.roam import roaming_cameras  # brings Numba

        return roaming_cameras(splats, count, width=width, height=height, up=up, split=split)
    if not Path(source).exists():
        raise OptionError(
            f"There is no camera file {source!r}; give a file, or one of {', '.join(FOUND)}."
        )
    from nanogs.datasets.dataset import cameras_from_file

    return cameras_from_file(Path(source))
