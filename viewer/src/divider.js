// The line between the two models: dragged by mouse or finger, or moved by keys.

const STEP = 0.02;
const LEAP = 0.1;

export function makeDivider(host, models, onMove) {
  const line = document.createElement("div");
  line.className = "nv-divider";
  line.tabIndex = 0;
  line.innerHTML = '<span aria-hidden="true"></span>';
  const attributes = {
    role: "slider",
    "aria-label": "Line between the models",
    "aria-orientation": "horizontal",
    "aria-valuemin": 0,
    "aria-valuemax": 100,
  };
  for (const [name, value] of Object.entries(attributes)) line.setAttribute(name, value);
  let share = 0.5;

  function move(value) {
    share = Math.min(1, Math.max(0, value));
    line.style.left = `${100 * share}%`;
    line.setAttribute("aria-valuenow", Math.round(100 * share));
    line.setAttribute("aria-valuetext", `${Math.round(100 * share)} % ${models[0].name}`);
    onMove(share);
  }

  line.addEventListener("pointerdown", (event) => {
    line.setPointerCapture(event.pointerId);
    line.focus();
    event.preventDefault();
  });
  line.addEventListener("pointermove", (event) => {
    if (!line.hasPointerCapture(event.pointerId)) return;
    const box = host.getBoundingClientRect();
    move((event.clientX - box.left) / box.width);
  });
  const own = {
    ArrowLeft: () => move(share - STEP),
    ArrowRight: () => move(share + STEP),
    PageDown: () => move(share - LEAP),
    PageUp: () => move(share + LEAP),
    Home: () => move(0),
    End: () => move(1),
  };
  line.addEventListener("keydown", (event) => {
    if (!own[event.key] || event.shiftKey || event.ctrlKey || event.metaKey || event.altKey) return;
    own[event.key]();
    event.preventDefault();
    event.stopPropagation(); // the arrows would turn the model too
  });

  function key(event) {
    if (event.key === ",") move(share - STEP);
    else if (event.key === ".") move(share + STEP);
    else return false;
    return true;
  }
  host.append(line);
  move(share);
  return { key };
}
