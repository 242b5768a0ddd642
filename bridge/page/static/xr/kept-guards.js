/**
 * What a page that is loaded again in its tab has to know of the one before: which picture driving each robot depends on, and
 * how late pictures came. Else it would take a robot whose camera has died for one without pictures, and pictures behind a
 * network that has filled up for new ones. Pure but for its store.
 */

const NAME = "macs.xr.guards";
const ROBOTS = 64;

export class KeptGuards {
  #store;
  #written = "";

  /** `store` is as sessionStorage, which is of one tab; null where there is none. */
  constructor(store) {
    this.#store = store;
    const { guards, least } = this.#read();
    /** robot → {topic, type}, or null where none is meant. */
    this.guards = new Map(guards.filter(isGuard));
    /** [[key, {ms, at}]], as the worker of pictures has it. */
    this.least = least.filter(isLeast).slice(-ROBOTS);
  }

  /** Driving this robot depends on this picture now; null: on none. */
  note(robot, guard) {
    this.guards.delete(robot);
    this.guards.set(robot, guard);
    for (const each of this.guards.keys()) if (this.guards.size > ROBOTS) this.guards.delete(each);
    this.#write();
  }

  noteLeast(least) {
    this.least = least;
    this.#write();
  }

  #read() {
    try {
      const { guards = [], least = [] } = JSON.parse(this.#store.getItem(NAME)) ?? {};
      return Array.isArray(guards) && Array.isArray(least) ? { guards, least } : { guards: [], least: [] };
    } catch {
      return { guards: [], least: [] };
    }
  }

  #write() {
    const text = JSON.stringify({ guards: [...this.guards].filter(([, guard]) => guard), least: this.least });
    if (text === this.#written) return;
    this.#written = text;
    try {
      this.#store.setItem(NAME, text);
    } catch {
      // a browser that keeps nothing
    }
  }
}

const isGuard = (each) => Number.isSafeInteger(each?.[0]) && [each[1]?.topic, each[1]?.type].every((name) => typeof name === "string");

const isLeast = (each) => typeof each?.[0] === "string" && [each[1]?.ms, each[1]?.at].every(Number.isFinite);
