// Filters: the user chooses which splats to remove, sees these in magenta, and then applies it.

import { byId, onCommit } from "./dom.js";
import * as numbers from "./numbers.js";
import { same } from "./state.js";

const STEPS = 1000;
const AXES = ["x", "y", "z"];
const PAUSE = 120; // milliseconds without a change before a preview is requested
export const NONE = { box: null, min_opacity: null, floaters: false };

export function makeFilters(scene, state, { ask, draw, restore, complain }) {
  const opacity = { field: byId("opacity"), range: byId("opacity-range"), scale: numbers.squared(1) };
  const floaters = byId("floaters");
  const crop = byId("crop");
  const panel = byId("sift");
  const core = scene.core ?? scene.bounds;
  const axes = AXES.map((name, axis) => ({
    scale: within(core.low[axis], core.high[axis], scene.bounds.low[axis], scene.bounds.high[axis]),
    ends: ["low", "high"].map((end) => ({
      field: byId(`${name}-${end}`),
      range: byId(`${name}-${end}-range`),
    })),
  }));
  let pending = state.choice.filters; // the filters that the controls show
  // The corners of the box, which are kept while the box is switched off.
  let box = ["low", "high"].flatMap((end) =>
    axes.map(({ scale }, axis) => scale.round(core[end][axis])),
  );
  if (pending.box) box = pending.box;
  let timer = 0;
  let marked = false; // whether the left side shows splats in magenta
  let taking = false;

  const isNew = () => !same(pending, state.choice.filters);

  function change(part, at = PAUSE) {
    pending = { ...pending, ...part };
    if (pending.box) box = pending.box;
    render();
    clearTimeout(timer);
    if (!isNew()) {
      forget();
      return;
    }
    document.body.dataset.preview = "asked";
    say("Looking for the splats to remove …");
    timer = setTimeout(() => ask(pending), at);
  }

  function forget() {
    clearTimeout(timer);
    if (marked || document.body.dataset.preview !== "none") restore();
    marked = false;
    document.body.dataset.preview = "none";
    say("");
  }

  opacity.range.addEventListener("input", () => {
    const value = numbers.parsed(opacity.scale.at(opacity.range.value / STEPS).toFixed(3));
    change({ min_opacity: value || null });
  });
  onCommit(opacity.field, () => {
    const value = numbers.parsed(opacity.field.value || "0");
    const valid = value >= 0 && value <= 1;
    complain(valid ? "" : `“${opacity.field.value}” is not an opacity; type a number from 0 to 1.`);
    if (valid) change({ min_opacity: value || null }, 0);
    render();
  });
  floaters.addEventListener("change", () => change({ floaters: floaters.checked }, 0));
  crop.addEventListener("change", () => change({ box: crop.checked ? box : null }, 0));
  function moveFace(axis, end, value, at) {
    const next = [...box];
    next[axis + 3 * end] = value;
    // The lower end is never above the upper one: each pushes the other along.
    if (next[axis] > next[axis + 3]) next[axis + 3 * (1 - end)] = value;
    change({ box: next }, at);
  }
  axes.forEach(({ scale, ends }, axis) => {
    ends.forEach(({ field, range }, end) => {
      range.addEventListener("input", () => moveFace(axis, end, scale.at(range.value / STEPS)));
      onCommit(field, () => {
        const value = numbers.parsed(field.value);
        const valid = Number.isFinite(value);
        complain(valid ? "" : `“${field.value}” is not a number; type one in units of the scene.`);
        if (valid && field.value !== scale.short(box[axis + 3 * end])) moveFace(axis, end, value, 0);
        render();
      });
    });
  });
  byId("take").addEventListener("click", () => {
    clearTimeout(timer);
    document.body.dataset.preview = "none";
    say("");
    taking = true;
    state.set({ filters: pending });
    taking = false;
    render();
  });
  byId("untake").addEventListener("click", () => {
    pending = state.choice.filters;
    if (pending.box) box = pending.box;
    forget();
    render();
  });
  panel.addEventListener("toggle", outline); // not all: a field that is typed into stays as it is

  const say = (words) => (byId("takes").textContent = words);

  function render() {
    const alpha = pending.min_opacity ?? 0;
    opacity.field.value = alpha ? String(alpha) : "0";
    opacity.range.value = Math.round(STEPS * opacity.scale.place(alpha));
    fill(opacity.range, 0, opacity.range.value);
    opacity.range.setAttribute("aria-valuetext", alpha ? String(alpha) : "removes none");
    floaters.checked = pending.floaters;
    crop.checked = Boolean(pending.box);
    byId("box").hidden = !pending.box;
    axes.forEach(({ scale, ends }, axis) => {
      ends.forEach(({ field, range }, end) => {
        const value = box[axis + 3 * end];
        field.value = scale.short(value);
        range.value = Math.round(STEPS * scale.place(value));
        range.setAttribute("aria-valuetext", scale.short(value));
      });
      const [low, high] = ends.map(({ range }) => Number(range.value));
      fill(ends[0].range.parentElement, low, high);
      // If both handles are at the upper end, the lower one must be on top: only it can move.
      ends[0].range.style.zIndex = low > STEPS / 2 ? 2 : 1;
      ends[1].range.style.zIndex = low > STEPS / 2 ? 1 : 2;
    });
    byId("take").disabled = byId("untake").disabled = !isNew();
    byId("take").textContent = same(pending, NONE) && isNew() ? "Put all back" : "Remove";
    outline();
  }

  // Draws the box in the picture while the panel is open.
  function outline() {
    const seen = pending.box && panel.open;
    draw(seen ? pending.box.slice(0, 3) : null, seen ? pending.box.slice(3) : null);
  }

  render();
  return {
    // Called when a face of the box is dragged in the picture; `value` is in scene units.
    drag: (axis, end, value) => moveFace(axis, end, axes[axis].scale.round(value)),
    // Called when the choice has changed, by undo or by applying the filters.
    follow(choice, before) {
      if (same(choice.filters, before.filters)) return;
      pending = choice.filters;
      if (pending.box) box = pending.box;
      // After applying, the removed splats stay magenta until the filtered scene arrives.
      if (taking) clearTimeout(timer);
      else forget();
      document.body.dataset.preview = "none";
      say("");
      render();
    },
    // Shows the server's answer to the preview of `pending`.
    preview(event) {
      document.body.dataset.preview = "shown";
      marked = true;
      say(`${outcome(event)}${gone(event) ? " They are magenta on the left." : ""}`);
    },
    taken(event) {
      const lost = gone(event);
      marked = false;
      byId("taken").textContent = lost ? `${numbers.count(lost)} removed` : "";
      byId("taken").title = lost ? outcome(event) : "";
    },
    // Called when the left side shows the whole scene again.
    reopened() {
      if (marked) forget();
      byId("taken").textContent = byId("taken").title = "";
    },
    refused(message) {
      document.body.dataset.preview = "none";
      say(message);
    },
  };
}

