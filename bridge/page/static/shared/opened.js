/**
 * What may drive: only what was seen open since it is there. Pure.
 *
 * A controller that sleeps, a hand out of sight, a headset that is put on: what comes back with its grip held was not taken
 * hold of in sight of this robot.
 */

export class Opened {
  #open = new Set();

  /**
   * [{source, …}] of those that hold on, of what was read in this frame: [{source, kind, drive, open}]. `drive` is null while it
   * does not drive, `open` whether it is let go of.
   */
  held(read) {
    const named = read.map((each) => ({ ...each, name: `${each.kind} ${each.source}` }));
    const there = new Set(named.map(({ name }) => name));
    for (const name of this.#open) if (!there.has(name)) this.#open.delete(name);
    for (const { name, open } of named) if (open) this.#open.add(name);
    return named.filter(({ name, drive }) => drive && this.#open.has(name)).map(({ source, drive }) => ({ source, ...drive }));
  }

  /** Of nothing it is known. */
  clear() {
    this.#open.clear();
  }
}
