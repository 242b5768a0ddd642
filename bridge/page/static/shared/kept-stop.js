/** A stop that was pressed, for the page that comes after this one in the same tab. */

const KEPT = "macs.stop";

/** What the page before had: {all, wanted, known}; null: nothing. */
export function readKept() {
  try {
    const kept = JSON.parse(sessionStorage.getItem(KEPT));
    return Array.isArray(kept?.wanted) && Array.isArray(kept.known) ? { ...kept, all: kept.all === true } : null;
  } catch {
    return null;
  }
}

/** Write it down for the page that comes next, unless nothing is stopped. */
export function writeKept({ state, kept }) {
  try {
    if (state === "free" && !kept.all) sessionStorage.removeItem(KEPT);
    else sessionStorage.setItem(KEPT, JSON.stringify(kept));
  } catch {
    // a browser that keeps nothing
  }
}
