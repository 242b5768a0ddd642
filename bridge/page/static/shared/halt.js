/**
 * The emergency stop, of a page or of the worker of a headset, so that it goes out whatever the scene does.
 *
 * A press is for all robots that the token may stop, is sent again until each says that it holds, and is never forgotten:
 * without a connection it goes as soon as there is one, and who is away or comes later is stopped too, until it is released. That
 * is the one thing here that may be old.
 *
 * Events: `change`, and `said`, as a robot says that it is stopped or may go on: {robot, stopped}.
 */

const TOPIC = "/emergency_stop";
const TYPE = "std_msgs/Bool";
const AGAIN_MS = 200;
const RACE_MS = 1500;
/** A robot is asked whether it is stopped when for so long nothing was heard of it; so many in a round, and so many at a time. */
const CHECK_MS = 1500;
const IN_A_ROUND = 16;
const AT_A_TIME = 3;
const TRUE = new Uint8Array([0, 1, 0, 0, 1]);
const FALSE = new Uint8Array([0, 1, 0, 0, 0]);
const ANY_GROUP = Array.from({ length: 255 }, (_, at) => at + 1);

export class Halt extends EventTarget {
  /**
   * `me` is what this token may; `kept` what another page in this tab wrote down: {wanted, known, all}; `ask(robot)` gives what
   * its status says: whether it is stopped, or undefined, and ends in time.
   */
  constructor(headset, me, kept = null, ask = async () => undefined) {
    super();
    this.headset = headset;
    this.ask = ask;
    this.may = me.may.includes("stop");
    this.named = me.robots;
    this.groups = me.groups === "any" ? ANY_GROUP : me.groups;
    this.online = new Set();
    this.known = new Set(kept?.known ?? []);
    this.wanted = new Set(kept?.wanted ?? []);
    this.all = kept?.all ?? false;
    /** robot → whether it says that it is stopped. */
    this.said = new Map();
    /** robot → how long that took after the press, in ms. */
    this.took = new Map();
    this.beganAt = null;
    /** robot → when it was heard of last. */
    this.heardAt = new Map();
    this.turn = 0;
    this.checking = false;
    /** Until a press is said again; null: nobody waits for that. */
    this.timer = null;
    this.state = headset.subscribe(TOPIC, TYPE, {}, (message) => this.#take(message));
    this.command = this.may ? headset.advertise(TOPIC, TYPE) : null;
    this.pressedAt = kept ? performance.now() : -Infinity;
    /** robot → why it does not stop for us. */
    this.why = new Map();
    /** Who was asked to go on and is stopped still: robot → why it does not, null as long as it has said nothing of that. */
    this.letting = new Map();
    headset.addEventListener("refused", ({ detail }) => this.#refused(detail));
    headset.addEventListener("link", ({ detail: { up } }) => this.#link(up));
    setInterval(() => this.check(), CHECK_MS).unref?.();
  }

  setOnline(robots) {
    const gone = [...this.online].filter((robot) => !robots.includes(robot));
    this.online = new Set(robots);
    for (const robot of gone) {
      this.said.delete(robot);
      this.letting.delete(robot);
    }
    for (const node of [this.state, this.command]) {
      if (gone.length) node?.deregister({ robots: gone.filter((robot) => node.robots.has(robot)) });
      node?.register(this.#whom(robots));
    }
    for (const robot of robots) this.known.add(robot);
    this.#wantAll();
    this.#send();
  }

  /** Without a connection nothing is known of anybody; then each that does not say that it holds is told again. */
  #link(up) {
    if (!up) {
      this.said.clear();
      this.letting.clear();
    } else this.#wantAll();
    this.#send();
  }

  /** Pressed for all is pressed for each that has said nothing since it came: a program that has started anew holds nothing. */
  #wantAll() {
    if (!this.all) return;
    for (const robot of this.known) if (!this.said.has(robot)) this.wanted.add(robot);
  }

  /** Stop all. Whether this token may. */
  press() {
    if (!this.may) return false;
    if (!this.open) this.beganAt = performance.now();
    this.took.clear();
    this.letting.clear();
    this.all = true;
    this.pressedAt = performance.now();
    for (const robot of this.known) this.wanted.add(robot);
    if (this.online.size) this.command.publish(TRUE, this.#whom([...this.online]));
    this.#send(false);
    return true;
  }

  /**
   * Let all that are stopped go on, as far as they let this headset; a press that is not confirmed is taken back. What came of
   * it: who was asked to go on, and whether that was sent.
   */
  release() {
    this.wanted.clear();
    this.all = false;
    this.beganAt = null;
    const robots = this.stopped();
    const sent = robots.length > 0 && Boolean(this.command?.publish(FALSE, this.#whom(robots)));
    this.letting = new Map(sent ? robots.map((robot) => [robot, null]) : []);
    this.#changed();
    return { robots, sent };
  }

  /** Say again what is not confirmed: timers of a hidden page are slow. */
  again() {
    this.#send();
  }

  /** Whether a press is not confirmed yet, by somebody who is known or because nobody is. */
  get open() {
    return this.wanted.size > 0 || (this.all && this.known.size === 0);
  }

  /** What a robot's status says of it, where nothing was said on the topic. */
  note(robot, stopped) {
    if (!this.said.has(robot)) this.#say(robot, stopped);
  }

  /** What a robot says is lost at times; also to who was away meanwhile. Then it is asked, in one round at a time. */
  async check(now = performance.now()) {
    if (!this.headset.connected || this.checking) return;
    const doubted = (robot) => this.wanted.has(robot) || this.said.get(robot) || (this.all && !this.said.has(robot));
    const due = [...this.online].filter((robot) => doubted(robot) && now - this.#heard(robot) > CHECK_MS);
    this.turn = due.length > IN_A_ROUND ? (this.turn + IN_A_ROUND) % due.length : 0;
    const left = [...due.slice(this.turn), ...due.slice(0, this.turn)].slice(0, IN_A_ROUND);
    const one = async () => {
      for (let robot = left.shift(); robot !== undefined; robot = left.shift()) await this.#check(robot);
    };
    this.checking = true;
    try {
      await Promise.all(Array.from({ length: AT_A_TIME }, one));
    } finally {
      this.checking = false;
    }
  }

  async #check(robot) {
    const before = this.#heard(robot);
    const stopped = await this.ask(robot);
    if (typeof stopped === "boolean" && this.#heard(robot) === before && this.online.has(robot)) this.#say(robot, stopped);
  }

  /** Since when it is to be asked: it was heard of, or a stop was pressed. */
  #heard(robot) {
    return Math.max(this.pressedAt, this.heardAt.get(robot) ?? -Infinity);
  }

  stopped() {
    return [...this.said].filter(([, stopped]) => stopped).map(([robot]) => robot).sort((one, other) => one - other);
  }

  /** Why none of these may be driven; empty when they may. */
  bars(robots) {
    if (robots.some((robot) => this.said.get(robot))) return "the robot is stopped";
    const unknown = this.all && (!robots.length || robots.some((robot) => !this.said.has(robot)));
    return unknown || robots.some((robot) => this.wanted.has(robot)) ? "a stop is pressed" : "";
  }

  get kept() {
    return { all: this.all, wanted: [...this.wanted], known: [...this.known] };
  }

  #take(message) {
    this.#say(message.senderId, message.data.length > 4 && message.data[4] !== 0);
  }

  #say(robot, stopped) {
    const before = this.said.get(robot);
    this.said.set(robot, stopped);
    this.heardAt.set(robot, performance.now());
    this.why.delete(robot);
    if (!stopped) this.letting.delete(robot);
    if (stopped && this.wanted.delete(robot) && this.beganAt !== null) this.took.set(robot, performance.now() - this.beganAt);
    if (!stopped && this.all && before === undefined) this.wanted.add(robot);
    if (before && !stopped) {
      // a release from just before the press may be told after it: then the press counts
      if (this.all && performance.now() - this.pressedAt < RACE_MS) this.wanted.add(robot);
      // somebody has let all of them go on: then newcomers may, too
      else if (!this.wanted.size && !this.stopped().length) this.all = false;
    }
    if (before !== stopped && (before !== undefined || stopped)) {
      this.dispatchEvent(new CustomEvent("said", { detail: { robot, stopped } }));
    }
    this.#send(false);
  }

  #refused({ robot, name, reason }) {
    if (name !== TOPIC) return;
    for (const one of robot ? [robot] : [...this.wanted, ...this.letting.keys()]) {
      if (this.letting.has(one)) this.letting.set(one, reason);
      else this.why.set(one, reason);
    }
    this.#changed();
  }

  /** Until each robot has said that it holds; at once, or by a timer that runs on, however often others say something. */
  #send(again = true) {
    for (const robot of this.wanted) if (this.said.get(robot)) this.wanted.delete(robot);
    const online = [...this.wanted].filter((robot) => this.online.has(robot));
    if (again && online.length) this.command?.publish(TRUE, this.#whom(online));
    const waits = this.wanted.size > 0 && this.may;
    if (again || !waits) {
      clearTimeout(this.timer);
      this.timer = null;
    }
    if (waits) this.timer ??= setTimeout(() => this.#send(), AGAIN_MS);
    this.#changed();
  }

  /** What to tell a person: {text, state} with state `free`, `waiting` or `stopped`. */
  words(connected) {
    const stopped = this.stopped();
    const state = this.open || (this.all && !connected) ? "waiting" : stopped.length || this.all ? "stopped" : "free";
    return { state, text: this.#said(stopped, connected).join(" · ") };
  }

  #said(stopped, connected) {
    const list = (robots) => `robot ${robots.join(", ")}`;
    if (this.open && !this.may) return [`a stop is not confirmed by ${list([...this.wanted])}, and this token may not stop`];
    if (this.open && !connected) return ["no connection: the stop is sent as soon as there is one"];
    if (this.all && !connected) return ["no connection: how robots are is not known"];
    const words = [];
    const waiting = [...this.wanted].filter((robot) => this.online.has(robot));
    const away = [...this.wanted].filter((robot) => !this.online.has(robot));
    if (waiting.length) {
      const reason = waiting.map((robot) => this.why.get(robot)).find(Boolean);
      words.push(`no confirmation yet of ${list(waiting)}${reason ? ` (${reason})` : ""}`);
    } else if (stopped.length) {
      const took = stopped.flatMap((robot) => this.took.get(robot) ?? []);
      words.push(`${list(stopped)} stopped${took.length ? ` after ${Math.round(Math.max(...took))} ms` : ""}`);
    }
    for (const [robot, reason] of this.letting) if (reason) words.push(`${list([robot])} was not released (${reason})`);
    if (away.length) words.push(`${list(away)} not online: stopped on return`);
    const nobody = this.online.size ? "how robots are is not known" : "no robot is online";
    if (this.all && !words.length) words.push(`${nobody}: each that comes is stopped`);
    return words;
  }

  #whom(robots) {
    const named = robots.filter((robot) => this.named === "any" || this.named.includes(robot));
    return { robots: named, groups: named.length < robots.length ? this.groups : [] };
  }

  #changed() {
    this.dispatchEvent(new Event("change"));
  }
}
