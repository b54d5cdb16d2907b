// How far the page is, where styles and tests find it: `data-state` and `data-number` of the body, and
// `data-seen`, the kind of the model that is in the picture.

const data = document.body.dataset;

export const isMeasured = () => data.state === "measured";

// What has become of the request of a number. While a save runs, that waits until it has ended.
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
