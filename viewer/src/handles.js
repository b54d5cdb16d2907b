// Handles in the middle of a box's faces: dragged by mouse or finger, each along its own axis.

import { Vector3 } from "three";

const AXES = ["x", "y", "z"];
const STEEPEST = 0.998; // cosine between an axis and the line of sight above which a drag says nothing

// `onMove(axis, end, value)` gets the axis from 0 to 2, the end from 0 to 1, and units of the page.
export function makeHandles(host, camera, onMove) {
  const corners = [null, null];
  const handles = [0, 1, 2].flatMap((axis) => [0, 1].map((end) => made(axis, end)));

  // Fields and sliders of the page do the same, for keys and for those who do not see the picture.
  function made(axis, end) {
    const element = document.createElement("div");
    element.className = "nv-handle";
    element.dataset.face = `${AXES[axis]}-${end ? "high" : "low"}`;
    element.setAttribute("aria-hidden", "true");
    element.hidden = true;
    let grabbed = 0; // where along the axis it was taken hold of, beside its middle
    element.addEventListener("pointerdown", (event) => {
      element.setPointerCapture(event.pointerId);
      grabbed = (along(event, axis, end) ?? corners[end][axis]) - corners[end][axis];
      event.preventDefault();
    });
    element.addEventListener("pointermove", (event) => {
      if (!corners[0] || !element.hasPointerCapture(event.pointerId)) return; // it may go meanwhile
      const place = along(event, axis, end);
      if (place !== null) onMove(axis, end, place - grabbed);
    });
    host.append(element);
    return { axis, end, element };
  }

  function middle(axis, end) {
    const centre = [0, 1, 2].map((each) => (corners[0][each] + corners[1][each]) / 2);
    centre[axis] = corners[end][axis];
    return new Vector3(...centre);
  }

  // Where the axis through a face's middle comes nearest to what is under the pointer.
  function along(event, axis, end) {
    const { left, top, width, height } = host.getBoundingClientRect();
    const x = (2 * (event.clientX - left)) / width - 1;
    const y = 1 - (2 * (event.clientY - top)) / height;
    const sight = new Vector3(x, y, 0.5).unproject(camera).sub(camera.position).normalize();
    const centre = middle(axis, end);
    const away = centre.clone().sub(camera.position);
    const slope = sight.getComponent(axis);
    if (Math.abs(slope) > STEEPEST) return null;
    const shift = (slope * away.dot(sight) - away.getComponent(axis)) / (1 - slope * slope);
    return centre.getComponent(axis) + shift;
  }

  return {
    // Corners in units of the page; null takes the handles away, which nobody may take hold of then.
    set(low, high) {
      corners[0] = low;
      corners[1] = high;
      if (!low) for (const { element } of handles) element.hidden = true;
    },
    // Before each drawing: where they are under the camera as it is now.
    place() {
      if (!corners[0]) return;
      camera.updateMatrixWorld();
      for (const { axis, end, element } of handles) {
        const at = middle(axis, end);
        element.hidden = at.clone().applyMatrix4(camera.matrixWorldInverse).z > -camera.near;
        if (element.hidden) continue;
        at.project(camera);
        element.style.left = `${50 + 50 * at.x}%`;
        element.style.top = `${50 - 50 * at.y}%`;
      }
    },
  };
}
