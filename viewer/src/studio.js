// The interactive part of `nanogs studio`: two models that a page replaces, under one camera.
//
// `host` is an empty element with a size; `scene` has `camera` and `background` as nanogs.view.scene
// describes them, and `names` of the two sides; `onStill(pace)` is called once all is drawn, with the
// seconds that a splat takes, and `onBox(axis, end, value)` where a face of the box is dragged, in
// units of the page. The host's data-state is that of `mount`. What comes back moves nothing but
// what it says:
//
//   show(side, bytes, mip)     another model (.spz) on side 0 or 1; the camera stays
//   label(side, name, facts)   what the side is called, and lines below that
//   setUp(vector)              turn the camera so that this is up, and begin from there from now on
//   box(low, high)             a box of lines and handles in units of the page; null takes it away
//   heat(on)                   the right side shows where the two differ, in the colours of SCALE
//   reset()                    back to the first view
//   key(event)                 move by a key as the canvas does; whether it had a meaning

import { dress, makeView } from "./canvas.js";
import { makeDivider } from "./divider.js";
import { makeHandles } from "./handles.js";
import { makeSideLabels } from "./labels.js";

export { SCALE } from "./heat.js";

export function mountStudio(host, scene) {
  dress(host);
  const { stage, navigation } = makeView(host, scene, scene.names, 2);
  stage.onLost = () => scene.onLost?.();
  stage.onStill = (pace) => scene.onStill?.(pace);
  const divider = makeDivider(
    host,
    scene.names.map((name) => ({ name })),
    stage.divide,
  );
  // After the divider, and so above it.
  const handles = makeHandles(host, navigation.camera, (...moved) => scene.onBox?.(...moved));
  stage.beforeDraw = () => {
    navigation.update();
    handles.place();
  };
  const labels = makeSideLabels(host, scene.names);
  // One model alone is a picture too, as the other may take long.
  async function show(side, bytes, mip) {
    await stage.show(side, bytes, mip);
    if (host.dataset.state === "loading") host.dataset.state = "busy";
    stage.request();
  }
  return {
    show,
    label: labels.set,
    setUp: navigation.setUp,
    box(low, high) {
      handles.set(low, high);
      stage.box(low, high);
    },
    heat: stage.heat,
    reset: navigation.reset,
    key: (event) => navigation.key(event) || divider.key(event),
    get state() {
      return host.dataset.state;
    },
  };
}
