"""PlayCanvas's viewer, supersplat-viewer from its npm package, opening a model that we wrote."""

import json

import numpy as np

from browsers import TIMEOUT, page_at, pixels_of
from npm_packages import package, serve_folders

SETTINGS = {"background": {"color": [0, 0, 0]}, "animTracks": []}
LENS = {"fov": 50}  # degrees, of the longer side
# It rotates models by 180 degrees about z, from y down to y up.
TURN = np.array([-1.0, -1.0, 1.0])


def camera_options(camera):
    """Return the viewer's options for a camera whose up direction is the model's -y."""
    forward, centre = camera.world_to_camera[2, :3], camera.position
    longer = max(camera.width / camera.fx, camera.height / camera.fy) / 2
    return {
        "position": (TURN * centre).tolist(),
        "target": (TURN * (centre + forward)).tolist(),
        "fov": float(np.degrees(2 * np.arctan(longer))),
    }


def render_in_supersplat(path, folder, count, width=320, height=240, **camera):
    """Render a model with SuperSplat once it draws `count` splats.

    Args:
        path: The model.
        folder: Folder in which its settings are written.
        count: Number of splats that it draws in the end; it begins with the coarsest level.
        width, height: Pixels.
        **camera: The first camera, from `camera_options`; the viewer chooses one if none is given.

    Returns:
        (H, W, 3) float32 in [0, 1], and names of descriptions and bundles in order of request.
    """
    viewer = package("@playcanvas/supersplat-viewer") / "public"
    (folder / "settings.json").write_text(json.dumps(SETTINGS | {"camera": LENS | camera}))
    with serve_folders(viewer=viewer, scene=path.parent, own=folder) as (address, requests):
        options = "webgl&noanim&nofx&noui&settings=/own/settings.json"
        options += f"&content=/scene/{path.name}"
        with page_at(f"{address}/viewer/index.html?{options}", width, height) as page:
            splats_drawn = "window.app?.stats?.frame?.gsplats"
            page.wait_for_function(f"{splats_drawn} === {count}", timeout=TIMEOUT)
            page.wait_for_timeout(500)  # a few frames
            pixels = pixels_of(page, f"{path.parent.name}-{path.name}")
    return pixels, [name for name in requests if name.endswith(("meta.json", "sog"))]
