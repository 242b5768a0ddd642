/**
 * The emergency stop of who wears a headset: in the worker, so that it goes out whatever the scene does.
 *
 * A press is for all robots that the token may stop, is sent again until each says that it holds, and is never forgotten:
 * without a connection it goes as soon as there is one, and who comes later is stopped too, until it is released.
 */

const TOPIC = "/emergency_stop";
const TYPE = "std_msgs/Bool";
const AGAIN_MS = 200;
const RACE_MS = 1500;
const TRUE = new Uint8Array([0, 1, 0, 0, 1]);
const FALSE = new Uint8Array([0, 1, 0, 0, 0]);
const ANY_GROUP = Array.from({ length: 255 }, (_, at) => at + 1);

export class Halt extends EventTarget {
  /** `me` is what this token may; `kept` what another page in this tab wrote down: {wanted, known, all}. */
  constructor(headset, me, kept = null) {
    super();
    this.headset = headset;
    this.may = me.may.includes("stop");
    this.named = me.robots;
    this.groups = me.groups === "any" ? ANY_GROUP : me.groups;
    this.online = new Set();
    this.known = new Set(kept?.known ?? []);
    this.wanted = new Set(kept?.wanted ?? []);
    this.all = kept?.all ?? false;
    /** robot → whether it says that it is stopped. */
    this.said = new Map();
    this.state = headset.subscribe(TOPIC, TYPE, {}, (message) => this.#take(message));
    this.command = this.may ? headset.advertise(TOPIC, TYPE) : null;
    this.pressedAt = kept ? performance.now() : -Infinity;
    /** robot → why it does not stop for us. */
    this.why = new Map();
    headset.addEventListener("refused", ({ detail }) => this.#refused(detail));
    headset.addEventListener("link", ({ detail: { up } }) => (up ? this.#send() : this.said.clear()));
  }

  setOnline(robots) {
    const gone = [...this.online].filter((robot) => !robots.includes(robot));
    this.online = new Set(robots);
    for (const robot of gone) this.said.delete(robot);
    for (const node of [this.state, this.command]) {
      if (gone.length) node?.deregister({ robots: gone.filter((robot) => node.robots.has(robot)) });
      node?.register(this.#whom(robots));
    }
    for (const robot of robots) {
      if (this.all && !this.known.has(robot)) this.wanted.add(robot);
      this.known.add(robot);
    }
    this.#send();
  }

  /** Stop all. Whether this token may. */
  press() {
    if (!this.may) return false;
    this.all = true;
    this.pressedAt = performance.now();
    for (const robot of this.known) this.wanted.add(robot);
    if (this.online.size) this.command.publish(TRUE, this.#whom([...this.online]));
    this.#send(false);
    return true;
  }

  /** Let all that are stopped go on, as far as they let this headset; a press that is not confirmed is taken back. */
  release() {
    this.wanted.clear();
    this.all = false;
    const stopped = this.stopped();
    if (stopped.length) this.command?.publish(FALSE, this.#whom(stopped));
    this.#changed();
  }

  /** What a robot's status says of it, where nothing was said on the topic. */
  note(robot, stopped) {
    if (!this.said.has(robot)) this.#say(robot, stopped);
  }

  stopped() {
    return [...this.said].filter(([, stopped]) => stopped).map(([robot]) => robot);
  }

  /** Why none of these may be driven; empty when they may. */
  bars(robots) {
    if (robots.some((robot) => this.said.get(robot))) return "the robot is stopped";
    return this.all || robots.some((robot) => this.wanted.has(robot)) ? "a stop is pressed" : "";
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
    this.why.delete(robot);
    if (stopped) this.wanted.delete(robot);
    if (before && !stopped) {
      // a release from just before the press may be told after it: then the press counts
      if (this.all && performance.now() - this.pressedAt < RACE_MS) this.wanted.add(robot);
      // somebody has let all of them go on: then newcomers may, too
      else if (!this.wanted.size && !this.stopped().length) this.all = false;
    }
    this.#send(false);
  }

  #refused({ robot, name, reason }) {
    if (name !== TOPIC) return;
    for (const one of robot ? [robot] : this.wanted) this.why.set(one, reason);
    this.#changed();
  }

  /** Until each robot has said that it holds. */
  #send(again = true) {
    clearTimeout(this.timer);
    for (const robot of this.wanted) if (this.said.get(robot)) this.wanted.delete(robot);
    const online = [...this.wanted].filter((robot) => this.online.has(robot));
    if (again && online.length) this.command?.publish(TRUE, this.#whom(online));
    if (this.wanted.size && this.may) this.timer = setTimeout(() => this.#send(), AGAIN_MS);
    this.#changed();
  }

  /** What to tell a person: {text, state} with state `free`, `waiting` or `stopped`. */
  words(connected) {
    const stopped = this.stopped();
    const open = this.wanted.size > 0 || (this.all && this.known.size === 0);
    if (open && !connected) return { state: "waiting", text: "no connection: the stop is sent as soon as there is one" };
    if (this.wanted.size) {
      const why = [...this.wanted].map((robot) => this.why.get(robot)).find(Boolean);
      return { state: "waiting", text: `not confirmed yet by robot ${[...this.wanted].join(", ")}${why ? ` (${why})` : ""}` };
    }
    if (stopped.length) return { state: "stopped", text: `robot ${stopped.join(", ")} stopped` };
    if (this.all) return { state: "stopped", text: "each robot that comes is stopped" };
    return { state: "free", text: "" };
  }

  #whom(robots) {
    const named = robots.filter((robot) => this.named === "any" || this.named.includes(robot));
    return { robots: named, groups: named.length < robots.length ? this.groups : [] };
  }

  #changed() {
    this.dispatchEvent(new Event("change"));
  }
}
