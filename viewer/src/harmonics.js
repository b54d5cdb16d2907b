// View dependence, encoded anew.
//
// Spark 2.2.0 writes each higher coefficient as three bytes over one power of two, but takes the
// power below the largest of the three and not the one above: the largest is cut down to that power,
// by up to half. Here the bytes come from the .spz file and are written as Spark's shader reads them.

const HEADER = 16; // bytes: magic, version, count, degree, fraction bits, flags, reserved
const BEFORE = 9 + 1 + 3 + 3 + 4; // bytes a splat: centre, alpha, colour, scales, rotation
const ZERO = 128;
const ONE = 7; // 128 = 2^7 steps make 1
const BIAS = 15;

// Where the coefficient of that number goes: array, and place among the four of a splat.
const PLACES = [
  ...[0, 1, 2, 3].map((place) => ["sh1", place]),
  ...[0, 1, 2, 3].map((place) => ["sh2", place]),
  ...[0, 1, 2, 3].map((place) => ["sh3a", place]),
  ...[0, 1, 2].map((place) => ["sh3b", place]),
];

// For a largest magnitude in steps of 1/128, the exponent of the power of two not below it.
const EXPONENTS = Uint8Array.from({ length: ZERO + 1 }, (_, steps) =>
  steps < 2 ? 0 : 32 - Math.clz32(steps - 1),
);

export async function rewriteHarmonics(extra, file) {
  const stream = new Blob([file]).stream().pipeThrough(new DecompressionStream("gzip"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const header = new DataView(bytes.buffer);
  const count = header.getUint32(8, true);
  const coefficients = (bytes[12] + 1) ** 2 - 1;
  const first = HEADER + BEFORE * count;
  for (let which = 0; which < coefficients; which += 1) {
    const [name, place] = PLACES[which];
    const target = extra[name];
    for (let splat = 0; splat < count; splat += 1) {
      const at = first + 3 * (coefficients * splat + which);
      target[4 * splat + place] = encode(bytes[at] - ZERO, bytes[at + 1] - ZERO, bytes[at + 2] - ZERO);
    }
  }
}

function encode(red, green, blue) {
  const exponent = EXPONENTS[Math.max(Math.abs(red), Math.abs(green), Math.abs(blue))];
  const factor = 255 / (1 << exponent);
  const signs = (red < 0) | ((green < 0) << 1) | ((blue < 0) << 2);
  return (
    Math.round(Math.abs(red) * factor) |
    (Math.round(Math.abs(green) * factor) << 8) |
    (Math.round(Math.abs(blue) * factor) << 16) |
    (signs << 24) |
    ((exponent - ONE + BIAS) << 27)
  );
}
