// Shows the server's answers to the latest choice: model, numbers, plot.

import { byId } from "./dom.js";
import * as numbers from "./numbers.js";
import { isMeasured, settle } from "./phase.js";
import { sameGround } from "./state.js";

const WORDS = { asked: "…", draft: "estimated", made: "estimated", measured: "measured" };

export function makeAnswers(scene, state, { asks, curve, sliders, plot, picture, status, tellSeen }) {
  let seen = 0; // number of the request whose model is shown
  let newest = null; // the latest event for the latest choice
  let shown = scene.model.id; // ID of the model given to the picture last, at first the scene
  let told = null; // ID of the model that was last reported to the server as drawn
  const failed = (error) => status.complain(error.message);
  const shareOf = ({ splats }) => numbers.percent(splats / scene.splats);
  let ended = ""; // what is said of the latest request if it ended without a result
  const rest = () => status.say(isMeasured() ? "Ready" : ended);

  function badge(how) {
    byId("how").textContent = WORDS[how] ?? "";
    byId("how").dataset.how = how;
  }

  function show(event, quality) {
    seen = event.number;
    const first = `${numbers.splats(event.splats)} (${shareOf(event)})`;
    const facts = [first, numbers.size(event.bytes), ...quality];
    const drawn = event.model.splats; // fewer for a quick draft, or above the browser's limit
    if (drawn < event.splats) facts.push(`drawn with ${numbers.count(drawn)}`);
    return picture.result(event.model, facts);
  }

  // A slider moves faster than requests are answered: of a late answer only the model is drawn.
  function passing(event) {
    const choice = asks.choiceOf(event.number);
    if (!choice || event.number <= seen || !sameGround(choice, state.choice)) return;
    show(event, []).catch(failed);
  }

  function tell(event, kind) {
    const { splats, bytes, psnr } = event;
    sliders.limit(event);
    curve.put({ splats, bytes, psnr, kind });
    sliders.show({ splats, bytes, psnr });
    plot.render();
    badge(event.type);
    const words = [`${shareOf(event)} of ${numbers.count(scene.splats)}`];
    if (event.ssim) words.push(`SSIM ${event.ssim.toFixed(4)}`);
    if (event.seconds) words.push(`${numbers.duration(event.seconds)}`);
    byId("result").textContent = words.join(" · ");
  }

  async function take(event, kind) {
    if (event.number !== asks.latest) {
      if (kind === "coarse") passing(event);
      return;
    }
    newest = event;
    tell(event, kind);
    const about = kind === "measured" ? "" : "about ";
    const quality = event.psnr === null ? [] : [`${about}${numbers.decibels(event.psnr)} dB`];
    const there = await show(event, quality);
    if (!there || event !== newest || event.number !== asks.latest) return;
    settle(kind === "measured" ? "measured" : "measuring", event.number, event.type);
    shown = event.model.id;
    if (kind === "measured") rest();
  }

  return {
    rest,
    // Called when a new choice is sent; `before` is the choice sent before it, if there is one.
    await(choice, before) {
      if (before && !sameGround(before, choice)) curve.clear();
      else if (before && before.format !== choice.format) curve.forgetBytes();
      settle("coarse", asks.latest);
      ended = "";
      status.complain("");
      sliders.show(null);
      plot.render();
      badge("asked");
    },
    draft: (event) => take(event, "coarse").catch(failed),
    made: (event) => take(event, "coarse").catch(failed),
    measured: (event) => take(event, "measured").catch(failed),
    point(event) {
      if (event.format !== state.choice.format) return;
      curve.add(event);
      sliders.render();
      plot.render();
    },
    cancelled({ number, kind }) {
      if (number === asks.latest) settle("coarse", number);
      else if (asks.choiceOf(number)) return; // a later choice has replaced it
      if (kind === "ask") ended = "Cancelled";
      status.say(kind === "curve" ? "" : "Cancelled");
    },
    // Reports that the model is drawn: the server waits for this before it computes, and limits
    // drafts to the splats that the page draws at once.
    drawn(pace) {
      if (told === shown) return;
      told = shown;
      tellSeen({ model: shown, pace }).catch(failed);
    },
    fail(number, message) {
      if (number !== null && number !== asks.latest) return;
      status.complain(message);
      status.say("");
      badge("");
      settle("failed", asks.latest);
    },
  };
}
