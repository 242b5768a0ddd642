/**
 * Driving: a command again and again while somebody holds on, a zero when he lets go, for whatever reason, and one more that is
 * owed where the first ones may not have come. One for each connection, of a page or of a worker.
 */

import { Hold, STILL_MS } from "./hold.js";
import { Debts } from "./owed.js";
import { TWIST, wallTime } from "./twist.js";
import { refused } from "./words.js";

/** Nothing goes to a gateway that has not answered for so long. */
const FRESH_MS = 200;
const ZEROS_MS = [40, 80];
const AGAIN_MS = 500;
/** A robot that has just come back may not have the topic yet, and on a busy machine not soon: it is told again after these. */
const LATE_ZEROS_MS = [1000, 3000, 7000, 15_000];
const LEAST_TICK_MS = 5;
/** Hands that are read more seldom are not waited for. */
const MOST_EVERY_MS = 50;
/** A gateway without a router says so once a second of what is sent. So long after it has, what is sent does go. */
const ROUTED_MS = 1600;
const NO_ROUTE = "no_route";

export class Driver {
  #hold;
  #aimed = null;
  #madeAt = 0;
  /** When a zero was said last: what hands did before it counts no more. */
  #endedAt = -Infinity;
  /** When the next command is due, and about how often hands are read, in ms. */
  #dueAt = -Infinity;
  #everyMs = 0;
  /** When nothing waited here last. */
  #clearAt = 0;
  #askedAt = -Infinity;
  #timer = null;
  #told = "";
  /** When the gateway said last that it has no router. */
  #noRouteAt = -Infinity;
  /** robot → how often its dead-man had acted, as it said first since somebody took hold. */
  #acted = new Map();

