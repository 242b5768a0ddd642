/** The two workers, and what goes to them and comes from them. Events: `presence`, `access`, `value`, `state`, `stop`, `event`, `link`. */

/** Where the page at / writes down a stop for the page that comes after it in the same tab. */
const KEPT = "macs.stop";

export class Links extends EventTarget {
  #pictures = new Map();

  constructor(me) {
    super();
    const scheme = location.protocol === "https:" ? "wss:" : "ws:";
    const url = `${scheme}//${location.host}/macs`;
    const { port1, port2 } = new MessageChannel();
    this.commands = new Worker(new URL("./command-worker.js", import.meta.url), { type: "module" });
    this.sight = new Worker(new URL("./sight-worker.js", import.meta.url), { type: "module" });
    /** key → what is known of a topic that is received. */
    this.rates = new Map();
    this.sightUp = { connected: false, id: 0, badMessages: 0 };
    /** How long the last pictures took until they were shown: since the socket, and since their stamp by whose clock it is, ms. */
    this.pictureMs = [];
    for (const [name, worker] of [["commands", this.commands], ["pictures", this.sight]]) {
      const text = `the worker of ${name} failed`;
      worker.onerror = ({ message }) => this.dispatchEvent(new CustomEvent("event", { detail: { text: `${text}: ${message}` } }));
    }
    this.commands.onmessage = ({ data }) => this.#take(data);
    this.sight.onmessage = ({ data }) => this.#see(data);
    this.commands.postMessage({ op: "begin", url, me, kept: readKept(), sight: port1 }, [port1]);
    this.sight.postMessage({ op: "begin", url, commands: port2 }, [port2]);
  }

  /** What hands do in this frame. */
  input(sample, poses) {
    this.commands.postMessage({ op: "input", at: performance.timeOrigin + performance.now(), sample, poses });
  }

  aim(target) {
    this.commands.postMessage({ op: "aim", target });
  }

  /** By which pictures driving is guarded: until they are told of, there are none. */
  guard(keys) {
    this.commands.postMessage({ op: "guard", keys });
  }

  settings(values) {
    this.commands.postMessage({ op: "settings", values });
    this.sight.postMessage({ op: "points", most: values.points });
  }

  away(why) {
    this.commands.postMessage({ op: "away", why });
  }

  control(request) {
    this.commands.postMessage({ op: "control", request });
  }

  stop() {
    this.commands.postMessage({ op: "stop" });
  }

  release() {
    this.commands.postMessage({ op: "release" });
  }

  watch(wishes) {
    this.sight.postMessage({ op: "watch", wishes });
  }

  /** Ask on both sockets whether there is still a gateway. */
  poke() {
    this.commands.postMessage({ op: "poke" });
    this.sight.postMessage({ op: "poke" });
  }

  /** Give each panel its newest picture, and ask for the next one. */
  showPictures(room, wishes) {
    for (const [key, { bitmap, at, stamp }] of this.#pictures) {
      const wish = wishes.find((each) => each.key === key);
      const screen = wish && room.screens.get(wish.panel);
      if (screen) screen.show(bitmap, wish.eye);
      else bitmap.close();
      this.sight.postMessage({ op: "shown", key });
      const now = performance.timeOrigin + performance.now();
      this.pictureMs.push({ key, sinceSocket: now - at, sinceStamp: now - stamp });
      if (this.pictureMs.length > 600) this.pictureMs.splice(0, 300);
    }
    this.#pictures.clear();
  }

  #take(message) {
    if (message.op === "stop") writeKept(message);
    this.dispatchEvent(new CustomEvent(message.op, { detail: message }));
  }

  #see(message) {
    if (message.op === "picture") {
      this.#pictures.get(message.key)?.bitmap.close();
      this.#pictures.set(message.key, message);
    } else if (message.op === "rates") {
      this.sightUp = message;
      this.rates = new Map(message.topics.map((topic) => [topic.key, { ...topic, at: performance.now() }]));
    } else {
      this.dispatchEvent(new CustomEvent(message.op, { detail: message }));
    }
  }
}

function readKept() {
  try {
    const kept = JSON.parse(sessionStorage.getItem(KEPT));
    return Array.isArray(kept?.wanted) && Array.isArray(kept.known) ? { ...kept, all: kept.all === true } : null;
  } catch {
    return null;
  }
}

function writeKept({ state, kept }) {
  try {
    if (state === "free" && !kept.all) sessionStorage.removeItem(KEPT);
    else sessionStorage.setItem(KEPT, JSON.stringify(kept));
  } catch {
    // a browser that keeps nothing
  }
}
