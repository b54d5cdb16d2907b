// One camera that turns about a point: mouse, touch and keys.

import { MathUtils, PerspectiveCamera, Quaternion, Vector3 } from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

const FAR = 1e5; // the models of a page are scaled so that the camera starts at a distance of 8
const NEAREST = 0.02;
const FARTHEST = 400;
const WIDEST = 1; // tangent of half the field of view from top to bottom
const TURN = MathUtils.degToRad(5); // a press of a key
const STEP = 40; // CSS pixels
const ZOOM = 0.9;

export function makeNavigation(canvas, start, invalidate) {
  const camera = new PerspectiveCamera(50, 1, 0.1, FAR);
  camera.up.fromArray(start.up);
  camera.position.fromArray(start.position);
  let controls = begin(new Vector3().fromArray(start.target));

  // They take the camera's up but once, so another up needs others; here is their first view.
  function begin(target) {
    const made = new OrbitControls(camera, canvas);
    made.target.copy(target);
    made.minDistance = NEAREST;
    made.maxDistance = FARTHEST;
    made.update();
    made.saveState();
    made.addEventListener("change", invalidate);
    return made;
  }
  // Before each drawing: what is culled at the lens follows the distance.
  function update() {
    camera.near = start.near * controls.getDistance();
    camera.updateProjectionMatrix();
  }

  // The first view fits into a square, and that into the shorter side of the window, as far as
  // the other side then shows no more than is natural.
  function resize(width, height) {
    const tangent = Math.min(start.lens * Math.max(1, height / width), Math.max(start.lens, WIDEST));
    camera.fov = MathUtils.radToDeg(2 * Math.atan(tangent));
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
  }

  function reset() {
    controls.reset();
    invalidate();
  }

  // Another direction is up: the first view turns with it, so that the picture tips over.
  function setUp(vector) {
    controls.reset();
    const up = new Vector3().fromArray(vector).normalize();
    const turn = new Quaternion().setFromUnitVectors(camera.up, up);
    const { target } = controls;
    camera.position.sub(target).applyQuaternion(turn).add(target);
    camera.up.copy(up);
    controls.dispose();
    controls = begin(target);
    invalidate();
  }

  const turns = {
    ArrowLeft: () => controls.rotateLeft(TURN),
    ArrowRight: () => controls.rotateLeft(-TURN),
    ArrowUp: () => controls.rotateUp(TURN),
    ArrowDown: () => controls.rotateUp(-TURN),
  };
  const moves = {
    ArrowLeft: () => controls.pan(STEP, 0),
    ArrowRight: () => controls.pan(-STEP, 0),
    ArrowUp: () => controls.pan(0, STEP),
    ArrowDown: () => controls.pan(0, -STEP),
  };
  const others = {
    "+": () => controls.dollyIn(ZOOM),
    "=": () => controls.dollyIn(ZOOM), // + without Shift on many keyboards
    "-": () => controls.dollyOut(ZOOM),
    0: reset,
  };

  function key(event) {
    const action = (event.shiftKey ? moves : turns)[event.key] ?? others[event.key];
    if (action) action();
    return Boolean(action);
  }
  return { camera, update, resize, reset, setUp, key };
}
