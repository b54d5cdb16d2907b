// Formatting and parsing numbers for people, and the scales of sliders.

const DASH = "–";
const MEGA = 1e6; // bytes
const UNITS = { k: 1e3, m: 1e6, g: 1e9 };

export const count = (value) => Math.round(value).toLocaleString("en-US");
export const splats = (value) => `${count(value)} ${value === 1 ? "splat" : "splats"}`;
export const decibels = (value) => (value === null || value === undefined ? DASH : text(value, 2));
export const megabytes = (bytes) => significant(bytes / MEGA);
export const bytesOf = (megas) => Math.round(megas * MEGA);

// Formats bytes as the command does in the terminal.
export function size(bytes) {
  if (bytes === null || bytes === undefined) return DASH;
  let value = bytes;
  for (const unit of ["B", "kB", "MB"]) {
    if (value < 999.95) return `${unit === "B" ? value : value.toFixed(1)} ${unit}`;
    value /= 1000;
  }
  return `${value.toFixed(1)} GB`;
}

export function percent(share) {
  return `${(100 * share).toFixed(share < 0.0995 ? 2 : 1)} %`;
}

export function duration(seconds) {
  if (seconds < 0.95) return `${seconds.toFixed(1)} s`;
  if (seconds < 90) return `${Math.round(seconds)} s`;
  return seconds < 5400 ? `${Math.round(seconds / 60)} min` : `${(seconds / 3600).toFixed(1)} h`;
}

// Formats with four digits, enough for a slider of a thousand steps.
export function significant(value) {
  if (!value) return "0";
  const digits = Math.max(0, 3 - Math.floor(Math.log10(Math.abs(value))));
  return text(value, Math.min(digits, 8));
}

function text(value, digits) {
  const options = { minimumFractionDigits: digits, maximumFractionDigits: digits };
  return Number.isFinite(value) ? value.toLocaleString("en-US", options) : "∞";
}

// A comma separates thousands, and is no decimal point: "1,5" is refused rather than guessed.
const NUMBER = /^[-+]?(?:\d*|[1-9]\d{0,2}(?:,\d{3})+)(?:\.\d*)?(?:e[-+]?\d+)?$/i;

// Parses typed text such as "50,000" or "1.5"; NaN if it is not a number.
export function parsed(words) {
  const bare = words.replace(/[\s_]/g, "");
  return bare && NUMBER.test(bare) ? Number(bare.replaceAll(",", "")) : NaN;
}

// Parses a typed count such as "50,000", "50k" or "1.2 M"; NaN if it is not a number.
export function parsedCount(words) {
  const [, bare, unit] = /^(.*?)([kmg]?)$/is.exec(words.trim());
  const value = parsed(bare) * (UNITS[unit.toLowerCase()] ?? 1);
  return Number(value.toPrecision(12)); // 1.1 times 1,000 is 1,100.0000000000002
}

// Maps the position on a slider, 0 to 1, to a value (`at`) and back (`place`).
export function logarithmic(low, high) {
  const span = Math.log(high / low) || 1;
  return {
    low,
    high,
    at: (place) => low * Math.exp(place * span),
    place: (value) => clamp(Math.log(value / low) / span),
  };
}

export function linear(low, high) {
  const span = high - low || 1;
  return {
    low,
    high,
    at: (place) => low + place * span,
    place: (value) => clamp((value - low) / span),
  };
}

// A scale that is finer at its lower end, where small differences of opacity matter most.
export function squared(high) {
  return {
    low: 0,
    high,
    at: (place) => high * place ** 2,
    place: (value) => clamp(Math.sqrt(value / high)),
  };
}

const clamp = (place) => Math.min(1, Math.max(0, place));
