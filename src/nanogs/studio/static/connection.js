// Requests to the server and events from it. URLs are relative: the page's own URL has the token.

const PAGE = crypto.randomUUID();

export function connect() {
  const listeners = new Map();
  let number = 0;
  const emit = (type, event) => {
    for (const listener of listeners.get(type) ?? []) listener(event);
  };
  const source = new EventSource(`events?page=${PAGE}`);
  source.onmessage = (message) => {
    const event = JSON.parse(message.data);
    emit(event.type, event);
  };
  source.onopen = () => emit("connected", {});
  source.onerror = () => emit("lost", { final: source.readyState === EventSource.CLOSED });

  async function post(path, body, more = {}) {
    let response;
    try {
      response = await fetch(path, {
        method: "POST",
        headers: { "Content-Type": "application/json" },
        body: JSON.stringify({ page: PAGE, ...body }),
        ...more,
      });
    } catch {
      throw new Refused("The studio does not answer; check that its command is still running.", 0);
    }
    if (response.status === 204) return {};
    const answer = await response.json().catch(() => ({}));
    if (!response.ok) {
      throw new Refused(
        answer.message ?? `The studio refuses this (${response.status}).`,
        response.status,
      );
    }
    return answer;
  }

  // Or the requests of a page that is reloaded would keep the next one waiting for ten seconds.
  addEventListener("pagehide", (event) => {
    if (!event.persisted) post("leave", {}, { keepalive: true }).catch(() => {});
  });

  return {
    on(type, listener) {
      listeners.set(type, [...(listeners.get(type) ?? []), listener]);
    },
    // Starts a job. Its events have the number that is returned, without waiting for the response.
    start(path, body) {
      number += 1;
      return { number, answer: post(path, { number, ...body }) };
    },
    post,
    async files(folder) {
      const response = await fetch(`files?folder=${encodeURIComponent(folder)}`);
      const answer = await response.json().catch(() => ({}));
      if (!response.ok)
        throw new Refused(answer.message ?? "The folder cannot be read.", response.status);
      return answer;
    },
    async model(id) {
      const response = await fetch(`models/${encodeURIComponent(id)}.spz`);
      if (response.status !== 200)
        throw new Refused("A model is no longer available; move a slider to make it again.", response.status);
      return new Uint8Array(await response.arrayBuffer());
    },
  };
}

// The server has refused a request; the message is for the user.
export class Refused extends Error {
  constructor(message, status) {
    super(message);
    this.status = status;
  }
}
