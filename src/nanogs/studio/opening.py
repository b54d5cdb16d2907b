"""The state a studio page starts from: the model to draw, the camera, and the available options."""

from pathlib import Path
from typing import Any

import numpy as np

from nanogs.io import registry
from nanogs.pipeline.options.presets import FORESTS
from nanogs.splats import Splats
from nanogs.studio.orders import LAYOUTS
from nanogs.studio.scene import Scene, StudioSettings
from nanogs.studio.showing import MOST_SHOWN, Shown, few, show
from nanogs.studio.turning import direction_of, up_of
from nanogs.view.pack import DISTANCE, camera_in_page
from nanogs.views.opening import Opening, opening_for

_CORE = 1.0  # percentage of the splats that `core` leaves out on each side of each axis


def opened(
    scene: Scene, settings: StudioSettings, whole: Splats
) -> tuple[dict[str, Any], Opening, Shown]:
    """Return the event that describes a scene, the first camera, and the model to show.

    Raises:
        ModelError: No splat is visible.
    """
    drawn = few(whole)
    stated = scene.up if scene.states_frame else None  # the axis of a mere format may be wrong
    asked = settings.up or stated
    start = opening_for(drawn, up=None if asked is None else direction_of(asked))
    shown = show(drawn, start, len(whole))
    low, high, inner_low, inner_high = _bounds(whole)
    first = {"preset": settings.preset, "render_mode": settings.render_mode, "up": settings.up}
    event = {
        "type": "scene", "name": scene.path.name, "stem": scene.stem, "splats": len(whole),
        "sh_degree": whole.sh_degree, "file_bytes": scene.file_bytes,
        "render_mode": scene.render_mode, "up": stated or up_of(start.up.tolist()),
        "can_turn": not scene.states_frame, "available": int(whole.finite().sum()),
        "formats": writable_formats(), "presets": list(FORESTS),
        "layouts": [
            {"name": name, "suffix": suffix, "example": example.format(stem=scene.stem)}
            for suffix, (name, example) in LAYOUTS.items()
        ],
        "camera": camera_in_page(start), "background": "#000",
        "page": {"scale": DISTANCE / start.distance, "centre": start.target.tolist()},
        "bounds": {"low": low, "high": high}, "core": {"low": inner_low, "high": inner_high},
        "folder": str(Path.cwd()), "most_shown": MOST_SHOWN, "notes": list(map(str, whole.notes)),
        "first": {name: value for name, value in first.items() if value is not None},
    }  # fmt: skip
    return event, start, shown


def writable_formats() -> list[str]:
    """Return the suffixes of the formats that a single model can be written in."""
    return [known.suffix for known in registry.formats() if known.writable]


def _bounds(splats: Splats) -> tuple[list[float], ...]:
    """Return the corners of the bounding box of all finite centres, and those without outliers.

    Both are lowest and highest corner; the second leaves out `_CORE` per cent on each side.
    """
    means = splats.means[np.isfinite(splats.means).all(axis=1)]
    inner = np.percentile(means, [_CORE, 100 - _CORE], axis=0)
    corners = [means.min(axis=0), means.max(axis=0), *inner]
    return tuple(corner.astype(np.float64).tolist() for corner in corners)
