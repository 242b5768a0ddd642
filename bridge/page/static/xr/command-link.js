/**
 * What a headset says: commands, poses, control, the stop, on a socket of their own, in a worker.
 *
 * The scene tells with each of its frames what hands do, and when they did it; here it is decided whether that goes out.
 * It does not when nobody holds on, the picture is old, the robot is stopped or has somebody else in control, the connection
 * is not fresh, or the scene has not said anything for a while: a scene that hangs drives nothing.
 */

import { CommandClock, ROBOTS } from "../macs-clock.js";
import { Headset } from "../macs.js";
import { Types } from "../ros.js";
import { refused } from "../shared/words.js";
import { get, persisted, soon } from "./asking.js";
import { stamp } from "./axes.js";
import { lockout } from "./freshness.js";
import { Halt } from "./halt.js";
import { Hold, STILL_MS } from "./hold.js";
import { Debts } from "./owed.js";
import { Poke } from "./poke.js";
import { Standing } from "./standing.js";
import { POSE_TYPES, TWIST } from "./wire-types.js";

const FOLLOW_MS = 1000;
const SILENCE_MS = 3000;
const RETRY_MS = [20, 50, 100, 200, 300, 500];
const STATUS_MS = 500;
/** Nothing goes to a gateway that has not answered for so long. */
const FRESH_MS = 200;
const ZEROS_MS = [40, 80];
const AGAIN_MS = 500;
const LEAST_TICK_MS = 5;
/** Of a picture of which nothing was heard. */
const NEVER = { at: null, late: 0 };

export class CommandLink {
  #hold = new Hold();
  #target = null;
  #drive = null;
  #poses = new Map();
  #seen = new Map();
  #settings = {};
  #away = "";
  #madeAt = 0;
  /** When a zero was said last: what hands did before it counts no more. */
  #endedAt = -Infinity;
  #sentAt = -Infinity;
  /** When nothing waited here last. */
  #clearAt = 0;
  #askedAt = -Infinity;
  #timer = null;
  #refusal = "";

