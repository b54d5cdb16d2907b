// What is seen, and how to move about it.

const HELP = [
  ["turn", "drag, or one finger", ["← → ↑ ↓"]],
  ["nearer, farther", "wheel, or pinch", ["+", "−"]],
  ["move", "right button, or two fingers", ["Shift", "← → ↑ ↓"]],
  ["first view", "", ["0"]],
];
const HELP_TWO = ["the line", "drag", [",", "."]];

export function makeLabels(host, scene, { choose, reset }) {
  const { models } = scene;
  host.append(label(models[0], "nv-left"));
  if (models.length === 2) host.append(label(models[1], "nv-right"));
  if (models.length > 2) host.append(chooser(models, choose));
  const help = helpPanel(models.length > 1);
  const bar = element("div", "nv-bar");
  const buttons = [button("First view", reset), button("Help", () => toggle(help, buttons[1]))];
  buttons[1].setAttribute("aria-expanded", "false");
  if (document.fullscreenEnabled) buttons.push(button("Full screen", () => fullScreen(host)));
  bar.append(...buttons);
  host.append(help, bar);
}

// Words of both sides that a page sets, and sets again.
export function makeSideLabels(host, names) {
  const boxes = ["nv-left", "nv-right"].map((side, index) =>
    label({ name: names[index], facts: [] }, side),
  );
  host.append(...boxes);
  const set = (side, name, lines) =>
    boxes[side].replaceChildren(element("strong", "", name), ...facts({ facts: lines }));
  return { set };
}

function label(model, side) {
  const box = element("div", `nv-label ${side}`);
  box.append(element("strong", "", model.name), ...facts(model));
  return box;
}

function facts(model) {
  return model.facts.map((fact) => element("span", "", fact));
}

// With more than two models, the right side takes any of them but the first.
function chooser(models, choose) {
  const box = element("div", "nv-label nv-right");
  const select = element("select", "");
  select.setAttribute("aria-label", "Model on the right");
  models.slice(1).forEach((model, index) => {
    select.append(new Option(`${model.name}: ${model.facts[0]}`, index + 1));
  });
  const fill = () => box.replaceChildren(select, ...facts(models[Number(select.value)]));
  select.addEventListener("change", () => {
    fill();
    choose(Number(select.value));
  });
  fill();
  return box;
}

function helpPanel(two) {
  const panel = element("dl", "nv-help");
  panel.hidden = true;
  for (const [what, how, keys] of two ? [...HELP, HELP_TWO] : HELP) {
    const ways = element("dd", "", how);
    ways.append(...keys.map((key) => element("kbd", "", key)));
    panel.append(element("dt", "", what), ways);
  }
  return panel;
}

function toggle(panel, control) {
  panel.hidden = !panel.hidden;
  control.setAttribute("aria-expanded", String(!panel.hidden));
}

function fullScreen(host) {
  if (document.fullscreenElement) document.exitFullscreen();
  else host.requestFullscreen();
}

function button(text, action) {
  const made = element("button", "", text);
  made.type = "button";
  made.addEventListener("click", action);
  return made;
}

function element(name, className, text = "") {
  return Object.assign(document.createElement(name), { className, textContent: text });
}
