/**
 * The clutch: whether commands go out now, and which. Pure: the time is passed in, in ms.
 *
 * Commands go only while somebody holds on: a stick's grip, a pinch, a shoulder button, a key, the pointer. Whatever ends
 * it (let go, a bar, another source, silence of who reads the controllers) ends with a zero, and then it has to be taken
 * anew: what is still held down counts only after it was let go of.
 */

/** Who reads the controllers and said nothing for so long does not know what a hand does now. */
export const STILL_MS = 200;

const limited = (value) => (Number.isFinite(value) ? Math.max(-1, Math.min(1, value)) : 0);

export class Hold {
  #heldAt = 0;
  /** Whether something is held that does not count before it was let go of. */
  #stale = true;

  /** `still` is why it ends when who reads the controllers says nothing more. */
  constructor({ stillMs = STILL_MS, still = "the headset stood still" } = {}) {
    this.stillMs = stillMs;
    this.still = still;
    /** What holds on now: "left", "right", "keys" …; null: nobody. */
    this.source = null;
    /** Forward and to the left, each from -1 to 1. */
    this.forward = 0;
    this.turn = 0;
    this.barred = "nothing is known yet";
    /** Why it was let go of last. */
    this.why = "";
    /** Zeros that are due: one for each time that it was let go of. */
    this.zeros = 0;
  }

  get held() {
    return this.source !== null;
  }

  /** What hands do now: {source, forward, turn} while one holds on, else null. Whether it has just begun to drive. */
  input(sample, now) {
    if (this.held && now - this.#heldAt > this.stillMs) this.release(this.still);
    this.#heldAt = now;
    if (sample === null) {
      if (this.held) this.release("let go");
      this.#stale = false;
      return false;
    }
    if (this.held && sample.source !== this.source) this.release("something else was taken hold of");
    if (!this.held && (this.#stale || this.barred)) {
      this.#stale = true;
      return false;
    }
    const began = !this.held;
    this.source = sample.source;
    this.forward = limited(sample.forward);
    this.turn = limited(sample.turn);
    return began;
  }

  /** Why nobody may drive now; empty when he may. */
  bar(why) {
    this.barred = why;
    if (why && this.held) this.release(why);
  }

  /** Let go, whatever hands do: it has to be taken anew. */
  release(why) {
    this.#stale = true;
    if (!this.held) return;
    this.source = null;
    this.forward = this.turn = 0;
    this.why = why;
    this.zeros += 1;
  }

  /** What is due now: {forward, turn} to send, or null. Ends a hold that nobody confirms. */
  due(now) {
    if (this.held && now - this.#heldAt > this.stillMs) this.release(this.still);
    return this.held ? { forward: this.forward, turn: this.turn } : null;
  }
}
