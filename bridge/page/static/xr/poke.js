/**
 * Asking a gateway now whether it is still there, as the way to it may be another one: on entering XR, after sleep, in a new
 * network. One question at a time, and only the connection that did not answer is given up, never one made meanwhile.
 */

const ANSWER_MS = 400;
/** A connection that is being made for so long hangs. */
const JOIN_MS = 1500;

export class Poke {
  /** Which connection is asked now, by its number. */
  #asked = null;

  constructor(headset, { answerMs = ANSWER_MS, joinMs = JOIN_MS } = {}) {
    this.headset = headset;
    this.answerMs = answerMs;
    this.joinMs = joinMs;
  }

  async ask() {
    const { headset } = this;
    const { joins } = headset;
    if (this.#asked === joins) return;
    this.#asked = joins;
    const silent = headset.connected ? await this.#isSilent() : await this.#hangs();
    if (silent && headset.joins === joins) headset.drop();
    if (this.#asked === joins) this.#asked = null;
  }

  async #isSilent() {
    try {
      await this.headset.online({ timeoutMs: this.answerMs });
      return false;
    } catch (error) {
      return error.kind === "timeout";
    }
  }

  async #hangs() {
    await new Promise((resolve) => setTimeout(resolve, this.joinMs));
    return !this.headset.connected;
  }
}
