/**
 * The emergency stop: pressed on all robots at once, again until each says that it holds; shown as each robot tells it.
 *
 * A press is never forgotten: who is away, or not known yet, is stopped as soon as he is there; without a connection it is
 * sent as soon as there is one, and a page that is loaded again goes on with it. It ends when it is confirmed or taken
 * back. That is the one thing here that may be old.
 */

import { h, say, show } from "./dom.js";

const TOPIC = "/emergency_stop";
const TYPE = "std_msgs/Bool";
const AGAIN_MS = 200;
/** A robot is asked whether it is stopped when for so long nothing was said of it; so many at a time. */
const CHECK_MS = 1500;
const CHECKED_AT_ONCE = 16;
const TRUE = new Uint8Array([0, 1, 0, 0, 1]);
const FALSE = new Uint8Array([0, 1, 0, 0, 0]);
const ANY_GROUP = Array.from({ length: 255 }, (_, at) => at + 1);
/** Where it is written down for the page that comes after this one in the same tab. */
const KEPT = "macs.stop";

export class Stop {
  /** `tell` tells an event; `get` asks the gateway for JSON; `me` is what this page may (/view/me). */
  constructor(headset, tell, get, me) {
    this.headset = headset;
    this.get = get;
    this.tell = tell;
    this.mayStop = me.may.includes("stop");
    /** Robots that may be named by id, or "any"; all others are reached by these groups. */
    this.named = me.robots;
    this.groups = me.groups === "any" ? ANY_GROUP : me.groups;
    this.online = new Set();
    /** robot → {stopped, tookMs}: what it said last, and how long that took after the press. */
    this.states = new Map();
    this.pressedAt = null;
    this.askedAt = 0;
    this.turn = 0;
    /** All that were ever seen here: who is away when it is pressed is meant too. */
    this.known = new Set();
    /** Those that have not confirmed yet, online or not. */
    this.wanted = new Set();
    /** Pressed for all: so also for robots that are seen for the first time, until it is released. */
    this.all = false;
    this.onChange = () => {};
    this.state = headset.subscribe(TOPIC, TYPE, {}, (message) => this.#take(message));
    this.command = this.mayStop ? headset.advertise(TOPIC, TYPE) : null;
    headset.addEventListener("link", ({ detail }) => {
      if (detail.up) this.#send();
      else this.states.clear();
      this.onChange();
    });
    headset.addEventListener("refused", ({ detail }) => this.#refused(detail));
    // timers of a hidden page are slow
    document.addEventListener("visibilitychange", () => this.#send());
    this.element = this.#build();
    this.#restore();
    setInterval(() => this.#check(), CHECK_MS);
  }

  /** These robots are online. */
  setRobots(robots) {
    const gone = [...this.online].filter((robot) => !robots.includes(robot));
    const came = robots.filter((robot) => !this.online.has(robot));
    this.online = new Set(robots);
    gone.forEach((robot) => this.states.delete(robot));
    const left = gone.filter((robot) => this.state.robots.has(robot));
    for (const node of [this.state, this.command]) {
      if (left.length) node?.deregister({ robots: left });
      node?.register(this.#named(robots));
    }
    for (const robot of robots) {
      this.known.add(robot);
      // also who was known: a program that has started anew holds nothing
      if (this.all && came.includes(robot) && !this.isStopped(robot)) this.wanted.add(robot);
    }
    this.#send();
  }

  /** How these are named: by id where this page may, all others by the groups in which they have to be. */
  #named(robots) {
    const named = robots.filter((robot) => this.named === "any" || this.named.includes(robot));
    return { robots: named, groups: named.length < robots.length ? this.groups : [] };
  }

  /** Stop all robots. */
  press() {
    if (!this.mayStop) return;
    if (!this.open) this.pressedAt = performance.now();
    this.askedAt = performance.now();
    this.all = true;
    this.known.forEach((robot) => this.wanted.add(robot));
    this.states.forEach((state) => (state.tookMs = null));
    const { size } = this.known;
    const whom = size === 1 ? `robot ${[...this.known][0]}` : size ? `${size} robots` : "all robots, of which none is known yet";
    this.tell("stop", `stop pressed for ${whom}`);
    // also those that somebody else has stopped: a release of his is not ours
    if (this.online.size) this.command.publish(TRUE, this.#named([...this.online]));
    this.#send({ again: false });
    this.onChange();
  }

  /** Let these robots go on, as far as they let this page; a press that is not confirmed is taken back. */
  release(robots = this.stopped()) {
    this.wanted.clear();
    this.all = false;
    this.pressedAt = null;
    this.askedAt = performance.now();
    const whom = robots.map((robot) => `robot ${robot}`).join(", ");
    const sent = robots.length > 0 && this.command?.publish(FALSE, this.#named(robots));
    if (sent) this.tell("stop", `release asked for ${whom}`);
    else if (robots.length || !this.headset.connected) this.tell("stop", "no connection: who is stopped was not released");
    else this.tell("stop", "the stop is taken back where it is not confirmed");
    this.#send();
    this.onChange();
  }

  /** Whether a press is not confirmed yet, by somebody who is known or because nobody is. */
  get open() {
    return this.wanted.size > 0 || (this.all && this.known.size === 0);
  }

  /** Robots that say that they are stopped. */
  stopped() {
    return [...this.states].filter(([, state]) => state.stopped).map(([robot]) => robot).sort((a, b) => a - b);
  }

  isStopped(robot) {
    return this.states.get(robot)?.stopped ?? false;
  }

  /** Whether it was asked to stop and has not said so yet. */
  isWanted(robot) {
    return this.wanted.has(robot);
  }

  #take(message) {
    this.#said(message.senderId, message.data.length > 4 && message.data[4] !== 0);
  }

  #said(robot, stopped) {
    const before = this.states.get(robot);
    const state = { stopped, tookMs: before?.tookMs ?? null, why: "", at: performance.now() };
    if (stopped && this.wanted.delete(robot) && this.pressedAt !== null) state.tookMs = performance.now() - this.pressedAt;
    this.states.set(robot, state);
    // a release from just before the press may be told after it: then the press counts
    // and of whom nothing was heard since it came, or since the connection is there again, it is not known that it was released
    const fresh = performance.now() - this.askedAt < CHECK_MS;
    const again = !stopped && this.all && (before ? before.stopped && fresh : true);
    if (again) this.wanted.add(robot);
    // somebody has let all of them go on: then newcomers may, too
    if (before?.stopped && !stopped && !this.wanted.size && !this.stopped().length) this.all = false;
    if (before?.stopped !== stopped && (before || stopped)) {
      this.tell("stop", stopped ? `robot ${robot} is stopped` : `robot ${robot} may go on`);
    }
    this.onChange(robot);
    if (again) this.#send();
    else this.#show();
  }

  #refused({ robot, name, reason }) {
    if (name !== TOPIC) return;
    for (const one of robot ? [robot] : this.wanted) {
      this.states.set(one, { ...(this.states.get(one) ?? { stopped: false, tookMs: null }), why: reason });
    }
    this.#show();
  }

  /** Until each robot has said that it holds. */
  #send({ again = true } = {}) {
    clearTimeout(this.timer);
    this.wanted.forEach((robot) => this.isStopped(robot) && this.wanted.delete(robot));
    if (this.wanted.size && this.mayStop) {
      const online = [...this.wanted].filter((robot) => this.online.has(robot));
      if (again && online.length) this.command.publish(TRUE, this.#named(online));
      this.timer = setTimeout(() => this.#send(), AGAIN_MS);
    }
    this.#show();
  }

  /** What it says was lost if nothing came for a while, or the robot was away meanwhile: then it is asked. */
  async #check() {
    const unknown = this.all ? [...this.online].filter((robot) => !this.states.has(robot)) : [];
    const due = [...new Set([...this.wanted, ...this.stopped(), ...unknown])].filter((robot) => {
      const at = Math.max(this.askedAt, this.states.get(robot)?.at ?? 0);
      return this.online.has(robot) && performance.now() - at > CHECK_MS;
    });
    this.turn = due.length > CHECKED_AT_ONCE ? (this.turn + CHECKED_AT_ONCE) % due.length : 0;
    const asked = [...due.slice(this.turn), ...due.slice(0, this.turn)].slice(0, CHECKED_AT_ONCE);
    for (const robot of asked) {
      const [before, { askedAt }] = [this.states.get(robot), this];
      const status = await this.get(`/view/robots/${robot}/status`);
      const same = this.states.get(robot) === before && this.askedAt === askedAt && this.online.has(robot);
      if (same && typeof status?.stopped === "boolean") this.#said(robot, status.stopped);
    }
  }

  // -- over the end of a page ----------------------------------------------------------------------------------------

  /** A page that is loaded again goes on with what was pressed in the one before. */
  #restore() {
    let kept = null;
    try {
      kept = JSON.parse(sessionStorage.getItem(KEPT));
    } catch {
      // a browser that keeps nothing
    }
    if (!Array.isArray(kept?.wanted) || !Array.isArray(kept.known)) return this.#show();
    this.all = kept.all === true;
    kept.wanted.forEach((robot) => this.wanted.add(robot));
    kept.known.forEach((robot) => this.known.add(robot));
    this.pressedAt = performance.now();
    this.#send();
  }

  #keep() {
    const now = { all: this.all, wanted: [...this.wanted], known: [...this.known] };
    const kept = this.open || this.all ? JSON.stringify(now) : null;
    if (kept === this.kept) return;
    this.kept = kept;
    try {
      if (kept === null) sessionStorage.removeItem(KEPT);
      else sessionStorage.setItem(KEPT, kept);
    } catch {
      // likewise
    }
  }

  // -- what is shown -------------------------------------------------------------------------------------------------

  #build() {
    this.button = h(
      "button",
      { type: "button", class: "stop", id: "stop", title: "Stop all robots (Escape)", onclick: () => this.press() },
      h("span", { class: "stop-sign", "aria-hidden": "true" }),
      h("span", {}, "Stop"),
    );
    this.releaseButton = h(
      "button",
      { type: "button", class: "quiet", id: "release", hidden: true, onclick: () => this.#releaseAsked() },
      "Release",
    );
    this.status = h("p", { class: "stop-status", id: "stop-status", role: "status", "aria-live": "assertive" });
    if (!this.mayStop) show(this.button, false);
    window.addEventListener("keydown", (event) => {
      if (event.key === "Escape" && !document.querySelector("dialog[open]")) this.press();
    });
    return h("div", { class: "stop-bar" }, this.status, this.releaseButton, this.button);
  }

  /** Twice within three seconds: a slip releases nothing. */
  #releaseAsked() {
    if (this.releaseButton.dataset.sure) {
      this.#calm();
      this.release();
    } else {
      this.releaseButton.dataset.sure = "yes";
      say(this.releaseButton, "Release: sure?");
      this.calming = setTimeout(() => this.#calm(), 3000);
    }
  }

  #calm() {
    clearTimeout(this.calming);
    delete this.releaseButton.dataset.sure;
    say(this.releaseButton, "Release");
  }

