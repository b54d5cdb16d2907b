// The page of `nanogs studio`: it sends requests and shows the answers; the server computes.

import { makeAnswers } from "./answers.js";
import { makeAsks } from "./asks.js";
import { connect } from "./connection.js";
import { makeCurve } from "./curve.js";
import { byId, copyButton, showCommand } from "./dom.js";
import { NONE } from "./filters.js";
import { bindKeys } from "./keys.js";
import { keep, kept } from "./kept.js";
import { makeMethod } from "./method.js";
import * as numbers from "./numbers.js";
import { beginSaving, endSaving } from "./phase.js";
import { makePicture } from "./picture.js";
import { makePlot } from "./plot.js";
import { makePreview } from "./preview.js";
import { makeSave } from "./save.js";
import { makeSliders } from "./sliders.js";
import { makeState, same } from "./state.js";
import { makeStatus } from "./status.js";

const SHARE = 0.1; // share of the splats that the page starts with
const LIKED = ".sog"; // format that the page starts with, if it can be written

const connection = connect();
const status = makeStatus(stop);
const data = document.body.dataset;

function stop() {
  if (status.cancellable) connection.post("cancel", {}).catch((error) => status.complain(error.message));
}

let begun = null;
connection.on("scene", (scene) => {
  if (begun) begun.again(scene);
  else open(scene);
});
connection.on("failed", ({ message }) => {
  if (begun) return; // `begin` listens, too
  data.state = "failed";
  status.say("");
  status.complain(message);
});
connection.on("progress", (event) => status.work(event));
connection.on("connected", () => {
  if (data.lost) status.complain("");
  delete data.lost;
});
connection.on("lost", ({ final }) => {
  data.lost = "true";
  status.complain(
    final
      ? "The studio has ended; start the command again."
      : "The studio does not answer, because its command has ended or is busy. Trying again …",
  );
});

function open(scene) {
  try {
    begun = begin(scene);
  } catch (error) {
    data.state = "failed";
    status.say("");
    // None of them is connected with anything.
    for (const control of document.querySelectorAll("button, input, select"))
      control.disabled = !control.closest("#alert");
    status.complain(`The studio cannot draw: ${error.message}`);
    throw error;
  }
}

function begin(scene) {
  const state = makeState(kept() ?? firstChoice(scene));
  const curve = makeCurve();
  const picture = makePicture(scene, connection.model, {
    complain: status.complain,
    onStill: (pace) => answers.drawn(pace),
    onBox: (...moved) => preview.drag(...moved),
  });
  const sliders = makeSliders(scene, state, curve, status.complain);
  const plot = makePlot(curve, sliders.lowest, (splats) => state.set({ wish: { splats } }));
  const method = makeMethod(scene, state);
  const asks = makeAsks(connection, state, {
    onSend: (choice, before) => answers.await(choice, before),
    onCommand: ({ command }) => showCommand(byId("command"), command),
    onRefuse: (number, message) => answers.fail(number, message),
  });
  const tellSeen = (body) => connection.post("seen", body);
  const parts = { asks, curve, sliders, plot, picture, status, tellSeen };
  const answers = makeAnswers(scene, state, parts);

  const facts = [numbers.splats(scene.splats), numbers.size(scene.file_bytes)];
  byId("scene-facts").textContent = facts.join(" · ");
  picture.bind();
  picture.base(scene.model, scene.name, facts).catch((error) => status.complain(error.message));
  const { rest } = answers;
  const preview = makePreview(scene, state, facts, { connection, asks, picture, status, rest });

  connection.on("filtered", preview.filtered);
  connection.on("draft", answers.draft);
  connection.on("made", answers.made);
  connection.on("measured", answers.measured);
  connection.on("point", answers.point);
  connection.on("explored", rest);
  connection.on("cancelled", (event) => {
    answers.cancelled(event);
    preview.refused(event.number, "Cancelled.");
  });
  connection.on("failed", ({ number, message, kind }) => {
    if (preview.refused(number, message)) rest();
    else if (kind !== "save") answers.fail(number, message);
  });

  const openSave = makeSave(scene, state, connection, {
    onStart: beginSaving,
    onEnd() {
      endSaving();
      rest();
    },
  });
  bindButtons(state, picture, openSave);
  state.listen((choice, before) => {
    keep(choice);
    byId("undo").disabled = !state.canUndo;
    byId("redo").disabled = !state.canRedo;
    method.render(choice);
    preview.follow(choice, before);
    if (choice.up !== before.up) picture.up(choice.up);
    if (!same(choice, before)) {
      sliders.show(null);
      asks.send();
    }
  });
  method.render(state.choice);
  if (state.choice.up !== null) picture.up(state.choice.up);
  sliders.render();
  asks.send();
  let { id } = scene.model;
  return {
    // Called when the scene has come again: after the connection was lost, or from a new worker,
    // whose model has another ID and which takes this page to show the whole scene.
    again({ model }) {
      if (model.id !== id) preview.reopened(model);
      id = model.id;
      asks.again();
    },
  };
}

function firstChoice(scene) {
  return {
    wish: { splats: Math.max(1, Math.round(SHARE * (scene.available ?? scene.splats))) },
    format: scene.formats.includes(LIKED) ? LIKED : scene.formats[0],
    preset: "default",
    sh_degree: null,
    filters: NONE,
    render_mode: null,
    up: null,
    levels: null,
    ...scene.first,
  };
}

function bindButtons(state, picture, openSave) {
  byId("save-open").disabled = false;
  byId("save-open").addEventListener("click", openSave);
  byId("help-open").addEventListener("click", () => byId("help").showModal());
  byId("undo").addEventListener("click", state.undo);
  byId("redo").addEventListener("click", state.redo);
  copyButton(byId("copy"), () => byId("command"));
  bindKeys({ state, picture, stop });
}
