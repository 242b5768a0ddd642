/** The two workers, and what goes to them and comes from them. Events: `presence`, `access`, `value`, `state`, `stop`, `event`, `link`. */

import { readKept, writeKept } from "../shared/kept-stop.js";
import { shownNow } from "./turns.js";

/** The worker of commands says so soon that it has heard of a press. */
const ECHO_MS = 200;
const NOTHING = { all: false, wanted: [], known: [] };
const ON_ITS_WAY = "the stop is on its way";
const UNHEARD = "THE STOP HAS NOT GONE OUT: what sends it does not answer. Stop the robot itself, and load this page anew";

/** A picture as bytes, for a texture: its room is given back when another one has taken its place. */
class Pixels {
  constructor({ data, width, height }, spare) {
    Object.assign(this, { data, width, height, spare });
  }

  close() {
    this.spare.push(this.data.buffer);
  }
}

export class Links extends EventTarget {
  #pictures = new Map();
  /** key → {at, stamp} of pictures that panels have, and of which it is not known that they were drawn. */
  #given = new Map();
  /** Room of pictures that are shown no more. */
  #spare = [];
  /** How many times the stop was pressed, and of how many of these the worker has heard. */
  #presses = 0;
  #heard = 0;
  #stop = null;
  #kept = readKept();

  /** `me` is what this token may, `guards` what is kept of the page before. */
  constructor(me, guards) {
    super();
    this.guards = guards;
    this.mayStop = me.may.includes("stop");
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
      worker.onerror = ({ message }) => {
        this.#tell("event", { text: `${text}: ${message}` });
        this.#doubt();
      };
    }
    this.commands.onmessage = ({ data }) => this.#take(data);
    this.sight.onmessage = ({ data }) => this.#see(data);
    this.commands.postMessage({ op: "begin", url, me, kept: this.#kept, sight: port1 }, [port1]);
    this.sight.postMessage({ op: "begin", url, commands: port2, least: guards.least }, [port2]);
  }

  /** What hands did in the frame that began at `at`. */
  input(sample, poses, at) {
    this.commands.postMessage({ op: "input", at: performance.timeOrigin + at, sample, poses });
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

  /** Written down and shown at once: a press is somebody's also while the worker of commands does not answer. */
  stop() {
    this.#presses += 1;
    this.commands.postMessage({ op: "stop", press: this.#presses });
    if (!this.mayStop) return;
    const { known } = this.#kept ?? NOTHING;
    this.#kept = { all: true, wanted: known, known };
    writeKept({ state: "waiting", kept: this.#kept });
    this.#tell("stop", { state: "waiting", text: ON_ITS_WAY });
    setTimeout(() => this.#doubt(), ECHO_MS);
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

  /** Give panels their newest pictures, as `shownNow` says, in a frame that is so long after the one before. */
  showPictures(room, wishes, frameS) {
    const panelOf = (key) => wishes.find((each) => each.key === key)?.panel;
    for (const key of shownNow([...this.#pictures.keys()].map((each) => [each, panelOf(each)]), frameS)) {
      const { image, at, stamp } = this.#pictures.get(key);
      this.#pictures.delete(key);
      this.#given.set(key, { at, stamp });
      const wish = wishes.find((each) => each.key === key);
      const screen = wish && room.screens.get(wish.panel);
      if (screen) screen.show(image, wish.eye);
      else image.close();
    }
  }

  /** The pictures that panels were given were drawn: ask for the next ones. */
  acknowledge() {
    for (const [key, { at, stamp }] of this.#given) {
      const buffers = this.#spare.splice(0);
      this.sight.postMessage({ op: "shown", key, buffers }, buffers);
      const now = performance.timeOrigin + performance.now();
      this.pictureMs.push({ key, sinceSocket: now - at, sinceStamp: now - stamp });
      if (this.pictureMs.length > 600) this.pictureMs.splice(0, 300);
    }
    this.#given.clear();
  }

  #take(message) {
    if (message.op === "stop") this.#stop = message;
    else if (message.op === "pressed") this.#heard = message.press;
    else return this.#tell(message.op, message);
    // what was said before it heard of a press is not of this press
    if (this.#heard !== this.#presses || !this.#stop) return;
    this.#kept = this.#stop.kept;
    writeKept(this.#stop);
    this.#tell("stop", this.#stop);
    this.#stop = null;
  }

  /** Whether the worker has heard of each press by now; else it is said. */
  #doubt() {
    if (this.#heard === this.#presses || !this.mayStop) return;
    this.#tell("stop", { state: "waiting", text: UNHEARD });
    this.#tell("event", { text: UNHEARD });
  }

  #tell(type, detail) {
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }

  #see(message) {
    if (message.op === "picture") {
      this.#pictures.get(message.key)?.image.close();
      const { at, stamp, bitmap } = message;
      this.#pictures.set(message.key, { at, stamp, image: bitmap ?? new Pixels(message, this.#spare) });
    } else if (message.op === "rates") {
      this.sightUp = message;
      this.guards.noteLeast(message.least);
      this.rates = new Map(message.topics.map((topic) => [topic.key, { ...topic, at: performance.now() }]));
    } else {
      this.#tell(message.op, message);
    }
  }
}
