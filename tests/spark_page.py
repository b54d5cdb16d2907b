"""A page in which Spark, from its npm package, opens a file and draws it from one camera."""

import json
from pathlib import Path

import numpy as np
import pytest

from browsers import TIMEOUT, page_at, pixels_of
from npm_packages import serve_folders

PACKAGES = Path(__file__).resolve().parents[1] / "viewer" / "node_modules"
# As in nanogs.render, splats are cut off at alpha 1/255, and 0.3 is added to variances on screen.
PAGE = """<!doctype html><meta charset="utf-8">
<link rel="icon" href="data:,"><style>body { margin: 0 }</style>
<script type="importmap">{"imports": {
  "three": "/packages/three/build/three.module.js",
  "three/addons/": "/packages/three/examples/jsm/",
  "spark": "/packages/@sparkjsdev/spark/dist/spark.module.js"}}</script>
<script type="module">
import { PerspectiveCamera, Scene, WebGLRenderer } from "three";
import { SparkRenderer, SplatMesh } from "spark";
const settings = SETTINGS;
const renderer = new WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
renderer.setPixelRatio(1);
renderer.setSize(settings.width, settings.height);
renderer.setClearColor(0, 1);
document.body.append(renderer.domElement);
const spark = new SparkRenderer({
  renderer, maxStdDev: Math.sqrt(2 * Math.log(255)), minAlpha: 1 / 255, maxPixelRadius: 16384,
  clipXY: 3, sortRadial: false, preBlurAmount: 0.3, blurAmount: 0, accumExtSplats: true,
  ...settings.options,
});
const scene = new Scene();
scene.add(spark);
const mesh = new SplatMesh({ url: settings.url, extSplats: !settings.paged, ...settings.mesh });
scene.add(mesh);
const aspect = settings.width / settings.height;
const camera = new PerspectiveCamera(settings.angle, aspect, settings.near, 1e4);
camera.matrixAutoUpdate = false;
camera.matrix.fromArray(settings.pose);
camera.matrix.decompose(camera.position, camera.quaternion, camera.scale);
camera.updateMatrixWorld(true);
window.state = { frames: 0, splats: 0, total: 0, still: 0 };
mesh.initialized.catch((error) => { window.state.error = String(error); });
const inside = () => mesh.packedSplats?.lodSplats ?? mesh.extSplats?.lodSplats;
function draw() {
  renderer.render(scene, camera);
  const busy = spark.sorting || spark.sortDirty;
  const count = spark.activeSplats ?? 0;
  const { state } = window;
  state.still = !busy && count === state.splats && count > 0 ? state.still + 1 : 0;
  state.splats = count;
  state.total = mesh.extSplats?.numSplats ?? mesh.packedSplats?.numSplats ?? 0;
  state.nodes = inside()?.numSplats ?? 0;
  state.frames += 1;
  requestAnimationFrame(draw);
}
draw();
</script>"""


def render_in_spark(path, camera, folder, *, mesh=None, still_frames=8, **options):
    """Render a file with Spark; return (H, W, 3) float32 in [0, 1], and the page's state.

    Args:
        path: The file.
        camera: The camera, whose principal point must be in the middle.
        folder: Folder in which the page is written.
        mesh: Options of the mesh: `paged`, so that chunks are fetched one at a time as they are
            needed, or `lod`, with which Spark makes a tree of its own.
        still_frames: Number of consecutive frames with the same splats, before a picture is taken.
        **options: Options of Spark's renderer, such as `lodSplatCount`.
    """
    if not (PACKAGES / "@sparkjsdev" / "spark").exists():
        pytest.skip("the npm package Spark is absent: run python viewer/bundle.py")
    pose = np.linalg.inv(camera.world_to_camera) @ np.diag([1.0, -1.0, -1.0, 1.0])
    settings = {
        "url": f"/scene/{path.name}",
        "mesh": mesh or {},
        "paged": bool(mesh and mesh.get("paged")),
        "width": camera.width,
        "height": camera.height,
        "angle": float(np.degrees(2 * np.arctan(camera.height / 2 / camera.fy))),
        "near": camera.near,
        "pose": pose.T.ravel().tolist(),
        "options": options,
    }
    (folder / "spark.html").write_text(PAGE.replace("SETTINGS", json.dumps(settings), 1))
    with (
        serve_folders(packages=PACKAGES, scene=path.parent, own=folder) as (address, requests),
        page_at(f"{address}/own/spark.html", camera.width, camera.height) as page,
    ):
        is_done = f"window.state && (window.state.error || window.state.still > {still_frames})"
        page.wait_for_function(is_done, timeout=TIMEOUT)
        state = page.evaluate("window.state")
        pixels = pixels_of(page.locator("canvas"), f"spark-{path.name}")
    return pixels, state | {"requests": [name for name in requests if name.startswith("scene/")]}
