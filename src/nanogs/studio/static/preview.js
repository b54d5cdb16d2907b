// Preview of filters: the server computes which splats they would remove, the left side shows them.

import { makeFilters } from "./filters.js";
import * as numbers from "./numbers.js";

export function makePreview(scene, state, facts, { connection, asks, picture, status, rest }) {
  let asked = 0; // request number of the preview that is awaited or shown; 0 for none
  const failed = (error) => status.complain(error.message);
  const { centre, scale } = scene.page;
  const inPage = (corner) => corner && corner.map((value, axis) => (value - centre[axis]) * scale);

  const filters = makeFilters(scene, state, {
    ask(chosen) {
      const choice = { ...state.choice, filters: chosen };
      const { number, answer } = connection.start("filter", { choice });
      asked = number;
      answer.catch((error) => asked === number && filters.refused(error.message));
    },
    draw: (low, high) => picture.box(inPage(low), inPage(high)),
    restore() {
      asked = 0;
      picture.back().catch(failed);
    },
    complain: status.complain,
  });

  async function look(event) {
    if (event.number !== asked) return;
    rest();
    const words = ["magenta is removed", `${numbers.splats(event.left)} left`];
    await picture.instead(event.model, scene.name, words).catch(failed);
    if (event.number === asked) filters.preview(event);
  }

  function taken(event) {
    if (event.number < asks.since) return;
    asked = 0;
    filters.taken(event);
    const part = `${numbers.splats(event.left)} of ${numbers.count(scene.splats)}`;
    const words = event.left === scene.splats ? facts : [part];
    picture.base(event.model, scene.name, words).catch(failed);
  }

  return {
    follow: filters.follow,
    // Called when a face of the box is dragged in the picture; `value` is in units of the page.
    drag: (axis, end, value) => filters.drag(axis, end, value / scale + centre[axis]),
    // Called when the scene was opened again: the left side shows all of it.
    reopened(model) {
      filters.reopened();
      picture.base(model, scene.name, facts).catch(failed);
    },
    filtered: (event) => (event.preview ? look(event) : taken(event)),
    // Handles a request that has failed; returns whether it was the awaited preview.
    refused(number, message) {
      if (!number || number !== asked) return false;
      filters.refused(message);
      return true;
    },
  };
}
