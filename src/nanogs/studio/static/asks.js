// Sends choices to the server, one at a time; of those made meanwhile, only the last is sent.

import { same, sameScene } from "./state.js";

const PAUSE = 40; // least milliseconds between two requests
const KEPT = 200; // number of latest requests whose choices are kept

export function makeAsks(connection, state, { onSend, onCommand, onRefuse }) {
  const choices = new Map(); // by request number
  let asked = null;
  let latest = 0;
  let since = 0; // first request with the present filters and render mode
  let waiting = false;

  async function send() {
    if (waiting) return;
    waiting = true;
    while (!same(asked, state.choice)) {
      const before = asked;
      const last = choices.get(latest); // also after `again`
      asked = state.choice;
      const { number, answer } = connection.start("ask", { choice: asked });
      latest = number;
      choices.set(number, asked);
      choices.delete(number - KEPT);
      if (!last || !sameScene(last, asked)) since = number;
      onSend(asked, before);
      await answer.then(onCommand, (error) => onRefuse(number, error.message));
      await new Promise((done) => setTimeout(done, PAUSE));
    }
    waiting = false;
  }

  return {
    get latest() {
      return latest;
    },
    get since() {
      return since;
    },
    choiceOf: (number) => choices.get(number),
    send,
    // Sends the choice again, because the server may have forgotten the page.
    again() {
      asked = null;
      send();
    },
  };
}
