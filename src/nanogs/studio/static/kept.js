// Keeps the choice over a reload, in this tab and while the studio runs; undo steps are not kept.

const NAME = `choice of ${location.pathname}`; // the path has the token of this studio

export function keep(choice) {
  try {
    sessionStorage.setItem(NAME, JSON.stringify(choice));
  } catch {
    // Storage is switched off in this browser: the choice is lost on reload.
  }
}

export function kept() {
  try {
    return JSON.parse(sessionStorage.getItem(NAME));
  } catch {
    return null;
  }
}
