// The page of `nanogs studio`: it shows and asks; what is computed is computed by the server.

import { connect } from "./connection.js";
import { makeCurve } from "./curve.js";
import { byId, copyButton } from "./dom.js";
import { makeFilters, NONE } from "./filters.js";
import { bindKeys } from "./keys.js";
import { makeMethod } from "./method.js";
import * as numbers from "./numbers.js";
import { makePicture } from "./picture.js";
import { makePlot } from "./plot.js";
import { makeSave } from "./save.js";
import { makeSliders } from "./sliders.js";
import { makeState, same, sameGround, sameScene } from "./state.js";
import { makeStatus } from "./status.js";

const SHARE = 0.1; // of the splats, which the page begins with
const LIKED = ".sog"; // the format that it begins with, where it can be written
const PAUSE = 40; // milliseconds between two asks at least
const KEPT = 200; // numbers back that an ask is remembered

const connection = connect();
const status = makeStatus(stop);
const data = document.body.dataset;

function stop() {
  if (status.cancellable) connection.post("cancel", {}).catch((error) => status.complain(error.message));
}

let begun = null;
connection.on("scene", (scene) => {
  if (begun) begun.again();
  else begun = begin(scene);
});
connection.on("progress", (event) => status.work(event));
connection.on("connected", () => {
  if (data.lost) status.complain("");
  delete data.lost;
});
connection.on("lost", ({ final }) => {
  if (data.ended) return;
  data.lost = "true";
  status.complain(
    final
      ? "The studio has ended; start the command again."
      : "The studio does not answer; trying again …",
  );
});
connection.on("bye", ({ reason }) => {
  data.ended = "true";
  status.complain(reason || "The studio has ended.");
});

