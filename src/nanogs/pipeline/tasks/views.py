"""The views of a job: chosen once for the whole scene, and cropped to where a block is visible."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from nanogs._types import Bool
from nanogs.errors import ModelError
from nanogs.fit.views import choose_cameras
from nanogs.formatting import counted
from nanogs.kernels.blocks import TILE
from nanogs.kernels.project import HIDDEN, unpack_box
from nanogs.method.choose import DECIDING
from nanogs.pipeline.options.cameras import fit_cameras
from nanogs.pipeline.options.views import camera_of, plain_camera
from nanogs.raster.camera import Camera, camera_notes, pick_evenly
from nanogs.raster.rendering import PreparedSplats, project
from nanogs.views.automatic import all_around, cameras_of, survey
from nanogs.views.cameras import frame_notes

if TYPE_CHECKING:
    from nanogs.pipeline.scene import Scene

LEAST = 2 * TILE  # fewest pixels along a side of a part of a view
SMALL = 128  # width and height, pixels, of views that only find hidden splats
STRAYS = 0.002  # share of a block's splats that may be outside its part of a view, on each side


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """The cameras of a job.

    Attributes:
        kept: Those that visibility is measured on; some of them decide, the others are fitted to.
        further: More to fit to.
        around: Small ones from all around, which only show what is hidden.
        notes: Notes for the user, one sentence each.
    """

    kept: tuple[Camera, ...]
    further: tuple[Camera, ...]
    around: tuple[Camera, ...]
    notes: tuple[str, ...]

    @property
    def deciding(self) -> list[Camera]:
        """The cameras by which results are chosen."""
        return pick_evenly(self.kept, deciding_count(len(self.kept)))

    def to_dict(self) -> dict[str, Any]:
        """Return plain data; floats keep every digit in JSON."""
        return {
            "kept": [plain_camera(camera) for camera in self.kept],
            "further": [plain_camera(camera) for camera in self.further],
            "around": [plain_camera(camera) for camera in self.around],
            "notes": list(self.notes),
        }


def deciding_count(views: int) -> int:
    """Return the number of deciding views among `views` views."""
    return max(1, views // DECIDING)


def views_of(data: Mapping[str, Any]) -> Views:
    """Rebuild views from the data of `to_dict` after a round trip through JSON."""
    kept, further, around = (
        tuple(camera_of(each) for each in data[kind]) for kind in ("kept", "further", "around")
    )
    return Views(kept, further, around, tuple(data["notes"]))


def choose_views(scene: "Scene") -> Views:
    """Choose the views of the whole scene, or take those that the user gives.

    Views of a kind or up direction that the user asks for are as many as automatic ones.

    Args:
        scene: The scene, with its coarse levels if it has several blocks.
    """
    parameters, asked, some = scene.settings.parameters, scene.settings.asked, scene.sample()
    given, size = asked.given(), parameters.view_size
    more = parameters.further if parameters.steps else 0
    wanted = parameters.views + more
    found, around = None, list[Camera]()
    try:
        if given:
            kept, further = choose_cameras(given, parameters.views, more, size, parameters.finer)
        else:
            analysed = survey(some, habit=False)
            found = fit_cameras(some, asked.source, asked.up, wanted, size)
            kept, further = choose_cameras(
                found or analysed, parameters.views, more, size, parameters.finer
            )
            from_all_sides = analysed.looks_all_around and parameters.views >= parameters.around
            if found or not from_all_sides:
                # Of the same sequence as automatic ones, but none of the same directions.
                first = parameters.views + parameters.further
                numbers = range(first, first + parameters.around)
                around = cameras_of(all_around(analysed), numbers, SMALL, SMALL)
    except ModelError as error:
        return Views((), (), (), (f"Nothing was rendered or measured: {error}",))
    notes = (*camera_notes(given), *frame_notes(given, some))
    if found is not None and len(found) < wanted:
        notes = (f"Only {len(found)} of {counted(wanted, 'roaming view')} could be found.",)
    return Views(tuple(kept), tuple(further), tuple(around), notes)


def parts_of(own: PreparedSplats, shown: Bool, cameras: Sequence[Camera]) -> list[Camera | None]:
    """Crop each view to the part in which splats are drawn; None if there are none in it.

    Args:
        own: N splats, of a block.
        shown: (N,) bool, the splats that count.
        cameras: Whole views.
    """
    return [_part(own, shown, camera) for camera in cameras]


def _part(own: PreparedSplats, shown: Bool, camera: Camera) -> Camera | None:
    boxes = project(own, camera, sh_degree=0).boxes
    boxes = boxes[shown & (boxes != HIDDEN)]
    if len(boxes) == 0:
        return None
    corner_and_size: tuple[Any, ...] = unpack_box(boxes)
    x, y, across, down = corner_and_size
    left, right = _between(x, x + across, camera.width)
    top, bottom = _between(y, y + down, camera.height)
    return camera.cropped(left, top, right - left, bottom - top)


def _between(first: Any, last: Any, size: int) -> tuple[int, int]:  # noqa: ANN401 - arrays
    """Return the range of pixels, in whole tiles, of nearly all boxes; `LEAST` at least."""
    low = int(np.quantile(first, STRAYS, method="lower")) * TILE
    high = min(int(np.quantile(last, 1 - STRAYS, method="higher")) * TILE, size)
    if high - low < LEAST:
        low = max(min(low, (size - LEAST) // TILE * TILE), 0)
        high = min(max(high, low + LEAST), size)
    return low, high
