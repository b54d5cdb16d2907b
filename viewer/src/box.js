// A box of lines: covered by what is before it, and faint where it is covered.

import { Scene } from "three";
import { LineMaterial } from "three/examples/jsm/lines/LineMaterial.js";
import { LineSegments2 } from "three/examples/jsm/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/examples/jsm/lines/LineSegmentsGeometry.js";

const COLOUR = "#ffc53d";
const WIDTH = 2; // CSS pixels
const FAINT = 0.45;

export function makeBox(panes) {
  const whole = new LineMaterial({ color: COLOUR, linewidth: WIDTH });
  const faint = new LineMaterial({
    color: COLOUR,
    linewidth: WIDTH,
    transparent: true,
    opacity: FAINT,
    depthTest: false,
    depthWrite: false,
  });
  const above = new Scene(); // drawn last, over all that is on the canvas
  const lines = [...panes.map((pane) => added(pane.scene, whole)), added(above, faint)];

  function added(scene, material) {
    const made = new LineSegments2(new LineSegmentsGeometry(), material);
    made.visible = false;
    made.frustumCulled = false;
    scene.add(made);
    return made;
  }

  // Corners in units of the page; null takes the box away.
  function set(low, high) {
    for (const line of lines) {
      line.visible = Boolean(low && high);
      if (!line.visible) continue;
      line.geometry.dispose(); // the old lines on the graphics processor
      line.geometry = new LineSegmentsGeometry().setPositions(edges(low, high));
    }
  }
  return {
    set,
    above,
    get shown() {
      return lines.at(-1).visible;
    },
    // The lines among the splats; the picture of a difference has no use for them.
    among(wanted) {
      for (const line of lines.slice(0, -1)) line.visible = wanted && lines.at(-1).visible;
    },
  };
}

// Both ends of the twelve edges, one after the other.
function edges(low, high) {
  const corner = (bits) => [0, 1, 2].map((axis) => ((bits >> axis) & 1 ? high : low)[axis]);
  const positions = [];
  for (let bits = 0; bits < 8; bits += 1) {
    for (let axis = 0; axis < 3; axis += 1) {
      if (!((bits >> axis) & 1)) positions.push(...corner(bits), ...corner(bits | (1 << axis)));
    }
  }
  return positions;
}
