// The sliders for splats, bytes and PSNR: the one that is moved sets the goal, the others follow.

import { byId, onCommit } from "./dom.js";
import * as numbers from "./numbers.js";

const STEPS = 1000;
const DECIBELS = 5; // the ends of the PSNR slider are multiples of this
const USUAL = [20, 45]; // ends of the PSNR slider in dB, until points are known

const KINDS = {
  splats: {
    words: numbers.count,
    read: numbers.parsedCount,
    tidy: Math.round,
    full: numbers.splats,
    sample: "such as 50,000",
  },
  bytes: {
    words: numbers.megabytes,
    read: (words) => numbers.bytesOf(numbers.parsed(words)),
    tidy: (value) => numbers.bytesOf(numbers.parsed(numbers.megabytes(value))),
    full: numbers.size,
    sample: "in megabytes, such as 1.5",
  },
  psnr: {
    words: numbers.decibels,
    read: numbers.parsed,
    tidy: (value) => Math.round(100 * value) / 100,
    full: (value) => `${numbers.decibels(value)} dB`,
    sample: "in decibels, such as 35",
  },
};

export function makeSliders(scene, state, curve, complain) {
  const limits = { most: scene.available ?? scene.splats, fewest: scene.fewest };
  const rows = Object.entries(KINDS).map(([key, kind]) => row(key, kind));

  function row(key, kind) {
    const field = byId(key);
    const range = byId(`${key}-range`);
    const one = { key, kind, field, range, got: byId(`${key}-got`), dirty: false };
    const wish = (value, passing) => state.set({ wish: { [key]: value } }, passing);
    const slide = (passing) => () => wish(kind.tidy(scaleOf(key).at(range.value / STEPS)), passing);
    range.addEventListener("input", slide(true));
    range.addEventListener("change", slide(false));
    field.addEventListener("input", () => (one.dirty = true));
    onCommit(field, () => {
      if (!one.dirty) return;
      const value = kind.read(field.value);
      const wrong = fault(key, kind, value, field.value);
      field.setAttribute("aria-invalid", String(Boolean(wrong)));
      if (wrong) {
        complain(wrong);
        return;
      }
      one.dirty = false;
      complain("");
      wish(value, false);
      render();
    });
    field.addEventListener("blur", () => {
      if (!one.dirty) return;
      one.dirty = false;
      field.removeAttribute("aria-invalid");
      render();
    });
    field.disabled = range.disabled = false;
    return one;
  }

  function fault(key, kind, value, words) {
    if (!(value > 0)) return `“${words}” is not a number above 0; type one ${kind.sample}.`;
    if (key !== "splats") return "";
    if (!Number.isInteger(value)) return `“${words}” is not a whole number; type one ${kind.sample}.`;
    if (value <= limits.most) return "";
    return `The scene has ${numbers.splats(limits.most)}; choose that many or fewer.`;
  }

  // Least splats of the slider; smaller counts can be typed.
  const lowest = () => Math.max(limits.fewest ?? 1, Math.min(100, limits.most / 1000));

  function scaleOf(key) {
    const fewest = lowest();
    if (key === "splats") return numbers.logarithmic(fewest, limits.most);
    if (key === "bytes") {
      const [low, high] = [curve.bytesOf(fewest), curve.bytesOf(limits.most)];
      return numbers.logarithmic(low ?? 20 * fewest, high ?? 20 * limits.most);
    }
    const known = [...curve.points, curve.now].map((point) => point?.psnr).filter(Number.isFinite);
    const low = Math.min(...known, USUAL[0] + DECIBELS);
    const high = Math.max(...known, USUAL[1] - DECIBELS);
    return numbers.linear(
      DECIBELS * (Math.ceil(low / DECIBELS) - 1),
      DECIBELS * (Math.floor(high / DECIBELS) + 1),
    );
  }

  // Returns the three values: as answered, or until then as interpolated by the curve.
  function values(answer) {
    const [[key, value]] = Object.entries(state.choice.wish);
    if (answer) return { ...answer };
    const splats = curve.splatsFor(key, value);
    if (splats === null) return { [key]: value };
    const kept = Math.min(splats, limits.most);
    return { splats: kept, bytes: curve.bytesOf(kept), psnr: curve.psnrOf(kept), [key]: value };
  }

  let answer = null;
  function render() {
    const found = values(answer);
    const [[wished, wish]] = Object.entries(state.choice.wish);
    for (const { key, kind, field, range, got, dirty } of rows) {
      const pinned = key === wished;
      const value = pinned ? wish : found[key];
      const known = Number.isFinite(value);
      field.closest(".wish").classList.toggle("pinned", pinned);
      if (!dirty) field.value = known ? kind.words(value) : "";
      field.placeholder = known ? "" : "–";
      range.value = known ? Math.round(STEPS * scaleOf(key).place(value)) : 0;
      range.classList.toggle("unknown", !known);
      range.style.setProperty("--filled", `${range.value / (STEPS / 100)}%`);
      range.setAttribute("aria-valuetext", known ? kind.full(value) : "not known yet");
      const apart =
        pinned && answer && Number.isFinite(answer[key]) && kind.words(answer[key]) !== kind.words(wish);
      got.textContent = apart ? `got ${kind.words(answer[key])}` : "";
    }
  }

  return {
    // `found` has the server's answer to the present choice, or is null until it has answered.
    show(found) {
      answer = found;
      render();
    },
    limit({ available, fewest }) {
      if (available) limits.most = available;
      if (fewest) limits.fewest = fewest;
    },
    render,
    lowest,
  };
}