const gone = ({ took }) => took.reduce((sum, { removed }) => sum + removed, 0);

function outcome(event) {
  const lost = gone(event);
  if (!lost) return "No splat is removed, because none matches.";
  const parts = event.took.filter(({ removed }) => removed);
  const each =
    parts.length > 1
      ? ` (${parts.map(({ name, removed }) => `${name}: ${numbers.count(removed)}`).join(", ")})`
      : "";
  return `${numbers.splats(lost)} of ${numbers.count(lost + event.left)} removed${each}, ${numbers.count(event.left)} left.`;
}

// A scale over the range that holds nearly all splats, whose two ends mean the full range.
function within(low, high, lowest, highest) {
  const middle = numbers.linear(low, high);
  const digits = Math.max(0, 3 - Math.floor(Math.log10(high - low || 1)));
  const round = (value) => Number(value.toFixed(digits));
  const [below, above] = [Math.floor, Math.ceil].map((outward, end) => {
    return round(outward((end ? highest : lowest) * 10 ** digits) / 10 ** digits);
  });
  return {
    at: (place) => (place <= 0 ? below : place >= 1 ? above : round(middle.at(place))),
    place: middle.place,
    round,
    short: (value) => String(round(value)),
  };
}

function fill(element, low, high) {
  element.style.setProperty("--from", `${low / (STEPS / 100)}%`);
  element.style.setProperty("--filled", `${high / (STEPS / 100)}%`);
}
