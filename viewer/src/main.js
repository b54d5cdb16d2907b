// The interactive part of a page: one or two models, one camera, a line between them.
//
// `host` is an empty element with a size; `scene` is what nanogs.view.scene describes; `unpack`
// gives the bytes that an element of the page holds as text. The host's data-state tells how far
// it is: "loading", "busy" (drawing or sorting), "still" (what is seen is final) or "failed".

import { dress, makeView } from "./canvas.js";
import { makeDivider } from "./divider.js";
import { makeLabels } from "./labels.js";

export { mountStudio, SCALE } from "./studio.js";

export async function mount(host, scene, unpack) {
  dress(host);
  const status = Object.assign(document.createElement("p"), { className: "nv-status" });
  status.setAttribute("role", "status");
  const say = (text) => {
    status.textContent = text;
    status.hidden = !text;
  };
  host.append(status);
  try {
    await start(host, scene, unpack, say);
  } catch (error) {
    host.dataset.state = "failed";
    say(`The models cannot be shown: ${error.message}`);
    throw error;
  }
}

async function start(host, scene, unpack, say) {
  const two = scene.models.length > 1;
  const names = scene.models.map((model) => model.name);
  const { stage, navigation } = makeView(host, scene, names, two ? 2 : 1);
  stage.onLost = () => say("The graphics processor gave up: load the page again.");
  const divider = two && makeDivider(host, scene.models, (share) => stage.divide(share));
  let chosen = 1; // the model on the right
  let leftShown = false;
  const load = async (side, index) => {
    const model = scene.models[index];
    host.dataset.state = "loading";
    say(`Reading ${model.name} …`);
    await new Promise((shown) => setTimeout(shown, 20)); // or the words would come after the work
    await stage.show(side, unpack(model.id), model.mip);
    if (side === 0 || index === chosen) say(""); // or another is still being read
  };
  makeLabels(host, scene, {
    choose: (index) => {
      chosen = index;
      if (!leftShown) return; // it is loaded below
      load(1, index).catch((error) => say(`It cannot be read: ${error.message}`));
    },
    reset: navigation.reset,
  });
  const keys = host.dataset.keys === "page" ? document : host;
  keys.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest?.("select")) return;
    if (navigation.key(event) || (divider && divider.key(event))) event.preventDefault();
  });
  await load(0, 0);
  leftShown = true;
  if (two) await load(1, chosen);
}
