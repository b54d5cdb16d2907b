// Points of size and quality that the server has sent, and interpolation between them. It moves two
// sliders while the third is dragged, and is plotted; all final numbers are those of the server.

export function makeCurve() {
  let points = []; // by splats, ascending
  let now = null; // the point of the model that is shown

  const through = (key, across, value) => {
    const line = lineOf(key);
    return line.length ? between(line, across, value) : null;
  };
  // Uses only the coarse points if there are two, because measured ones are above them.
  function lineOf(key) {
    const known = points.filter((point) => point[key] !== null && Number.isFinite(point[key]));
    const coarse = known.filter((point) => point.kind === "coarse");
    const used = coarse.length > 1 ? coarse : known;
    const line = used.length || !now || now[key] === null ? used : [now];
    return line.map((point) => ({
      splats: Math.log(point.splats),
      value: key === "psnr" ? point.psnr : Math.log(point[key]),
    }));
  }
  // Returns how much the shown model is above the line.
  function lift(key) {
    if (!now || now[key] === null || !Number.isFinite(now[key])) return 0;
    const value = key === "psnr" ? now.psnr : Math.log(now[key]);
    const there = through(key, "splats", Math.log(now.splats));
    return there === null ? 0 : value - there;
  }

  return {
    get points() {
      return points;
    },
    get now() {
      return now;
    },
    clear() {
      points = [];
      now = null;
    },
    forgetBytes() {
      points = points.map((point) => ({ ...point, bytes: null }));
      if (now) now = { ...now, bytes: null };
    },
    add({ splats, bytes, psnr, kind }) {
      points = points.filter((point) => point.splats !== splats || point.kind !== kind);
      points.push({ splats, bytes, psnr, kind });
      points.sort((one, other) => one.splats - other.splats);
    },
    put(point) {
      now = point;
    },
    // Returns null while there are no points.
    bytesOf(splats) {
      const value = through("bytes", "splats", Math.log(splats));
      return value === null ? null : Math.exp(value + lift("bytes"));
    },
    psnrOf(splats) {
      const line = lineOf("psnr");
      return line.length < 2 ? null : through("psnr", "splats", Math.log(splats)) + lift("psnr");
    },
    splatsFor(key, value) {
      if (key === "splats") return value;
      if (key === "psnr" && lineOf("psnr").length < 2) return null;
      const wanted = (key === "psnr" ? value : Math.log(value)) - lift(key);
      const found = through(key, "value", wanted);
      return found === null ? null : Math.exp(found);
    },
  };
}

// Interpolates linearly between points, and extrapolates at both ends; `across`, the axis of `at`,
// is "splats" or "value".
function between(line, across, at) {
  const along = across === "splats" ? "value" : "splats";
  if (line.length === 1) {
    // With a single point, bytes are taken to be proportional to splats.
    return line[0][along] + (at - line[0][across]);
  }
  let after = line.findIndex((point) => point[across] > at);
  if (after < 0) after = line.length - 1;
  const [one, other] = [line[Math.max(after - 1, 0)], line[Math.max(after, 1)]];
  const span = other[across] - one[across];
  return span ? one[along] + ((at - one[across]) / span) * (other[along] - one[along]) : one[along];
}
