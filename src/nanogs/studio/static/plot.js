// The plot of PSNR over file size: all known points, and that of the shown model.

import { byId, drawn, make } from "./dom.js";
import * as numbers from "./numbers.js";

const HEIGHT = 156;
const EDGE = { left: 42, right: 12, top: 8, bottom: 20 };
const MEGA = 1e6;
const STEPS = [1, 2, 5, 10, 20]; // possible distances of grid lines in dB
const LINES = 5; // most grid lines

// `fewest` returns the least splats of points to draw: one far away would squeeze the others.
export function makePlot(curve, fewest, choose) {
  const host = byId("plot");
  const tip = make("p", { className: "facts tip" });
  tip.setAttribute("aria-hidden", "true"); // the labels of the points have the same text
  let width = 0;

  function render() {
    if (!width) return;
    const now = curve.now && Number.isFinite(curve.now.psnr) && curve.now.bytes ? curve.now : null;
    const points = curve.points.filter(
      ({ splats, bytes, psnr }) => splats >= fewest() && bytes > 0 && Number.isFinite(psnr),
    );
    const all = now ? [...points, now] : points;
    const svg = drawn("svg", {
      width,
      height: HEIGHT,
      viewBox: `0 0 ${width} ${HEIGHT}`,
      role: "group",
    });
    svg.setAttribute("aria-label", `PSNR over file size, ${points.length} points`);
    if (!all.length) {
      const words = drawn("text", { x: width / 2, y: HEIGHT / 2, class: "empty" });
      words.textContent = "Points come as they are measured";
      svg.append(words);
    } else {
      draw(svg, points, now, all);
    }
    const focused = host.querySelector(":focus")?.dataset.key;
    host.replaceChildren(svg, tip);
    if (focused) host.querySelector(`[data-key="${focused}"]`)?.focus();
    rest(now);
  }

  function draw(svg, points, now, all) {
    const across = padded(
      numbers.logarithmic,
      all.map((point) => point.bytes / MEGA),
    );
    const up = padded(
      numbers.linear,
      all.map((point) => point.psnr),
    );
    const inner = { width: width - EDGE.left - EDGE.right, height: HEIGHT - EDGE.top - EDGE.bottom };
    const x = (megas) => EDGE.left + inner.width * across.place(megas);
    const y = (decibels) => EDGE.top + inner.height * (1 - up.place(decibels));
    const at = (point) => [x(point.bytes / MEGA), y(point.psnr)];
    // Only the last tick of each axis has the unit.
    const named = (ticks, unit) =>
      ticks.map((value, index) => [value, index === ticks.length - 1 ? ` ${unit}` : ""]);
    for (const [value, unit] of named(linearTicks(up), "dB")) {
      svg.append(
        drawn("line", {
          x1: EDGE.left,
          x2: width - EDGE.right,
          y1: y(value),
          y2: y(value),
          class: "rule",
        }),
      );
      svg.append(label(value + unit, EDGE.left - 6, y(value) + 3.5, "end"));
    }
    let sizes = logarithmicTicks(across, inner.width);
    if (!sizes.length) sizes = [all.at(-1).bytes / MEGA]; // no round number is near
    for (const [value, unit] of named(sizes, "MB")) {
      svg.append(
        drawn("line", {
          x1: x(value),
          x2: x(value),
          y1: EDGE.top,
          y2: HEIGHT - EDGE.bottom,
          class: "rule",
        }),
      );
      svg.append(label(tickText(value) + unit, x(value), HEIGHT - EDGE.bottom + 13, "middle"));
    }
    for (const kind of ["coarse", "measured"]) {
      const line = points.filter((point) => point.kind === kind).map(at);
      if (line.length > 1)
        svg.append(drawn("polyline", { points: line.join(" "), class: `through ${kind}` }));
    }
    for (const point of points) svg.append(dot(point, ...at(point)));
    if (now) svg.append(present(now, ...at(now)));
  }

  function dot(point, cx, cy) {
    const made = drawn(
      "g",
      {
        class: `point ${point.kind}`,
        tabindex: 0,
        role: "button",
        "aria-label": `${describe(point)}: choose it`,
      },
      drawn("circle", { cx, cy, r: 10, class: "reach" }),
      drawn("circle", { cx, cy, r: 3.5 }),
    );
    made.dataset.key = `${point.kind}${point.splats}`;
    for (const type of ["pointerenter", "focus"])
      made.addEventListener(type, () => say(describe(point)));
    for (const type of ["pointerleave", "blur"]) made.addEventListener(type, () => rest(curve.now));
    made.addEventListener("click", () => choose(point.splats));
    made.addEventListener("keydown", (event) => {
      if (event.key !== "Enter" && event.key !== " ") return;
      event.preventDefault();
      choose(point.splats);
    });
    return made;
  }

  const say = (words) => (tip.textContent = words);
  const rest = (now) => say(now ? describe(now) : "");
  new ResizeObserver(() => {
    if (host.clientWidth === width) return;
    width = host.clientWidth;
    render();
  }).observe(host);
  return { render };
}

function present(now, cx, cy) {
  const made = drawn("g", {
    class: `present ${now.kind}`,
    role: "img",
    "aria-label": `Now: ${describe(now)}`,
  });
  made.append(drawn("circle", { cx, cy, r: 7 }), drawn("circle", { cx, cy, r: 3.5 }));
  return made;
}

function describe({ splats, bytes, psnr, kind }) {
  const how = kind === "measured" ? "measured" : "estimated";
  return `${numbers.splats(splats)} · ${numbers.size(bytes)} · ${numbers.decibels(psnr)} dB · ${how}`;
}

function label(value, x, y, anchor) {
  const made = drawn("text", { x, y, "text-anchor": anchor });
  made.textContent = value;
  return made;
}

// Makes a scale over the values with a margin at both ends.
function padded(scale, values) {
  const [low, high] = [Math.min(...values), Math.max(...values)];
  if (scale === numbers.linear)
    return scale(low - Math.max(1, 0.1 * (high - low)), high + Math.max(1, 0.1 * (high - low)));
  const room = Math.max(1.25, (high / low) ** 0.07);
  return scale(low / room, high * room);
}

function linearTicks({ low, high }) {
  const step = STEPS.find((wide) => (high - low) / wide <= LINES) ?? STEPS.at(-1);
  const ticks = [];
  for (let value = Math.ceil(low / step) * step; value <= high; value += step) ticks.push(value);
  return ticks;
}

function logarithmicTicks({ low, high }, pixels) {
  const decades = Math.log10(high / low);
  const steps = pixels / decades > 110 ? [1, 2, 5] : [1];
  const ticks = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power += 1) {
    ticks.push(
      ...steps.map((step) => step * 10 ** power).filter((value) => value >= low && value <= high),
    );
  }
  return ticks;
}

const tickText = (value) =>
  value >= 1 ? value.toLocaleString("en-US") : String(Number(value.toPrecision(3)));