  /**
   * `tell(message)` tells the scene; `me` is what this token may; `kept` a stop of the page before. `headset`, `types` and
   * `ask` are those of a gateway unless others are given.
   */
  constructor({ url, me, kept, tell, headset, types, ask = get }) {
    this.tell = tell;
    this.me = me;
    this.types = types ?? new Types("", soon);
    this.headset = headset ?? new Headset(url, { silenceMs: SILENCE_MS, retryMs: RETRY_MS });
    this.poking = new Poke(this.headset);
    this.standing = new Standing({
      ask,
      told: (robot, { stopped }) => this.halt.note(robot, stopped === true),
      done: () => this.#judge(),
    });
    this.clock = new CommandClock(this.headset);
    this.halt = new Halt(this.headset, me, kept, async (robot) => (await ask(`/view/robots/${robot}/status`))?.stopped);
    this.online = [];
    this.#listen();
    this.headset.keepConnecting();
    this.headset.follow(FOLLOW_MS);
    setInterval(() => this.#askStatus({ anew: false }), STATUS_MS);
    setInterval(() => this.#report(), 250);
  }

  /** Ask the gateway now: the way to it may be another one. */
  poke() {
    return this.poking.ask();
  }

  /**
   * Whom commands are for: {robots, groups, members, topic, type}; null: nobody. `members` are the robots that are meant,
   * also where only groups may be named.
   */
  aim(target) {
    this.#letGo("another robot was chosen");
    const before = this.#drive;
    this.#drive = null;
    if (before && !before.debts) this.#leave(before);
    this.#closePoses();
    this.#refusal = "";
    this.#target = target && { members: target.robots, ...target, groups: target.groups ?? [] };
    const { robots, groups, members, topic } = this.#target ?? { robots: [], groups: [], members: [], topic: "" };
    this.standing.mean(members, topic);
    if (this.#commands) this.clock.mean(robots, groups, members);
    else this.clock.mean([]);
    this.#askStatus();
    this.#judge();
    if (topic && this.#commands) this.#aimDrive();
    this.#openPoses();
  }

  /** Whether anything at all may be sent to whom it is aimed at. */
  get #commands() {
    return Boolean(this.#target) && this.me.may.includes("command") && !this.#tooMany;
  }

  /** A part of a group would be driven, and the rest not: rather none. */
  get #tooMany() {
    const { length } = this.#target?.members ?? [];
    return length > ROBOTS ? `${length} robots are too many: at most ${ROBOTS} are driven at once` : "";
  }

  /** What somebody chose: {forward, turn, hz, lockoutS, poseHz, frame, …, head, left, right …} */
  set(settings) {
    const before = this.#settings;
    this.#settings = settings;
    if (Object.keys(POSE_TYPES).some((kind) => before[kind] !== settings[kind])) {
      this.#closePoses();
      this.#openPoses();
    }
    this.#judge();
  }

  /** The pictures that driving depends on. The scene says which, and not who receives them: that one may not run. */
  guard(keys) {
    this.#seen = new Map(keys.map((key) => [key, this.#seen.get(key) ?? NEVER]));
    this.#judge();
  }

  /** A picture came: how old it is is judged here; null: it is not received now. */
  see(key, seen) {
    if (!this.#seen.has(key)) return;
    this.#seen.set(key, seen ?? NEVER);
    this.#judge();
  }

  /** What hands do: {at, sample, poses}; `at` by this worker's clock. */
  input({ at, sample, poses }) {
    if (this.#away) return; // what is held meanwhile has to be let go of before it counts
    const now = performance.now();
    const made = Math.min(at, now);
    if (now - made > STILL_MS || made < this.#endedAt) return this.#letGo("what hands do was told too late");
    this.#madeAt = made;
    this.#judge();
    const was = this.#hold.held;
    const began = this.#hold.input(sample, made);
    if (was && !this.#hold.held) this.#ended();
    const due = this.#hold.held && performance.now() - this.#sentAt >= 1000 / this.#settings.hz - 2;
    if (began) this.#report();
    if (began || due) this.#tick();
    if (poses) this.#sendPoses(poses, made);
  }

  /** Nobody looks or holds any more, and why; empty: somebody does again. */
  setAway(why) {
    this.#away = why;
    this.#letGo(why || "somebody is there again"); // what was taken hold of meanwhile does not count either
    this.#judge();
  }

  /** Ask for control, or give it: {action: "take" | "release" | "give", to}. */
  async control(request) {
    const { robots = [], groups = [], topic } = this.#target ?? {};
    if (groups.length && !robots.length) this.#say("control", "this token names groups only: robots give control one by one");
    for (const robot of robots) {
      try {
        const { done, reason } = await this.headset.ask(robot, "RobotControl", { ...request, topic });
        if (!done) this.#say("control", reason || "the robot does not give control");
      } catch (error) {
        this.#say("control", error.message);
      }
    }
    this.#askStatus();
  }

  stop() {
    this.#letGo("a stop is pressed");
    if (!this.halt.press()) this.#say("stop", "this token may not stop");
  }

  release() {
    this.halt.release();
  }

  close() {
    this.#letGo("the page was closed");
    this.clock.close();
    this.headset.close();
  }

  // -- driving -------------------------------------------------------------------------------------------------------

  async #aimDrive() {
    const { topic, type, robots, groups, members } = this.#target;
    const node = this.headset.advertise(topic, type, { robots, groups });
    const drive = { topic, robots, groups, members, node, shape: TWIST[type], type: null, debts: null };
    this.#drive = drive;
    drive.type = await this.#typed(type, "drive", () => this.#drive === drive);
    this.#judge();
  }

  /** A type, asked for as long as it is wanted: a robot that comes later knows it then. */
  #typed(type, kind, wanted) {
    const { members, seen } = this.#target;
    const whom = () => members.find((robot) => this.online.includes(robot)) ?? members[0] ?? seen;
    return persisted(() => this.types.get(type, whom()), wanted, (text) => this.#say(kind, text));
  }

  /** Why nobody may drive now, in words; empty when he may. */
  #judge() {
    const now = performance.now();
    const was = this.#hold.held;
    const quiet = this.#quiet(now);
    const holder = this.#status.map((each) => each.holder).find((each) => each && each !== this.#own);
    let why = quiet || this.#tooMany;
    if (!why && !this.me.may.includes("command")) why = "this token may not drive";
    else if (!why && !this.#drive) why = "the robot takes no velocities";
    else if (!why && !this.#drive.type) why = "the type of its commands is asked for";
    else if (!why && holder) why = `${named(holder)} has control`;
    else if (!why) why = this.#uncompared();
    this.#hold.bar(why);
    if (was && !this.#hold.held) this.#ended();
    clearTimeout(this.#timer);
    if (this.#hold.held) this.#timer = setTimeout(() => this.#tick(), this.#untilNext(now));
    if (why !== this.told) this.#report();
    this.told = why;
  }

  /** What those that are meant said of themselves. */
  get #status() {
    return [...this.standing.said.values()].filter(Boolean);
  }

  /** A robot that compares clocks and has not yet would take commands of any age. */
  #uncompared() {
    for (const [robot, said] of this.standing.said) {
      if (!said?.compares || !this.online.includes(robot) || this.clock.of(robot)?.known) continue;
      return `robot ${robot} has not compared clocks yet`;
    }
    return "";
  }

  /** Why nothing at all goes out. */
  #quiet(now) {
    if (this.#away) return this.#away;
    if (!this.headset.connected) return "no connection";
    if (!this.#target) return "no robot is chosen";
    const { members } = this.#target;
    if (members.length && !members.some((robot) => this.online.includes(robot))) return "the robot is not online";
    return this.halt.bars(members) || this.#blind(now);
  }

  #blind(now) {
    return lockout(this.#ages(now), (this.#settings.lockoutS ?? 0.3) * 1000);
  }

  #ages(now) {
    return [...this.#seen.values()].map(({ at, late }) => (at === null ? null : now - at + late));
  }

  /** When there is something to do next: a command, or the picture gets too old. */
  #untilNext(now) {
    const next = 1000 / (this.#settings.hz ?? 30) - (now - this.#sentAt);
    const ages = this.#ages(now).filter((age) => age !== null);
    const old = ages.length && this.#settings.lockoutS > 0 ? this.#settings.lockoutS * 1000 - Math.max(...ages) + 1 : Infinity;
    return Math.max(LEAST_TICK_MS, Math.min(next, old));
  }

  #tick() {
    const now = performance.now();
    const was = this.#hold.held;
    const due = this.#hold.due(now);
    if (was && due === null) this.#ended();
    if (due === null || this.#blind(now)) return this.#judge();
    if (now - this.#sentAt >= 1000 / this.#settings.hz - 2) this.#send(due, now);
    this.#judge();
  }

  #send({ forward, turn }, now) {
    const { type, shape, node } = this.#drive;
    const linear = { x: forward * this.#settings.forward };
    const angular = { z: turn * this.#settings.turn };
    this.#sentAt = now;
    const message = type.write(shape(linear, angular, performance.timeOrigin + this.#madeAt));
    const { robots, groups } = this.#target;
    if (this.#fresh(now) && node.publish(message, { robots, groups, madeAt: this.#madeAt })) {
      this.speed = { linear: linear.x, angular: angular.z };
    } else {
      this.#letGo("the connection is not fresh");
    }
  }

  /** Whether the gateway answers, and what was sent went. Poses and commands of one frame wait for each other a moment. */
  #fresh(now) {
    const asked = now - this.#askedAt <= FRESH_MS;
    if (this.headset.waitingBytes === 0 || !asked) this.#clearAt = now; // what is said once may wait at that moment
    this.#askedAt = now;
    return this.headset.isFresh(FRESH_MS) && now - this.#clearAt <= FRESH_MS;
  }

  #letGo(why) {
    const was = this.#hold.held;
    this.#hold.release(why);
    if (was) this.#ended();
  }

  /** A zero at once and twice more, and once again when the gateway is known to have taken it and the robot is there. */
  #ended() {
    const drive = this.#drive;
    this.#endedAt = performance.now();
    this.speed = { linear: 0, angular: 0 };
    const zero = (members = drive.members) => {
      const message = drive.type.write(drive.shape({}, {}, performance.timeOrigin + performance.now()));
      const { robots, groups } = this.#others(drive, members);
      if (robots.length || groups.length) drive.node.publish(message, { robots, groups });
    };
    zero();
    for (const ms of ZEROS_MS) setTimeout(zero, ms);
    this.#owe(drive, zero);
    this.#report();
  }

  /** Who takes hold of the same robots anew says himself what is to be. */
  #drives(drive) {
    return this.#hold.held && this.#drive === drive;
  }

  /** Of these robots of a drive those that nobody drives now. */
  #others(drive, members) {
    const driven = this.#hold.held && this.#drive.node === drive.node ? this.#drive.members : [];
    const robots = drive.robots.filter((robot) => members.includes(robot) && !driven.includes(robot));
    return { robots, groups: drive.members.some((robot) => driven.includes(robot)) || this.#drives(drive) ? [] : drive.groups };
  }

  /** What is owed is owed also when another robot is chosen meanwhile, and by each robot on its own. */
  async #owe(drive, zero) {
    const debts = (drive.debts = new Debts(drive.members, performance.now()));
    const owing = () => drive.debts === debts && !this.#drives(drive);
    while (owing() && debts.isOpen(performance.now())) {
      const there = await this.headset.online().catch(() => null);
      const paid = there && owing() ? debts.pay(there.robots) : null;
      if (paid) zero(paid);
      if (debts.isOpen(performance.now())) await new Promise((resolve) => setTimeout(resolve, AGAIN_MS));
    }
    if (drive.debts !== debts) return;
    drive.debts = null;
    if (!this.#drives(drive) && debts.robots.length) {
      this.#say("drive", `robot ${debts.robots.join(", ")} did not come back to be told to stand`);
    }
    if (this.#drive !== drive) this.#leave(drive);
  }

  /** A topic has one node for all robots: those that are driven now keep it. */
  #leave({ node, robots, groups }) {
    const now = this.#drive?.node === node ? this.#drive : { robots: [], groups: [] };
    node.deregister({
      robots: robots.filter((robot) => !now.robots.includes(robot)),
      groups: groups.filter((group) => !now.groups.includes(group)),
    });
    if (!node.robots.size && !node.groups.size) node.close();
  }

  // -- poses ---------------------------------------------------------------------------------------------------------

  #openPoses() {
    if (!this.#commands) return;
    const { robots, groups } = this.#target;
    for (const [kind, type] of Object.entries(POSE_TYPES)) {
      const topic = this.#settings[kind];
      if (!topic || this.#poses.has(kind)) continue;
      const one = { node: this.headset.advertise(topic, type, { robots, groups }), type: null, sentAt: -Infinity };
      this.#poses.set(kind, one);
      this.#typed(type, "poses", () => this.#poses.get(kind) === one).then((found) => (one.type = found));
    }
  }

  #closePoses() {
    for (const { node } of this.#poses.values()) node.close();
    this.#poses.clear();
  }

  #sendPoses(poses, at) {
    const now = performance.now();
    if (!this.#poses.size || this.#quiet(now) || !this.#fresh(now)) return;
    const header = { stamp: stamp(performance.timeOrigin + at), frame_id: this.#settings.frame };
    for (const [kind, one] of this.#poses) {
      const value = poses[kind];
      if (!value || !one.type || at - one.sentAt < 1000 / this.#settings.poseHz - 3) continue;
      one.sentAt = at;
      const { robots, groups } = this.#target;
      one.node.publish(one.type.write({ header, ...value }), { robots, groups, madeAt: at });
    }
  }

  // -- what is heard -------------------------------------------------------------------------------------------------

  get #own() {
    return `unity/${this.headset.id}`;
  }

  #listen() {
    const { headset } = this;
    headset.addEventListener("link", ({ detail: { up, id, why, resumed } }) => {
      if (!up) this.#letGo("the connection is lost");
      if (!up) this.standing.forget();
      else if (this.#target) this.#askStatus();
      this.tell({ op: "link", which: "commands", up, id, why, resumed });
      this.#judge();
    });
    headset.addEventListener("presence", ({ detail: { robots } }) => this.#setOnline(robots));
    headset.addEventListener("gone", ({ detail }) => {
      const gone = detail.filter(({ type }) => type === 1).map(({ id }) => id);
      this.#setOnline(this.online.filter((robot) => !gone.includes(robot)));
    });
    headset.addEventListener("refused", ({ detail: { robot, name, kind, reason } }) => {
      const ours = name === this.#drive?.topic;
      if (ours) {
        this.#refusal = reason;
        this.#letGo(refused(kind, reason));
        this.#askStatus();
      }
      this.#say("refused", `${robot ? `robot ${robot}` : "the gateway"} refused ${name}: ${reason}`);
    });
    headset.addEventListener("access", ({ detail: { kind, reason } }) => this.tell({ op: "access", kind, reason }));
    this.clock.addEventListener("known", () => this.#judge());
    this.clock.addEventListener("anew", () => {
      this.#letGo("another clock begins");
      this.#say("clock", "another clock begins: take hold anew");
    });
    this.halt.addEventListener("change", () => {
      this.#judge();
      this.tell({ op: "stop", ...this.halt.words(headset.connected), kept: this.halt.kept, stopped: this.halt.stopped() });
    });
  }

  #setOnline(robots) {
    const came = robots.filter((robot) => !this.online.includes(robot));
    this.online = robots;
    for (const robot of came) this.types.forget(robot);
    this.halt.setOnline(robots);
    this.tell({ op: "presence", robots });
    this.#judge();
  }

  /** Who has control, and whether it is stopped, as each robot says it itself. */
  #askStatus(how) {
    if (this.#target && this.headset.connected && !this.#away) this.standing.round(how);
  }

  /** Other headsets that would command this robot: whom control can be given to. */
  #candidates(status) {
    const all = new Set(status.flatMap(({ registrants }) => registrants));
    return [...all].filter((each) => each.startsWith("unity/") && each !== this.#own).map((each) => Number(each.slice(6)));
  }

  #say(kind, text) {
    this.tell({ op: "event", kind, text });
  }

  /** What the scene shows. */
  #report() {
    const status = this.#status;
    const here = (this.#target?.members ?? []).filter((robot) => this.online.includes(robot));
    const holder = status.map((each) => each.holder).find(Boolean) ?? null;
    const clock = here.map((robot) => this.clock.of(robot)).find((each) => each?.known);
    const clockless = here.filter((robot) => this.standing.said.get(robot)?.compares === false && !this.clock.tells(robot));
    this.tell({
      op: "state",
      id: this.headset.id,
      connected: this.headset.connected,
      roundTripMs: this.headset.roundTripMs,
      held: this.#hold.held,
      source: this.#hold.source,
      barred: this.#hold.barred,
      why: this.#hold.why,
      blind: this.#blind(performance.now()),
      speed: this.speed ?? { linear: 0, angular: 0 },
      exclusive: status.some((each) => each.exclusive),
      holder: holder && (holder === this.#own ? "you" : named(holder)),
      candidates: this.#candidates(status),
      secondsLeft: status[0]?.secondsLeft ?? 0,
      deadmanS: status[0]?.deadmanS ?? null,
      drops: status[0]?.drops ?? {},
      /** Robots that were asked who has control, and do not say. */
      unknown: here.filter((robot) => this.standing.said.get(robot) === null),
      maxAgeS: clock?.maxAgeS ?? null,
      clockless,
      refusal: this.#refusal,
      unsent: this.#drive?.node.unsent ?? 0,
    });
  }
}

/** `headset 7` for `unity/7`. */
function named(agent) {
  const [type, id] = agent.split("/");
  return `${{ unity: "headset", ros: "robot" }[type] ?? type} ${id}`;
}