  #show() {
    this.#keep();
    const stopped = this.stopped();
    this.element.dataset.state = this.open ? "waiting" : stopped.length ? "stopped" : "free";
    show(this.releaseButton, this.mayStop && (stopped.length > 0 || this.open || this.all));
    say(this.status, this.#words(stopped).join(" · "));
  }

  #words(stopped) {
    const list = (robots) => `robot ${robots.join(", ")}`;
    const away = [...this.wanted].filter((robot) => !this.online.has(robot));
    const waiting = [...this.wanted].filter((robot) => this.online.has(robot));
    if (this.open && !this.mayStop) return [`a stop is not confirmed by ${list([...this.wanted])}, and this token may not stop`];
    if (this.open && !this.headset.connected) return ["no connection: the stop is sent as soon as there is one"];
    if (this.all && !this.headset.connected) return ["no connection: how robots are is not known"];
    const words = [];
    if (waiting.length) {
      const reason = waiting.map((robot) => this.states.get(robot)?.why).find(Boolean);
      words.push(`no confirmation yet of ${list(waiting)}${reason ? ` (${reason})` : ""}`);
    } else if (stopped.length) {
      const took = stopped.map((robot) => this.states.get(robot).tookMs).filter((ms) => ms !== null);
      words.push(`${list(stopped)} stopped${took.length ? ` after ${Math.round(Math.max(...took))} ms` : ""}`);
    }
    if (away.length) words.push(`${list(away)} not online: stopped on return`);
    const nobody = this.online.size ? "how robots are is not known" : "no robot is online";
    if (this.all && !words.length) words.push(`${nobody}: each that comes is stopped`);
    return words;
  }
}
