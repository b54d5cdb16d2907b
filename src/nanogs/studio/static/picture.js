// The picture with two models side by side, and their labels.

import { byId, make } from "./dom.js";

export function makePicture(scene, fetchModel, { complain, onStill, onBox }) {
  const host = byId("view");
  const viewer = nanogsViewer.mountStudio(host, {
    camera: scene.camera,
    background: scene.background,
    names: [scene.name, "simplified"],
    onLost: () => complain("The graphics processor has stopped; load the page again."),
    onStill,
    onBox,
  });
  const asked = [0, 0]; // number of models asked for on each side
  const reduced = [false, false]; // whether a side is drawn with fewer splats than its model has
  let result = null; // the latest model of the right side: { id, shown }
  let base = null; // the scene that results are compared with, from `entry`

  // Shows a model on a side; returns false if a later one was asked for meanwhile.
  async function show(side, { fetched, mip, name, facts, isReduced }) {
    const turn = (asked[side] += 1);
    let bytes;
    try {
      bytes = await fetched;
    } catch (error) {
      if (turn !== asked[side]) return false; // expected: the server keeps only the latest models
      throw error;
    }
    if (turn !== asked[side]) return false;
    await viewer.show(side, bytes.slice(), mip);
    if (turn !== asked[side]) return false;
    viewer.label(side, name, facts);
    reduced[side] = isReduced;
    byId("legend-note").hidden = !reduced.includes(true);
    return true;
  }

  const entry = (model, name, facts) => ({
    fetched: fetchModel(model.id),
    mip: model.mip,
    isReduced: model.splats < model.of,
    name,
    facts,
  });

  return {
    box: viewer.box,
    key: viewer.key,
    label: viewer.label,
    base(model, name, facts) {
      const noted = model.note ? [...facts, model.note] : facts;
      base = entry(model, name, noted); // kept here, because the server does not keep it
      return show(0, base);
    },
    // Shows another model in place of the scene, until `back`.
    instead: (model, name, facts) => show(0, entry(model, name, facts)),
    back: () => show(0, base),
    // Shows a result; called when it is made, and again with another label when it is measured.
    async result(model, facts) {
      if (result?.id === model.id) {
        const there = await result.shown;
        if (there) viewer.label(1, "simplified", facts);
        return there;
      }
      result = { id: model.id, shown: show(1, entry(model, "simplified", facts)) };
      return result.shown;
    },
    up: (axis) => viewer.setUp(axis === null ? scene.camera.up : directionOf(axis)),
    bind() {
      byId("first-view").addEventListener("click", viewer.reset);
      bindHeat(viewer);
      bindFullScreen(host.parentElement);
    },
  };
}

function bindHeat(viewer) {
  const button = byId("heat");
  const { colours, marks } = nanogsViewer.SCALE;
  byId("legend-colours").style.background = `linear-gradient(to right, ${colours.join(", ")})`;
  byId("legend-marks").replaceChildren(
    ...marks.map(({ difference, place }, index) => {
      const more = index === marks.length - 1 ? "+" : "";
      const mark = make("span", { textContent: `${Math.round(100 * difference)}${more}` });
      mark.style.left = `${100 * place}%`;
      return mark;
    }),
  );
  button.addEventListener("click", () => {
    const on = button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", String(on));
    byId("legend").hidden = !on;
    viewer.heat(on);
  });
}

function bindFullScreen(picture) {
  const button = byId("full");
  button.hidden = !document.fullscreenEnabled;
  button.addEventListener("click", () => {
    if (document.fullscreenElement) document.exitFullscreen();
    else picture.requestFullscreen();
  });
}

function directionOf(axis) {
  return ["x", "y", "z"].map((name) => (axis[1] === name ? (axis[0] === "-" ? -1 : 1) : 0));
}
