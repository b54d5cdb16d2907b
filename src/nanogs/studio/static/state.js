// The present choice, with undo and redo. Choices are immutable: a change makes a new one.

const MOST = 200; // most steps that can be undone

export function makeState(first) {
  const past = [];
  const future = [];
  const listeners = [];
  let present = first;
  let lasting = first; // the choice that undo returns to, without the positions a slider passes

  function become(choice) {
    const before = present;
    present = choice;
    for (const listener of listeners) listener(present, before);
  }

  return {
    get choice() {
      return present;
    },
    get canUndo() {
      return past.length > 0 || !same(present, lasting);
    },
    get canRedo() {
      return future.length > 0;
    },
    listen(listener) {
      listeners.push(listener);
    },
    // Passing changes are shown and sent, and make one undo step with the lasting one that follows.
    set(change, passing = false) {
      const choice = { ...present, ...change };
      if (!passing && !same(choice, lasting)) {
        past.push(lasting);
        if (past.length > MOST) past.shift();
        future.length = 0;
        lasting = choice;
      }
      if (!same(choice, present)) become(choice);
      else if (!passing) for (const listener of listeners) listener(present, present);
    },
    undo() {
      if (same(present, lasting)) {
        if (!past.length) return;
        future.push(lasting);
        lasting = past.pop();
      }
      become(lasting);
    },
    redo() {
      if (!future.length) return;
      past.push(lasting);
      lasting = future.pop();
      become(lasting);
    },
  };
}

export const same = (one, other) => JSON.stringify(one) === JSON.stringify(other);

// Returns whether two choices have the same curve of PSNR over splats.
export function sameGround(one, other) {
  const ground = ({ filters, preset, sh_degree, render_mode, up }) => [
    [filters.box, filters.min_opacity, filters.floaters],
    preset,
    sh_degree,
    render_mode,
    up,
  ];
  return same(ground(one), ground(other));
}

// Returns whether two choices have the same scene on the left: the same filters and render mode.
export const sameScene = (one, other) =>
  same(one.filters, other.filters) && one.render_mode === other.render_mode;
