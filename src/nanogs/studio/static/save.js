// The dialogue for saving: folder, name and format, and the command that does the same.

import { byId, copyButton, make, showCommand } from "./dom.js";
import * as numbers from "./numbers.js";
import { jobText } from "./stages.js";
import { showFraction } from "./status.js";

const PAUSE = 150; // milliseconds without typing before the name is checked

export function makeSave(scene, state, connection, { onStart, onEnd }) {
  const dialog = byId("save");
  const [name, format, ratios, go] = ["save-name", "save-format", "ratios", "save-go"].map(byId);
  const said = byId("save-said");
  let folder = "";
  let stem = `${scene.stem}-small`;
  let overwrite = false;
  let exists = false; // whether a file of that name exists
  let unchecked = false; // whether the server has yet to answer for what is chosen now
  let running = 0; // request number of the running save; 0 for none
  let timer = 0;
  let checked = 0;
  let opening = Promise.resolve(); // settles when the folder chosen last has been listed

  format.append(
    group(
      "One file",
      scene.formats.map((suffix) => new Option(suffix, `file ${suffix}`)),
    ),
    group(
      "Levels of detail",
      (scene.layouts ?? []).map(
        (layout) => new Option(`${layout.suffix}: ${layout.name}`, `levels ${layout.suffix}`),
      ),
    ),
  );

  const layout = () => {
    const [kind, suffix] = format.value.split(" ");
    return kind === "levels" ? scene.layouts.find((one) => one.suffix === suffix) : null;
  };
  const suffix = () => format.value.split(" ")[1];
  // What the name of a file has after its stem; a format without a dot names a file in a folder.
  const ending = () => (suffix().startsWith(".") ? suffix() : `/${suffix()}`);
  const path = () => (folder ? `${folder}/${name.value.trim()}` : name.value.trim());
  const choice = () => ({
    ...state.choice,
    format: suffix(),
    levels: layout() ? ratios.value.trim() : null,
  });

  function say(words, wrong = false) {
    said.textContent = words;
    said.classList.toggle("wrong", wrong);
  }

  // Changes the suffix of the name to that of the format, and keeps the typed stem.
  function rename() {
    const found = layout();
    name.value = found ? stem + found.example.slice(scene.stem.length) : `${stem}${ending()}`;
    for (const element of dialog.querySelectorAll(".levels")) element.hidden = !found;
    changed(0);
  }

  function changed(pause = PAUSE) {
    if (running) return;
    overwrite = exists = false; // until `check` has asked the server
    unchecked = true;
    checked += 1; // so that an answer for what was chosen before is ignored
    go.textContent = "Save";
    byId("save-lines").replaceChildren();
    clearTimeout(timer);
    timer = setTimeout(check, pause);
  }

  // Asks the server for the command, or for the reason why the choice cannot be saved.
  async function check() {
    clearTimeout(timer);
    const turn = (checked += 1);
    const wish = { choice: choice(), path: path() };
    const found = await connection.post("command", wish).catch(({ message }) => ({ message }));
    if (turn !== checked || running) return;
    unchecked = false;
    exists = Boolean(found.exists);
    showCommand(byId("save-command"), found.command);
    byId("save-copy").disabled = !found.command;
    go.disabled = Boolean(found.message);
    say(found.message ?? "", true);
  }

  function open(where) {
    opening = list(where);
    return opening;
  }

  async function list(where) {
    try {
      const listed = await connection.files(where);
      folder = listed.folder;
      byId("folder").textContent = folder ? `${folder}/` : `${scene.folder}`;
      byId("folder-up").disabled = listed.parent === null;
      byId("folder-up").onclick = () => open(listed.parent).then(() => changed(0));
      byId("entries").replaceChildren(...listed.entries.map(entry));
    } catch (error) {
      say(error.message, true);
    }
  }

  function entry({ name: called, kind, bytes }) {
    const button = make("button", { type: "button", className: kind });
    button.append(make("span", { textContent: kind === "folder" ? `${called}/` : called }));
    button.append(
      make("span", { className: "facts", textContent: kind === "folder" ? "" : numbers.size(bytes) }),
    );
    button.disabled = kind === "file";
    button.addEventListener("click", () => {
      if (kind === "folder") open(folder ? `${folder}/${called}` : called).then(() => changed(0));
      else {
        name.value = called;
        learnStem();
        changed(0);
      }
    });
    return make("li", {}, button);
  }

  function learnStem() {
    const end = layout() ? /\/[^/]*$|\.[^./]*$/ : ending();
    const typed = name.value.trim();
    if (typeof end === "string") stem = typed.endsWith(end) ? typed.slice(0, -end.length) : typed;
    else stem = typed.replace(end, "");
  }

  function askFirst(words) {
    overwrite = true;
    go.textContent = "Replace it";
    say(words);
    go.focus();
  }

  async function save() {
    go.disabled = true;
    await opening; // otherwise the file would go to the folder that was open before
    if (unchecked) await check(); // a click may come before the name was checked
    else go.disabled = false;
    if (go.disabled) return; // `check` has said why, or the name was changed meanwhile
    if (exists && !overwrite) {
      askFirst(`${path()} exists. Replace it?`);
      return;
    }
    say("Saving …");
    busy(true);
    const { number, answer } = connection.start("save", { choice: choice(), path: path(), overwrite });
    running = number;
    onStart(number);
    try {
      const { command } = await answer;
      if (running === number) showCommand(byId("save-command"), command); // unless it has ended
    } catch (error) {
      running = 0;
      busy(false);
      onEnd();
      if (error.status === 409 && !overwrite) askFirst(error.message);
      else say(error.message, true);
    }
  }

  function busy(on) {
    go.disabled = name.disabled = format.disabled = ratios.disabled = on;
    byId("save-cancel").hidden = !on;
    byId("save-progress").hidden = !on;
    if (on) showFraction(byId("save-progress"), null);
  }

  function finish(words, wrong) {
    running = 0;
    busy(false);
    overwrite = false;
    go.textContent = "Save";
    say(words, wrong);
    onEnd();
  }

  dialog.querySelector("form").addEventListener("submit", (event) => {
    event.preventDefault();
    if (!go.disabled && !running) save();
  });
  byId("save-close").addEventListener("click", () => dialog.close());
  byId("save-cancel").addEventListener("click", () => connection.post("cancel", {}).catch(() => {}));
  name.addEventListener("input", () => {
    learnStem();
    changed();
  });
  ratios.addEventListener("input", () => changed());
  format.addEventListener("change", rename);
  copyButton(byId("save-copy"), () => byId("save-command"));

  connection.on("progress", (event) => {
    if (!running || event.number !== running) return;
    say(jobText("Saving", event.stage));
    showFraction(byId("save-progress"), event.fraction);
  });
  connection.on("saved", (event) => {
    if (event.number !== running) return;
    finish(
      `${event.short ? `${event.short} ` : ""}Saved: ${event.path}, ${numbers.size(event.bytes)}.`,
      false,
    );
    showCommand(byId("save-command"), event.command);
    const lines = (event.lines ?? []).flatMap(([label, value]) => [
      make("dt", { textContent: label }),
      make("dd", { textContent: value }),
    ]);
    byId("save-lines").replaceChildren(...lines);
    open(folder);
  });
  connection.on("failed", (event) => {
    if (running && event.number === running) finish(event.message, true);
  });
  connection.on("cancelled", (event) => {
    if (running && event.number === running) finish("Cancelled; nothing was written.", false);
  });

  return () => {
    if (!running) {
      format.value = `file ${state.choice.format}`;
      rename();
      say("");
      open(folder);
    }
    dialog.showModal();
    name.focus();
    name.setSelectionRange(0, stem.length);
  };
}

function group(label, options) {
  const made = make("optgroup", { label });
  made.append(...options);
  return made;
}
