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
/** After so many, too, once nothing was commanded for a while: nobody's driving ends by it. */
export const EARLY_TICKS = MOST_TICKS / 2;
export const IDLE_MS = 10_000;
/** So often a hello is said until it is answered and known, and then. */
const HELLO_MS = 1000;
const AGAIN_MS = 20000;
/** A robot asks for 60 s after the last command, and refuses for 5 s more what tells no time: for so long it is told. */
export const KEPT_MS = 66_000;
export const ROBOTS = 64;

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
  /** robot → {meant, group, usedAt, saidAt, known, asked, maxAgeS}; with a `group`, it is spoken to by that. */
  #robots = new Map();
  #groups = [];
  #usedAt = -Infinity;
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
      for (const each of this.#robots.values()) {
        each.saidAt = -Infinity;
        each.known &&= Boolean(detail.resumed); // another headset's clock is known to nobody
      }
      this.#say();
    });
    headset.addEventListener("refused", ({ detail: { robot, kind } }) => {
      const told = this.#robots.get(robot);
      if (kind === "no_clock" && told) this.#unknown(told);
    });
  }

  /**
   * These robots are to be commanded, and no others. Who may name groups only passes them, with their `members` as far as
   * these are known. Those that are meant no more are answered, and told the time, as long as they may ask.
   */
  mean(robots, groups = [], members = []) {
    const meant = new Map(robots.slice(0, ROBOTS).map((robot) => [robot, null]));
    this.#groups = groups.slice(0, ROBOTS);
    if (groups.length) for (const robot of members.slice(0, ROBOTS)) if (!meant.has(robot)) meant.set(robot, groups[0]);
    const now = this.now();
    for (const [robot, each] of this.#robots) {
      if (each.meant) each.usedAt = now;
      each.meant = meant.has(robot);
    }
    for (const [robot, group] of meant) Object.assign(this.#meet(robot, now), { meant: true, group });
    this.#say();
  }

  /** {known, asked, maxAgeS} of a robot that is or lately was meant; else null. Not asked: it knows nothing of clocks. */
  of(robot) {
    return this.#robots.get(robot) ?? null;
  }

  /** Whether commands to this robot tell their time: it has asked. */
  tells(robot) {
    return this.#robots.get(robot)?.asked ?? false;
  }

  /** The same of a group: one of its robots has asked, and would refuse what tells no time. */
  tellsGroup(group) {
    return [...this.#robots.values()].some((each) => each.group === group && each.asked);
  }

  /** A command that tells its time goes to these now. */
  told(robots, groups) {
    this.#usedAt = this.now();
    for (const [robot, each] of this.#robots) {
      if (robots.includes(robot) || groups.includes(each.group)) each.usedAt = this.#usedAt;
    }
  }

  close() {
    clearTimeout(this.#timer);
    this.#robots.clear();
    this.#groups = [];
  }

  #meet(robot, now) {
    if (!this.#robots.has(robot)) {
      const group = this.#groups[0] ?? null;
      const more = { saidAt: -Infinity, known: false, asked: false, maxAgeS: null };
      this.#robots.set(robot, { meant: false, group, usedAt: now, ...more });
      for (const [other, { meant }] of this.#robots) {
        if (this.#robots.size <= 2 * ROBOTS) break;
        if (!meant && other !== robot) this.#robots.delete(other);
      }
    }
    return this.#robots.get(robot);
  }

  #say() {
    clearTimeout(this.#timer);
    const now = this.now();
    const early = this.ticks.at(now) >= EARLY_TICKS && now - this.#usedAt >= IDLE_MS;
    if (early || this.ticks.isSpent(now)) this.#beginAnew(now);
    const said = new Set();
    for (const [robot, each] of this.#robots) {
      if (!each.meant && now - each.usedAt > KEPT_MS) this.#robots.delete(robot);
      if (!each.meant && !each.anew) continue;
      if (now - each.saidAt < (each.known ? AGAIN_MS : HELLO_MS) - 1) continue;
      const { group } = each;
      if (said.has(group) || this.#send(robot, group, { clock: this.ticks.name })) {
        each.saidAt = now;
        each.anew = false;
        if (group !== null) said.add(group);
      }
    }
    if (this.#robots.size) this.#timer = setTimeout(() => this.#say(), HELLO_MS);
  }

  #beginAnew(now) {
    this.ticks.begin(clockName(), now);
    for (const each of this.#robots.values()) {
      this.#unknown(each);
      each.anew = true; // who is meant no more has to know it, too
    }
    for (const node of this.headset.nodes) node.lastTicks = 0;
    this.dispatchEvent(new CustomEvent("anew"));
  }

  #unknown(each) {
    each.known = false;
    each.saidAt = -Infinity;
  }

  #take(message) {
    if (message.manager !== MANAGER || message.senderType !== ROS) return;
    const said = object(message.data);
    if (said.clock !== this.ticks.name) return;
    const robot = message.senderId;
    // of a group whose members are not all known, each that was said hello to may ask
    const each = this.#groups.length ? this.#meet(robot, this.now()) : this.#robots.get(robot);
    if (each === undefined) return;
    const answer = this.ticks.answer(said, this.now());
    if (answer !== null) this.#send(robot, each.group, answer);
    const { known: before, asked } = each;
    each.asked = true;
    each.known = said.known === true;
    each.maxAgeS = typeof said.maxAgeS === "number" ? said.maxAgeS : each.maxAgeS;
    if (each.known !== before || !asked) this.dispatchEvent(new CustomEvent("known", { detail: { robot, ...each } }));
  }

  #send(robot, group, said) {
    const meta = metadata(this.headset.id, { manager: MANAGER });
    const to = group === null ? { ids: [robot] } : { groups: [group] };
    return this.headset.sendNow(() => [{ to: ROS, ...to, meta, data: json(said) }]);
  }
}
