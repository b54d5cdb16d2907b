// The state of the page for styles and tests: `data-state` and `data-number` (of the request) of
// the body, and `data-seen`, the event type of the model in the picture.

const data = document.body.dataset;

export const isMeasured = () => data.state === "measured";

// Sets the state that a request has reached; during a save it takes effect when the save has ended.
export function settle(name, number, seen = "") {
  data.number = String(number);
  data.seen = seen;
  if (data.state === "saving") data.after = name;
  else data.state = data.state === "opening" && name === "coarse" ? "opening" : name;
}

export function beginSaving() {
  data.after = data.state;
  data.state = "saving";
}

export function endSaving() {
  data.state = data.after ?? "coarse";
  delete data.after;
}
