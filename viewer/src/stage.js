// Draws one scene for each side into its part of one canvas, and only where something changed: a
// model that is replaced leaves the other side, which is often the larger one, as it was drawn.

import { SparkRenderer, SplatFileType, SplatMesh } from "@sparkjsdev/spark";
import { Scene, WebGLRenderer } from "three";
import { makeBox } from "./box.js";
import { rewriteHarmonics } from "./harmonics.js";
import { makeHeat } from "./heat.js";

// As nanogs.render has it, so that the page shows what the figures were measured on: a splat
// reaches to alpha 1/255, the variance on screen grows by 0.3, nearest means least depth.
const FAINTEST = 1 / 255;
const REACH = Math.sqrt(2 * Math.log(255));
const DILATION = 0.3;
const SPARK = {
  maxStdDev: REACH,
  minAlpha: FAINTEST,
  maxPixelRadius: 16384, // the few splats of a very small model are large, and must stay so
  clipXY: 3, // and reach into the view from far outside
  sortRadial: false,
  enableLod: false,
  accumExtSplats: true, // centres in single precision, not half
};
const MOST_PIXELS = 2; // of the screen for one of CSS: phones have 3, and too little power

export function makeStage(host, canvas, scene, sides) {
  const renderer = openRenderer(canvas);
  renderer.setClearColor(scene.background, 1);
  let requested = false;
  let share = sides > 1 ? 0.5 : 1;
  const size = { width: 1, height: 1 };
  const stage = {
    camera: null,
    beforeDraw: () => {},
    onResize: () => {},
    onLost: () => {},
    onStill: () => {}, // what is seen is final; `pace` as makeFinish gives it
  };

  function request() {
    if (host.dataset.state === "still") host.dataset.state = "busy";
    if (!requested) {
      requested = true;
      requestAnimationFrame(draw);
    }
  }
  stage.request = request; // draws the sides that changed, once
  const panes = Array.from({ length: sides }, () => new Pane(renderer, request));
  const finish = makeFinish(renderer.getContext());
  stage.invalidate = () => {
    for (const pane of panes) pane.dirty = true;
    request();
  };

  stage.divide = (value) => {
    share = value;
    stage.invalidate();
  };
  // A box of lines, made when it is first asked for; without corners it goes.
  let box = null;
  stage.box = (low, high) => {
    box ??= makeBox(panes);
    box.set(low, high);
    stage.invalidate();
  };
  // Whether the right side shows where the two differ.
  let heat = null;
  let hot = false;
  stage.heat = (on) => {
    hot = on && sides > 1;
    if (hot) heat ??= makeHeat(renderer);
    stage.invalidate();
  };
  stage.show = async (side, bytes, mip) => {
    await panes[side].show(bytes, mip);
    if (panes.every((pane) => pane.mesh)) host.dataset.state = "busy";
    request();
  };

  function draw() {
    requested = false;
    stage.beforeDraw();
    const edge = Math.round(share * size.width);
    const all = hot || box?.shown; // a difference and a box lie over both sides
    renderer.setScissorTest(true);
    box?.among(!hot);
    let splats = 0;
    panes.forEach((pane, side) => {
      pane.sortFirst(stage.camera);
      if (!all && !pane.dirty) return;
      pane.dirty = false;
      // A difference needs both pictures wherever it is seen.
      const [left, right] = side === 0 ? [0, hot ? size.width : edge] : [edge, size.width];
      if (right <= left) return;
      renderer.setScissor(left, 0, right - left, size.height);
      pane.quietly(() => renderer.render(pane.scene, stage.camera));
      splats += pane.spark.activeSplats;
      if (hot) heat.keep(side);
    });
    if (hot && edge < size.width) heat.paint();
    if (box?.shown) {
      renderer.setScissor(0, 0, size.width, size.height);
      renderer.autoClear = false;
      renderer.render(box.above, stage.camera);
      renderer.autoClear = true;
    }
    finish.when(splats, rest);
  }

  function rest(pace) {
    const busy = requested || panes.some((pane) => pane.busy);
    if (busy || host.dataset.state !== "busy") return;
    host.dataset.state = "still";
    stage.onStill(pace);
  }

  new ResizeObserver(() => {
    size.width = Math.max(1, host.clientWidth);
    size.height = Math.max(1, host.clientHeight);
    renderer.setPixelRatio(Math.min(window.devicePixelRatio, MOST_PIXELS));
    renderer.setSize(size.width, size.height);
    stage.onResize(size.width, size.height);
    for (const pane of panes) pane.dirty = true;
    draw(); // at once: the new canvas is empty
  }).observe(host);
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();
    host.dataset.state = "failed";
    stage.onLost();
  });
  return stage;
}

