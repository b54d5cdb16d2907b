// The status line: the running job, its progress, and error messages.

import { byId } from "./dom.js";
import { jobText } from "./stages.js";

const WORDS = {
  open: "Opening",
  draft: "Making the model",
  measure: "Measuring",
  curve: "Filling the plot",
  filters: "Looking for the splats to remove",
  save: "Saving",
};

export function makeStatus(cancel) {
  const said = byId("said");
  const bar = byId("progress");
  const button = byId("cancel");
  const alert = byId("alert");
  button.addEventListener("click", cancel);
  alert.querySelector("button").addEventListener("click", () => complain(""));

  function complain(message) {
    alert.hidden = !message;
    alert.querySelector("p").textContent = message;
  }

  function say(words) {
    if (said.textContent !== words) said.textContent = words;
    bar.hidden = button.hidden = true;
  }

  return {
    complain,
    say,
    get cancellable() {
      return !button.hidden;
    },
    work({ kind, stage, fraction, number }) {
      const words = jobText(WORDS[kind] ?? kind, stage);
      if (said.textContent !== words) said.textContent = words;
      showFraction(bar, fraction);
      bar.classList.toggle("quiet", kind === "curve");
      button.hidden = number === null; // background work needs no button: any request replaces it
    },
  };
}

export function showFraction(bar, fraction) {
  bar.hidden = false;
  if (fraction === null || fraction === undefined) bar.removeAttribute("value");
  else bar.value = fraction;
}
