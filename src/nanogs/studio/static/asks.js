// Choices on their way to the server: one at a time is sent, and of those that come meanwhile the last.

import { same, sameScene } from "./state.js";

const PAUSE = 40; // milliseconds between two asks at least
const KEPT = 200; // numbers back that an ask is remembered

export function makeAsks(connection, state, { onSend, onCommand, onRefuse }) {
  const choices = new Map(); // by number
  let asked = null;
  let latest = 0;
  let since = 0; // the first with the filters and the render mode as they are: the scene comes once for all
  let waiting = false;

  async function send() {
    if (waiting) return;
    waiting = true;
    while (!same(asked, state.choice)) {
      const before = asked;
      asked = state.choice;
      const { number, answer } = connection.start("ask", { choice: asked });
      latest = number;
      choices.set(number, asked);
      choices.delete(number - KEPT);
      if (!before || !sameScene(before, asked)) since = number;
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
    // The server may have forgotten the page: after the connection was lost.
    again() {
      asked = null;
      send();
    },
  };
}
