"""A page in which CesiumJS, as its npm package has it, draws a tileset from one camera."""

import json

import numpy as np

from browsers import PATIENCE, page_at, pixels_of
from npm_packages import package, served

PAGE = """<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,">
<style>body { margin: 0 }
.cesium-widget, canvas { width: 100%; height: 100% }
#seen { width: WIDTHpx; height: HEIGHTpx }</style>
<script>window.CESIUM_BASE_URL = "/cesium/";</script>
<script src="/cesium/Cesium.js"></script>
<div id="seen"></div>
<script type="module">
const told = TOLD;
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
const tileset = await Cesium.Cesium3DTileset.fromUrl(told.url, {
  maximumScreenSpaceError: told.error, dynamicScreenSpaceError: false,
}).catch((error) => { window.state.error = String(error); });
scene.primitives.add(tileset);
tileset.allTilesLoaded.addEventListener(() => { window.state.loads += 1; });
const vector = ([x, y, z]) => new Cesium.Cartesian3(x, y, z);
scene.camera.frustum.fov = told.fov;
scene.camera.frustum.near = told.near;
scene.camera.setView({
  destination: vector(told.position),
  orientation: { direction: vector(told.direction), up: vector(told.up) },
});
let still = 0;
scene.postRender.addEventListener(() => {
  const { state } = window;
  const splats = tileset.gaussianSplatPrimitive?._numSplats ?? 0;
  still = tileset.tilesLoaded && splats > 0 && splats === state.splats ? still + 1 : 0;
  Object.assign(state, { splats, still });
});
</script><div id="credits" style="display: none"></div>"""
# From the model's frame to that of its tileset: half a turn about z, then y up becomes z up.
TURN = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])


def in_cesium(path, camera, folder, *, error=0.01, calm=30):
    """Picture of a tileset by CesiumJS, (H, W, 3) float32 in [0, 1], and what it says of itself.

    Args:
        path: Its `tileset.json`, in a place of its own, so without a place on Earth.
        camera: From where, in the model's frame.
        folder: For the page.
        error: Pixels of error at which a tile is drawn and not its children.
        calm: Frames in a row that draw the same splats, before a picture is taken.
    """
    built = package("cesium") / "Build" / "Cesium"
    _, down, forward = camera.world_to_camera[:3, :3]
    # Its field of view is of the longer side.
    longer = max(camera.width / camera.fx, camera.height / camera.fy) / 2
    told = {
        "url": f"/scene/{path.name}",
        "position": (TURN @ camera.position).tolist(),
        "direction": (TURN @ forward).tolist(),
        "up": (TURN @ -down).tolist(),
        "fov": float(2 * np.arctan(longer)),
        "near": camera.near,
        "error": error,
    }
    page = PAGE.replace("TOLD", json.dumps(told), 1)
    page = page.replace("WIDTH", str(camera.width)).replace("HEIGHT", str(camera.height))
    (folder / "cesium.html").write_text(page)
    with served(cesium=built, scene=path.parent, own=folder) as (address, asked):
        size = camera.width, camera.height
        with page_at(f"{address}/own/cesium.html", *size) as opened:
            done = f"window.state && (window.state.error || window.state.still > {calm})"
            opened.wait_for_function(done, timeout=PATIENCE)
            state = opened.evaluate("window.state")
            pixels = pixels_of(opened.locator("canvas"), f"cesium-{path.parent.name}")
    return pixels, state | {"asked": [name for name in asked if name.endswith(".glb")]}