function openRenderer(canvas) {
  try {
    return new WebGLRenderer({
      canvas,
      antialias: false,
      powerPreference: "high-performance",
      preserveDrawingBuffer: true, // a side that did not change is not drawn again
    });
  } catch {
    throw new Error("this browser has no WebGL 2, or it is switched off.");
  }
}

// Calls back once all that was drawn so far is there, which the page itself does not wait for.
// `pace` is the seconds that a splat took, of the latest drawing with enough to tell; null before.
function makeFinish(gl) {
  const AGAIN = 5; // milliseconds
  const ENOUGH = 20_000; // splats, beside which nothing else that is drawn counts
  let latest = 0;
  let pace = null;
  function when(splats, act) {
    const number = (latest += 1);
    const begun = performance.now();
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    const look = () => {
      const waiting = !gl.isContextLost() && gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED;
      if (waiting && number === latest) {
        setTimeout(look, AGAIN);
        return;
      }
      gl.deleteSync(fence);
      if (waiting) return; // another drawing has begun
      if (splats >= ENOUGH) pace = (performance.now() - begun) / 1000 / splats;
      act(pace);
    };
    setTimeout(look);
  }
  return { when };
}

class Pane {
  constructor(renderer, request) {
    this.scene = new Scene();
    this.dirty = true; // as it is drawn, it is not as it should be
    this.unsorted = false; // whether a new model waits for the first order of its splats
    this.quiet = false;
    this.spark = new SparkRenderer({ renderer, onDirty: () => this.change(request), ...SPARK });
    this.scene.add(this.spark);
    this.mesh = null;
    this.wanted = null;
  }

  change(request) {
    if (this.quiet) return;
    this.dirty = true;
    request();
  }

  // Spark asks for the next frame as soon as it begins to sort, which would draw the same again,
  // and the order that it waits for only comes after that. It asks once more when it has sorted.
  quietly(act) {
    this.quiet = true;
    try {
      act();
    } finally {
      this.quiet = false;
      this.spark.dirty = false;
    }
  }

  // A new model is not drawn until it is sorted: it would be the former one in all that time.
  sortFirst(camera) {
    if (!this.unsorted || this.spark.sorting) return;
    this.unsorted = false;
    const { scene } = this;
    this.quietly(() => this.spark.update({ scene, camera }));
  }

  get busy() {
    return this.unsorted || this.spark.sorting || this.spark.sortDirty;
  }

  async show(bytes, mip) {
    this.wanted = bytes;
    const mesh = new SplatMesh({ fileBytes: bytes, fileType: SplatFileType.SPZ, extSplats: true });
    await mesh.initialized;
    await rewriteHarmonics(mesh.extSplats.extra, bytes);
    if (this.wanted !== bytes) {
      mesh.dispose(); // another was chosen meanwhile
      return;
    }
    if (this.mesh) {
      this.scene.remove(this.mesh);
      this.mesh.dispose();
    }
    this.spark.preBlurAmount = mip ? 0 : DILATION;
    this.spark.blurAmount = mip ? DILATION : 0; // the opacity makes up for this one
    this.mesh = mesh;
    this.scene.add(mesh);
    this.unsorted = true;
  }
}
