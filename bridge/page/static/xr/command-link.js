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
import { Driver } from "../shared/driver.js";
import { Halt } from "../shared/halt.js";
import { stamp, wallTime } from "../shared/twist.js";
import { ONLY_BY_GROUP } from "../shared/words.js";
import { get, persisted, soon } from "./asking.js";
import { lockout } from "./freshness.js";
import { Poke } from "./poke.js";
import { Standing } from "./standing.js";
import { POSE_TYPES } from "./wire-types.js";

const FOLLOW_MS = 1000;
const SILENCE_MS = 3000;
const RETRY_MS = [20, 50, 100, 200, 300, 500];
const STATUS_MS = 500;
/** Of a picture of which nothing was heard. */
const NEVER = { at: null, late: 0 };

export class CommandLink {
  #target = null;
  #poses = new Map();
  #seen = new Map();
  #settings = {};
  #away = "";
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
      told: (robot, { stopped }, deadman) => {
        this.halt.note(robot, stopped === true);
        if (deadman) this.driver.acted(robot, deadman.trips);
      },
      done: () => this.driver.judge(),
    });
    this.clock = new CommandClock(this.headset);
    this.driver = new Driver({
      headset: this.headset,
      bars: (now) => this.#bars(now),
      barsIn: (now) => this.#oldIn(now),
      changed: () => this.#report(),
      say: (text) => this.#say("drive", text),
    });
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
    this.driver.release("another robot was chosen");
    this.#closePoses();
    this.#refusal = "";
    this.#target = target && { members: target.robots, ...target, groups: target.groups ?? [] };
    const { robots, groups, members, topic } = this.#target ?? { robots: [], groups: [], members: [], topic: "" };
    this.standing.mean(members, topic);
    if (this.#commands) this.clock.mean(robots, groups, members);
    else this.clock.mean([]);
    this.#askStatus();
    this.driver.aim(topic && this.#commands ? this.#target : null, (wanted) => this.#typed(this.#target.type, "drive", wanted));
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

  /** Whether whom it is aimed at may be named by group only. */
  get #byGroup() {
    const { robots, groups } = this.#target ?? { robots: [], groups: [] };
    return groups.length > 0 && !robots.length;
  }

  /** What somebody chose: {forward, turn, hz, lockoutS, poseHz, frame, …, head, left, right …} */
  set(settings) {
    const before = this.#settings;
    this.#settings = settings;
    this.driver.limits = { forward: settings.forward, turn: settings.turn, hz: settings.hz ?? 30 };
    if (Object.keys(POSE_TYPES).some((kind) => before[kind] !== settings[kind])) {
      this.#closePoses();
      this.#openPoses();
    }
    this.driver.judge();
  }

  /** The pictures that driving depends on. The scene says which, and not who receives them: that one may not run. */
  guard(keys) {
    this.#seen = new Map(keys.map((key) => [key, this.#seen.get(key) ?? NEVER]));
    this.driver.judge();
  }

  /** A picture came: how old it is is judged here; null: it is not received now. */
  see(key, seen) {
    if (!this.#seen.has(key)) return;
    this.#seen.set(key, seen ?? NEVER);
    this.driver.judge();
  }

  /** What hands do: {at, sample, poses}; `at` by this worker's clock. */
  input({ at, sample, poses }) {
    if (this.#away) return; // what is held meanwhile has to be let go of before it counts
    if (!this.driver.input(sample, at)) return;
    if (poses) this.#sendPoses(poses, Math.min(at, performance.now()));
  }

  /** Nobody looks or holds any more, and why; empty: somebody does again. */
  setAway(why) {
    this.#away = why;
    this.driver.release(why || "somebody is there again"); // what was taken hold of meanwhile does not count either
    this.driver.judge();
  }

  /** Ask for control, or give it: {action: "take" | "release" | "give", to}. */
  async control(request) {
    const { robots = [], topic } = this.#target ?? {};
    if (this.#byGroup) this.#say("control", ONLY_BY_GROUP);
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
    this.driver.release("a stop is pressed");
    if (!this.halt.press()) this.#say("stop", "this token may not stop");
  }

  release() {
    this.halt.release();
  }

  close() {
    this.driver.release("the page was closed");
    this.clock.close();
    this.headset.close();
  }

  // -- driving -------------------------------------------------------------------------------------------------------

  /** A type, asked for as long as it is wanted: a robot that comes later knows it then. */
  #typed(type, kind, wanted) {
    const { members, seen } = this.#target;
    const whom = () => members.find((robot) => this.online.includes(robot)) ?? members[0] ?? seen;
    return persisted(() => this.types.get(type, whom()), wanted, (text) => this.#say(kind, text));
  }

  /** Why nobody may drive now, in words; empty when he may. */
  #bars(now) {
    const why = this.#quiet(now) || this.#tooMany;
    if (why) return why;
    if (!this.me.may.includes("command")) return "this token may not drive";
    const holder = this.#status.map((each) => each.holder).find((each) => each && each !== this.#own);
    return this.driver.lacks || (holder ? `${named(holder)} has control` : this.#uncompared());
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

  /** In how many ms the picture gets too old. */
  #oldIn(now) {
    const ages = this.#ages(now).filter((age) => age !== null);
    return ages.length && this.#settings.lockoutS > 0 ? this.#settings.lockoutS * 1000 - Math.max(...ages) + 1 : Infinity;
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
    if (!this.#poses.size || this.#quiet(now) || !this.driver.isFresh(now)) return;
    const header = { stamp: stamp(wallTime(at)), frame_id: this.#settings.frame };
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
      if (!up) this.standing.forget();
      else if (this.#target) this.#askStatus();
      this.tell({ op: "link", which: "commands", up, id, why, resumed });
      this.driver.judge();
    });
    headset.addEventListener("presence", ({ detail: { robots } }) => this.#setOnline(robots));
    headset.addEventListener("gone", ({ detail }) => {
      const gone = detail.filter(({ type }) => type === 1).map(({ id }) => id);
      this.#setOnline(this.online.filter((robot) => !gone.includes(robot)));
    });
    headset.addEventListener("refused", ({ detail: { robot, name, reason } }) => {
      if (name === this.driver.aimed?.topic) {
        this.#refusal = reason;
        this.#askStatus();
      }
      this.#say("refused", `${robot ? `robot ${robot}` : "the gateway"} refused ${name}: ${reason}`);
    });
    headset.addEventListener("access", ({ detail: { kind, reason } }) => this.tell({ op: "access", kind, reason }));
    this.clock.addEventListener("known", () => this.driver.judge());
    this.clock.addEventListener("anew", () => this.#say("clock", "another clock begins: take hold anew"));
    this.halt.addEventListener("change", () => {
      this.driver.judge();
      this.tell({ op: "stop", ...this.halt.words(headset.connected), kept: this.halt.kept, stopped: this.halt.stopped() });
    });
  }

  #setOnline(robots) {
    const came = robots.filter((robot) => !this.online.includes(robot));
    this.online = robots;
    for (const robot of came) this.types.forget(robot);
    this.halt.setOnline(robots);
    this.tell({ op: "presence", robots });
    this.driver.judge();
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
      held: this.driver.held,
      source: this.driver.source,
      barred: this.driver.barred,
      why: this.driver.why,
      blind: this.#blind(performance.now()),
      speed: this.driver.speed,
      exclusive: status.some((each) => each.exclusive),
      byGroup: this.#byGroup,
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
      unsent: this.driver.aimed?.node.unsent ?? 0,
    });
  }
}

/** `headset 7` for `unity/7`. */
function named(agent) {
  const [type, id] = agent.split("/");
  return `${{ unity: "headset", ros: "robot" }[type] ?? type} ${id}`;
}
