/**
 * How old what is seen is. Pure: times are passed in, in ms.
 *
 * A picture is old when none has come for a while; when the same one comes again and again, as a camera driver that hangs
 * sends it; and when pictures come later after their stamp than the quickest ones lately did, as behind a network that has
 * filled up. Clocks are not believed: only how the difference between stamp and arrival changes counts.
 */

/** The quickest picture of so long ago is still the measure. */
export const WINDOW_MS = 30000;

export class Freshness {
  #stamp = null;
  #known = false;
  #arrivedAt = null;
  #late = 0;
  #least = [Infinity, Infinity];
  #turnedAt = null;

  /** `before`: how little later than their stamps pictures came lately, as `least` has it; null: nobody knows. */
  constructor(before = null) {
    if (before !== null) this.#least[1] = before;
  }

  /** How little later than their stamps pictures came lately, in ms of two clocks; null: none has come that has a stamp. */
  get least() {
    const least = Math.min(...this.#least);
    return least === Infinity ? null : least;
  }

  /**
   * A picture came. `stamp` is its own time, 0 where it says none. Whether it is another one than before: the first one is
   * none, for it may be the last one of a camera that hangs, said again.
   */
  note(stamp, now) {
    if (stamp && stamp === this.#stamp) return false;
    this.#known ||= !stamp || this.#stamp !== null;
    this.#stamp = stamp;
    this.#arrivedAt = now;
    this.#late = stamp ? this.#lateness(now - stamp, now) : 0;
    return this.#known;
  }

  /** How old the newest one is; null before there was another one than the first. */
  ageMs(now) {
    return this.#known ? now - this.#arrivedAt + this.#late : null;
  }

  #lateness(difference, now) {
    this.#turnedAt ??= now;
    if (now - this.#turnedAt > WINDOW_MS) {
      this.#least = [Infinity, this.#least[0]];
      this.#turnedAt = now;
    }
    this.#least[0] = Math.min(this.#least[0], difference);
    return difference - Math.min(...this.#least);
  }
}

/** Why nobody may drive by what he sees; empty when he may. `ages` are those of the pictures that are meant. */
export function lockout(ages, mostMs) {
  if (!ages.length || !(mostMs > 0)) return "";
  if (ages.includes(null)) return "no picture has come yet";
  const oldest = Math.max(...ages);
  return oldest > mostMs ? `the picture is ${(oldest / 1000).toFixed(1)} s old` : "";
}