  /**
   * `bars(now)` says why nobody may drive, empty when he may, and `barsIn(now)` in how many ms that may change by itself;
   * `changed()` is called when somebody begins, ends, or may; `say(text)` tells a person; `still` is what is said when who reads
   * hands says nothing more.
   */
  constructor({ headset, bars, barsIn = () => Infinity, changed, say, still }) {
    Object.assign(this, { headset, bars, barsIn, changed, say });
    this.#hold = new Hold({ still });
    /** {forward, turn, hz}: full speed in m/s and rad/s, and commands a second. */
    this.limits = { forward: 0, turn: 0, hz: 20 };
    /** What was sent last. */
    this.speed = { linear: 0, angular: 0 };
    headset.addEventListener("link", ({ detail: { up } }) => {
      if (!up) this.release("the connection is lost");
    });
    headset.addEventListener("refused", ({ detail: { name, kind, reason } }) => {
      if (kind === NO_ROUTE) this.#noRouteAt = performance.now();
      if (name === this.#aimed?.topic) this.release(refused(kind, reason));
    });
    headset.clock.addEventListener("anew", () => this.release("another clock begins"));
  }

  get held() {
    return this.#hold.held;
  }

  /** What holds on now; null: nothing. */
  get source() {
    return this.#hold.source;
  }

  /** Why nobody may drive; empty when he may. */
  get barred() {
    return this.#hold.barred;
  }

  /** Why it was let go of last. */
  get why() {
    return this.#hold.why;
  }

  /** {topic, node, robots, groups, members} of whom commands are for; null: nobody. */
  get aimed() {
    return this.#aimed;
  }

  /** What is missing before it can drive, in words; empty: nothing. */
  get lacks() {
    if (!this.#aimed) return "the robot takes no velocities";
    return this.#aimed.type ? "" : "the type of its commands is asked for";
  }

  /**
   * Whom commands are for from now on: {topic, type, robots, groups, members}; null: nobody. `typed(wanted)` gives the writer of
   * the type as long as `wanted()`. What is owed to those of before is paid all the same.
   */
  aim(target, typed) {
    this.release("another robot was chosen");
    const before = this.#aimed;
    this.#aimed = null;
    if (before && !before.debts) this.#leave(before);
    if (target) this.#begin(target, typed);
    this.judge();
  }

  async #begin({ topic, type, robots, groups, members }, typed) {
    const node = this.headset.advertise(topic, type, { robots, groups });
    const drive = { topic, robots, groups, members, node, shape: TWIST[type], type: null, debts: null };
    this.#aimed = drive;
    drive.type = await typed(() => this.#aimed === drive);
    this.judge();
  }

  /** What hands do, as it was at `at`: {source, forward, turn} while something is held, else null. Whether it counts. */
  input(sample, at) {
    const now = performance.now();
    const made = Math.min(at, now);
    if (now - made > STILL_MS || made < this.#endedAt) {
      this.release("what hands do was told too late");
      return false;
    }
    this.#everyMs = made > this.#madeAt && made - this.#madeAt <= MOST_EVERY_MS ? made - this.#madeAt : 0;
    this.#madeAt = made;
    this.judge();
    const was = this.held;
    const began = this.#hold.input(sample, made);
    if (was && !this.held) this.#ended();
    const due = this.held && this.#isDue(performance.now());
    if (began) {
      this.#acted.clear();
      this.changed();
    }
    if (began || due) this.#tick();
    return true;
  }

  /** Let go, whatever hands do: it has to be taken anew. */
  release(why) {
    const was = this.held;
    this.#hold.release(why);
    if (was) this.#ended();
  }

  /**
   * A robot says how often the dead-man of what is driven has acted. Once more since somebody took hold: it has stood, as commands
   * did not come, and goes on only when he takes hold anew.
   */
  acted(robot, times) {
    if (!this.held) return;
    if (!this.#acted.has(robot)) this.#acted.set(robot, times);
    else if (times > this.#acted.get(robot)) this.release("the robot's dead-man has acted");
  }

  /** Something has changed that may bar driving, or permit it. */
  judge() {
    const now = performance.now();
    const was = this.held;
    const why = this.bars(now);
    this.#hold.bar(why);
    if (was && !this.held) this.#ended();
    clearTimeout(this.#timer);
    if (this.held) this.#timer = setTimeout(() => this.#tick(), this.#untilNext(now));
    const before = this.#told;
    this.#told = why;
    if (why !== before) this.changed();
  }

  /** Whether a command is due, or will be before hands are read again: what they do now is sent now, not when it is older. */
  #isDue(now) {
    if (this.#dueAt > now + 1.5 * this.#period) this.#dueAt = now; // they have just been set to be more frequent
    return now >= this.#dueAt - Math.max(2, this.#everyMs / 2);
  }

  /** Of commands, in ms. */
  get #period() {
    return 1000 / this.limits.hz;
  }

  /** Where hands are read again at about that time, that is sent; what they did last is said once more where they are not. */
  #untilNext(now) {
    const read = this.#madeAt + this.#everyMs;
    const next = read <= this.#dueAt + this.#everyMs / 2 ? Math.max(this.#dueAt, read + this.#everyMs / 4) : this.#dueAt;
    return Math.max(LEAST_TICK_MS, Math.min(next - now, this.barsIn(now)));
  }

  #tick() {
    const now = performance.now();
    const was = this.held;
    const due = this.#hold.due(now);
    if (was && due === null) this.#ended();
    const mayGo = due !== null && !this.bars(now);
    if (mayGo && this.#isDue(now)) this.#send(due, now);
    this.judge();
  }

  #send({ forward, turn }, now) {
    const { type, shape, node, robots, groups } = this.#aimed;
    if (node.lastMadeAt > this.#madeAt) return; // a zero, say, is younger: what is held still is read again soon
    const [x, z] = [forward * this.limits.forward, turn * this.limits.turn];
    this.#dueAt = Math.max(this.#dueAt, now - this.#period / 2) + this.#period;
    const message = type.write(shape({ x }, { z }, wallTime(this.#madeAt)));
    if (!this.isFresh(now) || !node.publish(message, { robots, groups, madeAt: this.#madeAt })) {
      this.release("the connection is not fresh");
      return;
    }
    this.speed = { linear: x, angular: z };
  }

  /** Whether the gateway answers, and what was sent went. What is sent at one time waits a moment for each other. */
  isFresh(now) {
    const asked = now - this.#askedAt <= FRESH_MS;
    if (this.headset.waitingBytes === 0 || !asked) this.#clearAt = now; // what is said once may wait at that moment
    this.#askedAt = now;
    return this.headset.isFresh(FRESH_MS) && now - this.#clearAt <= FRESH_MS;
  }

  // -- zeros ---------------------------------------------------------------------------------------------------------

  /** A zero at once and twice more, and once again when the gateway is known to have taken it and the robot is there. */
  #ended() {
    const drive = this.#aimed;
    this.#endedAt = performance.now();
    this.speed = { linear: 0, angular: 0 };
    const zero = (members = drive.members) => {
      const message = drive.type.write(drive.shape({}, {}, Date.now()));
      const { robots, groups } = this.#others(drive, members);
      if (robots.length || groups.length) drive.node.publish(message, { robots, groups });
    };
    zero();
    for (const ms of ZEROS_MS) setTimeout(zero, ms);
    this.#owe(drive, zero);
    this.changed();
  }

  /** Who takes hold of the same robots anew says himself what is to be. */
  #drives(drive) {
    return this.held && this.#aimed === drive;
  }

  /** Of these robots of a drive those that nobody drives now. */
  #others(drive, members) {
    const driven = this.held && this.#aimed.node === drive.node ? this.#aimed.members : [];
    const robots = drive.robots.filter((robot) => members.includes(robot) && !driven.includes(robot));
    return { robots, groups: drive.members.some((robot) => driven.includes(robot)) || this.#drives(drive) ? [] : drive.groups };
  }

  /** What is owed is owed also when another robot is chosen meanwhile, and by each robot on its own. */
  async #owe(drive, zero) {
    const debts = (drive.debts = new Debts(drive.members, performance.now()));
    const owing = () => drive.debts === debts && !this.#drives(drive);
    const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
    let late = false;
    let lastAt = 0;
    while (owing() && debts.isOpen(performance.now())) {
      const there = await this.headset.online().catch(() => null);
      // without a router a gateway goes on with who was online: what is said now may come to nobody
      const routed = performance.now() - this.#noRouteAt > ROUTED_MS;
      const paid = there && owing() && routed ? debts.pay(there.robots) : null;
      if (paid) zero(paid);
      else if (!routed && owing()) zero();
      if (paid && late) {
        for (const ms of LATE_ZEROS_MS) setTimeout(() => owing() && zero(paid), ms);
        lastAt = performance.now() + LATE_ZEROS_MS.at(-1);
      }
      late = true;
      if (debts.isOpen(performance.now())) await pause(AGAIN_MS);
    }
    if (owing()) await pause(Math.max(0, lastAt + 1 - performance.now()));
    if (drive.debts !== debts) return;
    drive.debts = null;
    if (!this.#drives(drive) && debts.robots.length) {
      this.say(`robot ${debts.robots.join(", ")} did not come back to be told to stand`);
    }
    if (this.#aimed !== drive) this.#leave(drive);
  }

  /** A topic has one node for all robots: those that are driven now keep it. */
  #leave({ node, robots, groups }) {
    const now = this.#aimed?.node === node ? this.#aimed : { robots: [], groups: [] };
    node.deregister({
      robots: robots.filter((robot) => !now.robots.includes(robot)),
      groups: groups.filter((group) => !now.groups.includes(group)),
    });
    if (!node.robots.size && !node.groups.size) node.close();
  }
}
