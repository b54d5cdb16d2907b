// What the server finds for the latest choice, as the page shows it: model, numbers, plot.

import { byId } from "./dom.js";
import * as numbers from "./numbers.js";
import { isMeasured, settle } from "./phase.js";
import { sameGround } from "./state.js";

const WORDS = { asked: "…", draft: "estimated", made: "estimated", measured: "measured" };

export function makeAnswers(scene, state, { asks, curve, sliders, plot, picture, status, tellSeen }) {
  let seen = 0; // the number of the model that is seen
  let newest = null; // the latest event for the latest choice
  let shown = scene.model.id; // what is in the picture as soon as that is drawn, the scene alone at first
  let told = null; // the latest of these that the server knows of
  const failed = (error) => status.complain(error.message);
  const shareOf = ({ splats }) => numbers.percent(splats / scene.splats);
  const rest = () => status.say(isMeasured() ? "Ready" : "");

  function badge(how) {
    byId("how").textContent = WORDS[how] ?? "";
    byId("how").dataset.how = how;
  }

  function show(event, quality) {
    seen = event.number;
    const first = `${numbers.splats(event.splats)} (${shareOf(event)})`;
    const facts = [first, numbers.size(event.bytes), ...quality];
    const drawn = event.model.splats; // fewer where a draft has to be quick, or the browser draws no more
    if (drawn < event.splats) facts.push(`drawn with ${numbers.count(drawn)}`);
    return picture.result(event.model, facts);
  }

  // A slider moves faster than it is answered: what comes late is seen, and changes nothing else.
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
    // A new choice is on its way; `before` is the one that was answered last, if there is one.
    await(choice, before) {
      if (before && !sameGround(before, choice)) curve.clear();
      else if (before && before.format !== choice.format) curve.forgetBytes();
      settle("coarse", asks.latest);
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
      status.say(kind === "curve" ? "" : "Cancelled");
    },
    // The server computes once the page has drawn, and sends what this page draws at once.
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
