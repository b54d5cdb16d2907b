// What every page begins with: its style, and a canvas with a stage on it and a camera before that.

import { makeNavigation } from "./navigation.js";
import { makeStage } from "./stage.js";
import css from "./style.css";

// An empty host gets what follows.
export function dress(host) {
  host.classList.add("nanogs-view");
  host.replaceChildren(Object.assign(document.createElement("style"), { textContent: css }));
  host.dataset.state = "loading";
}

export function makeView(host, scene, names, sides) {
  const canvas = document.createElement("canvas");
  canvas.tabIndex = 0;
  canvas.setAttribute("role", "application");
  canvas.setAttribute("aria-label", names.join(" and "));
  host.prepend(canvas);
  const stage = makeStage(host, canvas, scene, sides);
  const navigation = makeNavigation(canvas, scene.camera, stage.invalidate);
  stage.camera = navigation.camera;
  stage.beforeDraw = navigation.update;
  stage.onResize = navigation.resize;
  return { stage, navigation };
}