function begin(scene) {
  const formats = scene.formats;
  const state = makeState({
    wish: { splats: Math.max(1, Math.round(SHARE * (scene.available ?? scene.splats))) },
    format: formats.includes(LIKED) ? LIKED : formats[0],
    preset: "default",
    sh_degree: null,
    filters: NONE,
    render_mode: null,
    up: null,
    levels: null,
    ...scene.first,
  });
  const curve = makeCurve();
  const picture = makePicture(scene, connection.model, status.complain);
  const sliders = makeSliders(scene, state, curve, status.complain);
  const plot = makePlot(curve, sliders.lowest, (splats) => state.set({ wish: { splats } }));
  const method = makeMethod(scene, state);
  const failed = (error) => status.complain(error.message);

  const facts = [numbers.splats(scene.splats), numbers.size(scene.file_bytes)];
  byId("scene-facts").textContent = facts.join(" · ");
  const shown = scene.model.note ? [...facts, scene.model.note] : facts;
  picture.bind();
  picture.base(scene.model, scene.name, shown).catch(failed);

  // Previews of filters.
  let previewed = 0;
  const inPage = (corner) =>
    corner && corner.map((value, axis) => (value - scene.page.centre[axis]) * scene.page.scale);
  const filters = makeFilters(scene, state, {
    ask(chosen) {
      const { number, answer } = connection.start("filter", {
        choice: { ...state.choice, filters: chosen },
      });
      previewed = number;
      answer.catch((error) => previewed === number && filters.refused(error.message));
    },
    draw: (low, high) => picture.box(inPage(low), inPage(high)),
    restore() {
      previewed = 0;
      picture.back().catch(failed);
    },
    complain: status.complain,
  });
  connection.on("filtered", async (event) => {
    if (event.preview) {
      if (event.number !== previewed) return;
      rest();
      await picture
        .instead(event.model, scene.name, ["magenta goes", `${numbers.splats(event.left)} stay`])
        .catch(failed);
      if (event.number === previewed) filters.preview(event);
    } else if (event.number >= since) {
      previewed = 0;
      filters.taken(event);
      const left =
        event.left === scene.splats
          ? shown
          : [`${numbers.splats(event.left)} of ${numbers.count(scene.splats)}`];
      picture.base(event.model, scene.name, left).catch(failed);
    }
  });

  // Asks: one at a time is sent, and of those that come meanwhile the last.
  let latest = 0;
  let since = 0; // the first with the filters and the render mode as they are: the scene comes once for all
  let waiting = false;
  let asked = null;
  const asks = new Map(); // choices by number
  async function ask() {
    if (waiting) return;
    waiting = true;
    while (!same(asked, state.choice)) {
      if (asked && !sameGround(asked, state.choice)) curve.clear();
      else if (asked && asked.format !== state.choice.format) curve.forgetBytes();
      const other = !asked || !sameScene(asked, state.choice);
      asked = state.choice;
      const { number, answer } = connection.start("ask", { choice: asked });
      latest = number;
      asks.set(number, asked);
      asks.delete(number - KEPT);
      if (other) since = number;
      settle("coarse", number);
      status.complain("");
      sliders.show(null);
      plot.render();
      badge("asked");
      try {
        const { command } = await answer;
        byId("command").textContent = command ?? "";
      } catch (error) {
        fail(number, error.message);
      }
      await new Promise((done) => setTimeout(done, PAUSE));
    }
    waiting = false;
  }

  function settle(name, number = latest) {
    data.number = String(number);
    if (data.state === "saving") data.after = name;
    else data.state = data.state === "opening" && name === "coarse" ? "opening" : name;
  }

  const rest = () => status.say(data.state === "measured" ? "Ready" : "");

  function fail(number, message) {
    if (number !== null && number !== latest) return;
    status.complain(message);
    status.say("");
    badge("");
    settle("failed");
  }

  function badge(how) {
    const words = { asked: "…", draft: "estimated", measured: "measured" };
    byId("how").textContent = words[how] ?? "";
    byId("how").dataset.how = how;
  }

  let seen = 0; // the number of the model that is seen
  const shareOf = ({ splats }) => numbers.percent(splats / scene.splats);
  function show(event, quality) {
    seen = event.number;
    const first = `${numbers.splats(event.splats)} (${shareOf(event)})`;
    return picture.result(event.model, [first, numbers.size(event.bytes), ...quality]);
  }

  // A slider moves faster than it is answered: what comes late is seen, and changes nothing else.
  function passing(event) {
    const choice = asks.get(event.number);
    if (!choice || event.number <= seen || !sameGround(choice, state.choice)) return;
    show(event, []).catch(failed);
  }

  async function answered(event, kind) {
    if (event.number !== latest) {
      if (kind === "coarse") passing(event);
      return;
    }
    const { splats, bytes, psnr } = event;
    sliders.limit(event);
    curve.put({ splats, bytes, psnr, kind });
    sliders.show({ splats, bytes, psnr });
    plot.render();
    badge(event.type);
    const quality =
      psnr === null ? [] : [`${kind === "measured" ? "" : "about "}${numbers.decibels(psnr)} dB`];
    const words = [`${shareOf(event)} of ${numbers.count(scene.splats)}`];
    if (event.ssim) words.push(`SSIM ${event.ssim.toFixed(4)}`);
    if (event.seconds) words.push(`${numbers.duration(event.seconds)}`);
    byId("result").textContent = words.join(" · ");
    const there = await show(event, quality);
    if (!there || event.number !== latest) return;
    settle(kind === "measured" ? "measured" : "measuring");
    if (kind === "measured") rest();
  }
  connection.on("draft", (event) => answered(event, "coarse").catch(failed));
  connection.on("measured", (event) => answered(event, "measured").catch(failed));
  connection.on("point", (event) => {
    if (event.format !== state.choice.format) return;
    curve.add(event);
    sliders.render();
    plot.render();
  });
  connection.on("cancelled", ({ number, kind }) => {
    status.say(kind === "curve" ? "" : "Cancelled");
    if (number === latest) settle("coarse");
    if (number === previewed && number) filters.refused("Cancelled.");
  });
  connection.on("failed", ({ number, message, kind }) => {
    if (number && number === previewed) {
      rest();
      filters.refused(message);
    } else if (kind !== "save") fail(number, message);
  });

  // Saves.
  const openSave = makeSave(scene, state, connection, {
    onStart() {
      data.after = data.state;
      data.state = "saving";
    },
    onEnd() {
      data.state = data.after ?? "coarse";
      delete data.after;
      rest();
    },
  });
  byId("save-open").disabled = false;
  byId("save-open").addEventListener("click", openSave);
  byId("help-open").addEventListener("click", () => byId("help").showModal());
  copyButton(byId("copy"), () => byId("command"));

  // Undo.
  const [undo, redo] = [byId("undo"), byId("redo")];
  undo.addEventListener("click", state.undo);
  redo.addEventListener("click", state.redo);
  bindKeys({ state, picture, stop });

  state.listen((choice, before) => {
    undo.disabled = !state.canUndo;
    redo.disabled = !state.canRedo;
    method.render(choice);
    filters.follow(choice, before);
    if (choice.up !== before.up) picture.up(choice.up);
    if (!same(choice, before)) {
      sliders.show(null);
      ask();
    }
  });
  method.render(state.choice);
  sliders.render();
  ask();
  return {
    // After the connection was lost: the server may have forgotten the page.
    again() {
      asked = null;
      ask();
    },
  };
}
