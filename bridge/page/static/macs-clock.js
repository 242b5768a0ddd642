/**
 * Commands that tell their time, so that a robot never carries out an old one (docs/webxr.md, Command age).
 *
 *     const clock = new CommandClock(headset);
 *     clock.mean([1]);                          // robots that are to be commanded are asked whether they want to know
 *     drive.publish(cdr, { robots: [1], madeAt: performance.now() });
 *
 * A client's clock is a name and a count of 0.1 ms; a robot finds out by questions, which are answered at once, how it runs
 * beside its own. Robots that know nothing of it are commanded as ever. `Ticks` is pure.
 */

import { ROS, json, metadata, object } from "./macs-wire.js";

const MANAGER = "CommandClock";
const TICKS_PER_MS = 10;
/** After so many another clock begins. */
export const MOST_TICKS = 900_000_000;
/** So often a hello is said until it is answered and known, and then. */
const HELLO_MS = 1000;
const AGAIN_MS = 20000;
const ROBOTS = 64;

/** One clock, and what robots said of it. Times are in ms of whatever clock the caller has. */
export class Ticks {
  #begunAt = 0;

  constructor(name, now) {
    this.begin(name, now);
  }

  begin(name, now) {
    this.name = name;
    this.#begunAt = now;
  }

  /** Whether it has counted for so long that another one has to begin. */
  isSpent(now) {
    return this.at(now) >= MOST_TICKS;
  }

  /** Its count at a time; at least 1. */
  at(ms) {
    return Math.max(1, Math.floor((ms - this.#begunAt) * TICKS_PER_MS) + 1);
  }

  /** The number of a command that was made at `ms`, for a topic whose last one was `last`: always a greater one. */
  next(last, ms) {
    return Math.max(last + 1, this.at(ms));
  }

  /** What is said to a question; null where it is about another clock, or asks nothing. */
  answer({ clock, question }, ms) {
    if (clock !== this.name || !Number.isSafeInteger(question) || question === 0) return null;
    return { clock, question, at: this.at(ms) };
  }
}

/** A name that no other clock has: 16 of 0-9 and a-z. */
export function clockName(random = (count) => crypto.getRandomValues(new Uint8Array(count))) {
  return Array.from(random(16), (byte) => (byte % 36).toString(36)).join("");
}

export class CommandClock extends EventTarget {
  #robots = new Map();
  #timer = null;

  /** One per headset: its publishers use it from then on. */
  constructor(headset, { now = () => performance.now() } = {}) {
    super();
    this.headset = headset;
    this.now = now;
    this.ticks = new Ticks(clockName(), now());
    headset.clock = this;
    headset.addEventListener("message", ({ detail }) => this.#take(detail));
    headset.addEventListener("link", ({ detail }) => {
      if (!detail.up) return;
      for (const each of this.#robots.values()) each.saidAt = -Infinity;
      this.#say();
    });
    headset.addEventListener("refused", ({ detail: { robot, kind } }) => {
      const told = this.#robots.get(robot);
      if (kind === "no_clock" && told) this.#unknown(told);
    });
  }

  /** These robots are to be commanded, and no others. */
  mean(robots) {
    const meant = robots.slice(0, ROBOTS);
    for (const robot of this.#robots.keys()) if (!meant.includes(robot)) this.#robots.delete(robot);
    for (const robot of meant) {
      if (!this.#robots.has(robot)) this.#robots.set(robot, { saidAt: -Infinity, known: false, asked: false, maxAgeS: null });
    }
    this.#say();
  }

  /** {known, asked, maxAgeS} of a robot; null where it is not meant. Not asked: it knows nothing of clocks. */
  of(robot) {
    return this.#robots.get(robot) ?? null;
  }

  /** Whether commands to this robot tell their time: it has asked. */
  tells(robot) {
    return this.#robots.get(robot)?.asked ?? false;
  }

  close() {
    clearTimeout(this.#timer);
    this.#robots.clear();
  }

  #say() {
    clearTimeout(this.#timer);
    const now = this.now();
    if (this.ticks.isSpent(now)) this.#beginAnew(now);
    for (const [robot, each] of this.#robots) {
      if (now - each.saidAt < (each.known ? AGAIN_MS : HELLO_MS) - 1) continue;
      if (this.#send(robot, { clock: this.ticks.name })) each.saidAt = now;
    }
    if (this.#robots.size) this.#timer = setTimeout(() => this.#say(), HELLO_MS);
  }

  #beginAnew(now) {
    this.ticks.begin(clockName(), now);
    for (const each of this.#robots.values()) this.#unknown(each);
    for (const node of this.headset.nodes) node.lastTicks = 0;
  }

  #unknown(each) {
    each.known = false;
    each.saidAt = -Infinity;
  }

  #take(message) {
    if (message.manager !== MANAGER || message.senderType !== ROS) return;
    const each = this.#robots.get(message.senderId);
    if (each === undefined) return;
    const said = object(message.data);
    if (said.clock !== this.ticks.name) return;
    const answer = this.ticks.answer(said, this.now());
    if (answer !== null) this.#send(message.senderId, answer);
    const before = each.known;
    each.asked = true;
    each.known = said.known === true;
    each.maxAgeS = typeof said.maxAgeS === "number" ? said.maxAgeS : each.maxAgeS;
    if (each.known !== before) this.dispatchEvent(new CustomEvent("known", { detail: { robot: message.senderId, ...each } }));
  }

  #send(robot, said) {
    const meta = metadata(this.headset.id, { manager: MANAGER });
    return this.headset.sendNow(() => [{ to: ROS, ids: [robot], meta, data: json(said) }]);
  }
}
