// Controls for format, preset and harmonics, and for the scene's render mode and up axis.

import { byId, make, segments } from "./dom.js";

const PRESETS = {
  fast: "nothing is rendered or fitted",
  default: "looked at from many views",
  best: "fitted to renders: slow",
};
const UPS = ["+x", "-x", "+y", "-y", "+z", "-z"];
const MODES = {
  default: "blurred by 0.3 pixels, as most are trained",
  mip: "trained with antialiasing",
};

export function makeMethod(scene, state) {
  const format = byId("format");
  format.replaceChildren(...scene.formats.map((suffix) => new Option(suffix, suffix)));
  format.disabled = false;
  format.addEventListener("change", () => state.set({ format: format.value }));

  const harmonics = byId("harmonics");
  const degrees = Array.from({ length: scene.sh_degree }, (_, degree) => degree);
  harmonics.replaceChildren(
    new Option(scene.sh_degree ? `all (degree ${scene.sh_degree})` : "none in the file", ""),
    ...degrees
      .reverse()
      .map((degree) => new Option(degree ? `up to degree ${degree}` : "none (degree 0)", degree)),
  );
  harmonics.disabled = !degrees.length;
  harmonics.addEventListener("change", () => {
    state.set({ sh_degree: harmonics.value === "" ? null : Number(harmonics.value) });
  });

  const presets = scene.presets.map((name) => [name, name, PRESETS[name] ?? ""]);
  const pressPreset = segments(byId("preset"), presets, (preset) => state.set({ preset }));

  // null means the value that the file states, so that the command line does not repeat it.
  const modes = Object.entries(MODES).map(([name, title]) => [name, name, title]);
  const pressMode = segments(byId("mode"), modes, (mode) =>
    state.set({ render_mode: mode === scene.render_mode ? null : mode }),
  );
  const ups = UPS.map((axis) => [axis, axis.replace("-", "−"), `${axis} is up`]);
  const pressUp = segments(byId("up"), ups, (up) => state.set({ up }));
  const notes = [...(scene.notes ?? [])];
  if (scene.can_turn === false) {
    for (const button of byId("up").children) button.disabled = true;
    notes.unshift("The file says which way is up.");
  }
  byId("notes").replaceChildren(...notes.map((note) => make("li", { textContent: note })));

  function render({ format: suffix, preset, sh_degree: degree, render_mode: mode, up }) {
    format.value = suffix;
    harmonics.value = degree === null ? "" : String(degree);
    pressPreset(preset);
    pressMode(mode ?? scene.render_mode);
    pressUp(up ?? scene.up);
  }
  return { render };
}
