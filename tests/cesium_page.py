"""A page in which CesiumJS, from its npm package, draws a tileset from one camera."""

import json

import numpy as np

from browsers import TIMEOUT, page_at, pixels_of
from npm_packages import package, serve_folders

PAGE = """<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,">
<style>body { margin: 0 }
.cesium-widget, canvas { width: 100%; height: 100% }
#seen { width: WIDTHpx; height: HEIGHTpx }</style>
<script>window.CESIUM_BASE_URL = "/cesium/";</script>
<script src="/cesium/Cesium.js"></script>
<div id="seen"></div>
<script type="module">
const settings = SETTINGS;
const widget = new Cesium.CesiumWidget("seen", {
  baseLayer: false, globe: false, skyBox: false, skyAtmosphere: false, shouldAnimate: false,
  contextOptions: { webgl: { preserveDrawingBuffer: true } }, creditContainer: "credits",
  requestRenderMode: false, msaaSamples: 1, targetFrameRate: 60,
});
const { scene } = widget;
scene.backgroundColor = Cesium.Color.BLACK;
scene.fog.enabled = false;
scene.highDynamicRange = false;
for (const one of ["sun", "moon"]) scene[one] = undefined;
scene.screenSpaceCameraController.enableInputs = false;
window.state = { loads: 0 };
const tileset = await Cesium.Cesium3DTileset.fromUrl(settings.url, {
  maximumScreenSpaceError: settings.error, dynamicScreenSpaceError: false,
}).catch((error) => { window.state.error = String(error); });
scene.primitives.add(tileset);
tileset.allTilesLoaded.addEventListener(() => { window.state.loads += 1; });
const vector = ([x, y, z]) => new Cesium.Cartesian3(x, y, z);
scene.camera.frustum.fov = settings.fov;
scene.camera.frustum.near = settings.near;
scene.camera.setView({
  destination: vector(settings.position),
  orientation: { direction: vector(settings.direction), up: vector(settings.up) },
});
let still = 0;
scene.postRender.addEventListener(() => {
  const { state } = window;
  const splats = tileset.gaussianSplatPrimitive?._numSplats ?? 0;
  still = tileset.tilesLoaded && splats > 0 && splats === state.splats ? still + 1 : 0;
  Object.assign(state, { splats, still });
});
</script><div id="credits" style="display: none"></div>"""
# From the model's frame to that of its tileset: 180 degrees about z, then from y up to z up.
TURN = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])


def render_in_cesium(path, camera, folder, *, error=0.01, still_frames=30):
    """Render a tileset with CesiumJS; return (H, W, 3) float32 in [0, 1], and the page's state.

    Args:
        path: Its `tileset.json`, in a folder of its own; it has no place on Earth.
        camera: The camera, in the model's frame.
        folder: Folder in which the page is written.
        error: Error in pixels up to which a tile is drawn instead of its children.
        still_frames: Number of consecutive frames with the same splats, before a picture is taken.
    """
    cesium_files = package("cesium") / "Build" / "Cesium"
    _, down, forward = camera.world_to_camera[:3, :3]
    # CesiumJS measures the field of view along the longer side.
    longer = max(camera.width / camera.fx, camera.height / camera.fy) / 2
    settings = {
        "url": f"/scene/{path.name}",
        "position": (TURN @ camera.position).tolist(),
        "direction": (TURN @ forward).tolist(),
        "up": (TURN @ -down).tolist(),
        "fov": float(2 * np.arctan(longer)),
        "near": camera.near,
        "error": error,
    }
    page = PAGE.replace("SETTINGS", json.dumps(settings), 1)
    page = page.replace("WIDTH", str(camera.width)).replace("HEIGHT", str(camera.height))
    (folder / "cesium.html").write_text(page)
    with serve_folders(cesium=cesium_files, scene=path.parent, own=folder) as (address, requests):
        size = camera.width, camera.height
        with page_at(f"{address}/own/cesium.html", *size) as page_in_browser:
            is_done = f"window.state && (window.state.error || window.state.still > {still_frames})"
            page_in_browser.wait_for_function(is_done, timeout=TIMEOUT)
            state = page_in_browser.evaluate("window.state")
            pixels = pixels_of(page_in_browser.locator("canvas"), f"cesium-{path.parent.name}")
    return pixels, state | {"requests": [name for name in requests if name.endswith(".glb")]}
