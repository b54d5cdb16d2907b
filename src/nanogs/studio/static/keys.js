// Keyboard shortcuts of the page; the viewer handles those that move the camera.

import { byId } from "./dom.js";

const SLIDES = /^(Arrow|Home|End|Page)/;

// Whether the focused field or slider uses the key itself.
function ownKey({ target, key }) {
  if (target.matches("input[type=range]")) return SLIDES.test(key);
  return target.matches("input:not([type=checkbox]), select, textarea");
}

export function bindKeys({ state, picture, stop }) {
  const click = (id) => () => byId(id).click();
  const plain = { e: click("heat"), f: click("full"), "?": click("help-open") };
  const withControl = {
    z: state.undo,
    Z: state.redo,
    y: state.redo,
    s: click("save-open"),
    S: click("save-open"),
  };

  document.addEventListener("keydown", (event) => {
    if (event.defaultPrevented || document.querySelector("dialog[open]") || event.altKey) return;
    const typing = event.target.matches("input[type=text]");
    const action = event.ctrlKey || event.metaKey ? withControl[event.key] : null;
    if (action) {
      // While the user types in a field, undo belongs to that field.
      if (
        typing &&
        event.key.toLowerCase() === "z" &&
        event.target.value !== event.target.dataset.before
      )
        return;
      event.preventDefault();
      action();
    } else if (!event.ctrlKey && !event.metaKey) {
      if (event.key === "Escape") stop();
      else if (ownKey(event)) return;
      else if (plain[event.key]) plain[event.key]();
      else if (!picture.key(event)) return;
      event.preventDefault();
    }
  });
  document.addEventListener("focusin", ({ target }) => {
    if (target.matches("input[type=text]")) target.dataset.before = target.value;
  });
}
