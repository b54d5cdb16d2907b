// The choice outlives a reload, in its tab and as long as the studio runs; steps to undo do not.

const NAME = `choice of ${location.pathname}`; // which has the token of the studio

export function keep(choice) {
  try {
    sessionStorage.setItem(NAME, JSON.stringify(choice));
  } catch {
    // The browser keeps nothing for pages: a reload begins anew.
  }
}

export function kept() {
  try {
    return JSON.parse(sessionStorage.getItem(NAME));
  } catch {
    return null;
  }
}
