/** What topics said last, with how long ago: a value that nobody tells any more is not shown as if it were so now. Pure. */

const NEW_MS = 3000;

export class Aged {
  #said = new Map();

  /** A topic has said this, at `now` in ms. */
  note(topic, value, now) {
    this.#said.set(topic, { value, at: now });
  }

  /** Only these topics are still shown. */
  keep(topics) {
    for (const topic of this.#said.keys()) if (!topics.includes(topic)) this.#said.delete(topic);
  }

  clear() {
    this.#said.clear();
  }

  /** [{topic, value, age}]: `age` is words, empty while it is new. */
  all(now) {
    return [...this.#said].map(([topic, { value, at }]) => ({ topic, value, age: ageOf(now - at) }));
  }
}

function ageOf(ms) {
  if (ms < NEW_MS) return "";
  return ms < 120_000 ? `${Math.floor(ms / 1000)} s old` : `${Math.floor(ms / 60_000)} min old`;
}
