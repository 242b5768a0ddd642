/**
 * The emergency stop: pressed on all robots at once, again until each says that it holds; shown as each robot tells it.
 *
 * A press is never forgotten: without a connection it is sent as soon as there is one, until it is confirmed or taken
 * back. That is the one thing here that may be old.
 */

import { h, say, show } from "./dom.js";

const TOPIC = "/emergency_stop";
const TYPE = "std_msgs/Bool";
const AGAIN_MS = 200;
const TRUE = new Uint8Array([0, 1, 0, 0, 1]);
const FALSE = new Uint8Array([0, 1, 0, 0, 0]);

export class Stop {
  /** `say` tells an event; `mayStop` whether this page may. */
  constructor(headset, tell, mayStop) {
    this.headset = headset;
    this.tell = tell;
    this.mayStop = mayStop;
    /** robot → {stopped, tookMs}: what it said last, and how long that took after the press. */
    this.states = new Map();
    this.pressedAt = null;
    this.wanted = new Set();
    /** Pressed while nobody knew which robots there are. */
    this.pending = false;
    this.onChange = () => {};
    this.state = headset.subscribe(TOPIC, TYPE, {}, (message) => this.#take(message));
    this.command = mayStop ? headset.advertise(TOPIC, TYPE) : null;
    headset.addEventListener("link", ({ detail }) => {
      if (detail.up) this.#send();
      else this.states.clear();
      this.onChange();
    });
    headset.addEventListener("refused", ({ detail }) => this.#refused(detail));
    this.element = this.#build();
  }

  /** These robots are online. */
  setRobots(robots) {
    const now = new Set(robots);
    const gone = [...this.state.robots].filter((robot) => !now.has(robot));
    if (gone.length) {
      this.state.deregister({ robots: gone });
      this.command?.deregister({ robots: gone });
      gone.forEach((robot) => this.states.delete(robot));
    }
    this.state.register({ robots });
    this.command?.register({ robots });
    if (this.pending && robots.length) this.press(robots);
    else this.#show();
  }

  /** Stop these robots, all by default. */
  press(robots = [...this.state.robots]) {
    if (!this.mayStop) return;
    if (!this.pending) this.pressedAt = performance.now();
    this.pending = !this.headset.connected;
    this.wanted = new Set(robots);
    robots.forEach((robot) => this.states.has(robot) && (this.states.get(robot).tookMs = null));
    const whom = robots.length === 1 ? `robot ${robots[0]}` : robots.length ? `${robots.length} robots` : "all robots";
    this.tell("stop", `stop pressed for ${whom}`);
    // also those that somebody else has stopped: a release of his is not ours
    if (robots.length) this.command.publish(TRUE, { robots });
    this.#send({ again: false });
  }

  /** Let these robots go on, as far as they let this page. */
  release(robots = this.stopped()) {
    this.wanted.clear();
    this.pending = false;
    this.pressedAt = null;
    this.command?.publish(FALSE, { robots });
    this.tell("stop", `release asked for ${robots.map((robot) => `robot ${robot}`).join(", ")}`);
    this.#show();
  }

  /** Robots that say that they are stopped. */
  stopped() {
    return [...this.states].filter(([, state]) => state.stopped).map(([robot]) => robot);
  }

  isStopped(robot) {
    return this.states.get(robot)?.stopped ?? false;
  }

  #take(message) {
    const robot = message.senderId;
    const stopped = message.data.length > 4 && message.data[4] !== 0;
    const before = this.states.get(robot);
    const state = { stopped, tookMs: before?.tookMs ?? null, why: "" };
    if (stopped && this.wanted.delete(robot)) state.tookMs = performance.now() - this.pressedAt;
    this.states.set(robot, state);
    if (before?.stopped !== stopped && (before || stopped)) {
      this.tell("stop", stopped ? `robot ${robot} is stopped` : `robot ${robot} may go on`);
    }
    this.onChange(robot);
    this.#show();
  }

  #refused({ robot, name, reason }) {
    if (name !== TOPIC || !robot) return;
    const before = this.states.get(robot) ?? { stopped: false, tookMs: null };
    this.states.set(robot, { ...before, why: reason });
    this.#show();
  }

  /** Until each robot has said that it holds. */
  #send({ again = true } = {}) {
    clearTimeout(this.timer);
    this.wanted.forEach((robot) => this.isStopped(robot) && this.wanted.delete(robot));
    if (!this.wanted.size) return this.#show();
    const online = [...this.wanted].filter((robot) => this.state.robots.has(robot));
    if (again && online.length) this.command.publish(TRUE, { robots: online });
    this.timer = setTimeout(() => this.#send(), AGAIN_MS);
    this.#show();
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
    const stopped = this.stopped();
    const waiting = [...this.wanted];
    const open = waiting.length > 0 || this.pending;
    this.element.dataset.state = open ? "waiting" : stopped.length ? "stopped" : "free";
    show(this.releaseButton, this.mayStop && (stopped.length > 0 || this.pending));
    if (!this.headset.connected && open) {
      say(this.status, "no connection: the stop is sent as soon as there is one");
    } else if (waiting.length) {
      const why = "no confirmation yet of";
      const reasons = waiting.map((robot) => this.states.get(robot)?.why).filter(Boolean);
      say(this.status, `${why} robot ${waiting.join(", ")}${reasons.length ? ` (${reasons[0]})` : ""}`);
    } else if (stopped.length) {
      const took = stopped.map((robot) => this.states.get(robot).tookMs).filter((ms) => ms !== null);
      const within = took.length ? ` after ${Math.round(Math.max(...took))} ms` : "";
      say(this.status, `robot ${stopped.join(", ")} stopped${within}`);
    } else {
      say(this.status, "");
    }
  }
}
