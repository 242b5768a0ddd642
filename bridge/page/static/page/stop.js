/**
 * The emergency stop on the page: what `Halt` does, with its button, its key, a gamepad's, and its words. A page that is loaded
 * again goes on with a press of before.
 */

import { gamepadsStop } from "../shared/gamepads.js";
import { Halt } from "../shared/halt.js";
import { readKept, writeKept } from "../shared/kept-stop.js";
import { Press } from "../shared/press.js";
import { h, say, show } from "./dom.js";

const SURE_MS = 3000;
/** So often gamepads are read. */
const READ_MS = 50;

export class Stop {
  /** `tell` tells an event; `get` asks the gateway for JSON; `me` is what this page may (/view/me). */
  constructor(headset, tell, get, me) {
    this.headset = headset;
    this.tell = tell;
    this.onChange = () => {};
    this.halt = new Halt(headset, me, readKept(), async (robot) => (await get(`/view/robots/${robot}/status`))?.stopped);
    this.halt.addEventListener("change", () => {
      this.#show();
      this.onChange();
    });
    this.halt.addEventListener("said", ({ detail: { robot, stopped } }) => {
      this.tell("stop", stopped ? `robot ${robot} is stopped` : `robot ${robot} may go on`);
    });
    document.addEventListener("visibilitychange", () => this.halt.again());
    const pressed = new Press();
    setInterval(() => pressed.read(gamepadsStop()) && this.press(), READ_MS);
    this.element = this.#build();
    this.halt.again();
  }

  /** These robots are online. */
  setRobots(robots) {
    this.halt.setOnline(robots);
  }

  /** Stop all robots. */
  press() {
    if (!this.halt.press()) return;
    const { size } = this.halt.known;
    const whom = size === 1 ? `robot ${[...this.halt.known][0]}` : size ? `${size} robots` : "all robots, of which none is known yet";
    this.tell("stop", `stop pressed for ${whom}`);
  }

  /** Let robots go on, as far as they let this page; a press that is not confirmed is taken back. */
  release() {
    const { robots, sent } = this.halt.release();
    const whom = robots.map((robot) => `robot ${robot}`).join(", ");
    if (sent) this.tell("stop", `release asked for ${whom}`);
    else if (robots.length || !this.headset.connected) this.tell("stop", "no connection: who is stopped was not released");
    else this.tell("stop", "the stop is taken back where it is not confirmed");
  }

  /** Whether a press is not confirmed yet. */
  get open() {
    return this.halt.open;
  }

  /** Robots that say that they are stopped. */
  stopped() {
    return this.halt.stopped();
  }

  isStopped(robot) {
    return this.halt.said.get(robot) ?? false;
  }

  /** Why this robot may not be driven; empty when it may. */
  bars(robot) {
    return this.halt.bars([robot]);
  }

  #build() {
    this.button = h(
      "button",
      { type: "button", class: "stop", id: "stop", title: "Stop all (Escape, a gamepad's A and B)", onclick: () => this.press() },
      h("span", { class: "stop-sign", "aria-hidden": "true" }),
      h("span", {}, "Stop"),
    );
    this.releaseButton = h(
      "button",
      { type: "button", class: "quiet", id: "release", hidden: true, onclick: () => this.#releaseAsked() },
      "Release",
    );
    this.status = h("p", { class: "stop-status", id: "stop-status", role: "status", "aria-live": "assertive" });
    if (!this.halt.may) show(this.button, false);
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
      this.calming = setTimeout(() => this.#calm(), SURE_MS);
    }
  }

  #calm() {
    clearTimeout(this.calming);
    delete this.releaseButton.dataset.sure;
    say(this.releaseButton, "Release");
  }

  #show() {
    const { state, text } = this.halt.words(this.headset.connected);
    writeKept({ state, kept: this.halt.kept });
    this.element.dataset.state = state;
    show(this.releaseButton, this.halt.may && state !== "free");
    say(this.status, text);
  }
}
