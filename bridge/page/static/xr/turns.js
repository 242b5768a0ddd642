/**
 * Which pictures a frame shows. Pure.
 *
 * A picture takes the main thread about a millisecond to hand to the graphics. Those of several cameras come together: of them half
 * the panels, rounded up, get theirs in one frame and the others in the next. Where frames are as seldom as pictures none waits.
 */

/** A frame that follows the one before within so many ms leaves time for the next one. */
export const QUICK_S = 0.02;

/** Of [key, panel] that wait, the one that has waited for longest first: the keys that are shown now. Both eyes of a panel go together. */
export function shownNow(waiting, frameS) {
  const panels = [...new Set(waiting.map(([, panel]) => panel))];
  const now = frameS > QUICK_S ? panels : panels.slice(0, Math.ceil(panels.length / 2));
  return waiting.filter(([, panel]) => now.includes(panel)).map(([key]) => key);
}
