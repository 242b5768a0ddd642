/**
 * Driving one robot at a screen: `Driver` with a pad and gamepads.
 *
 * Lost is the hold also when the window loses the focus, the tab is hidden, another view or robot is chosen, the page closes
 * or stood still, the connection is not fresh, the robot leaves, refuses, or is stopped. After that it has to be taken anew:
 * nothing drives on by itself.
 */

import { readGamepads } from "../shared/gamepads.js";
import { Opened } from "../shared/opened.js";
import { Pad } from "../shared/pad.js";
import { digits, h, panel, say, show } from "./dom.js";

const HZ = 20;

export class Drive {
  #unlisten = [];
  #opened = new Opened();
  #online = true;

  constructor(robot, topic, type, { driver, types, stop, tell }) {
    this.robot = robot;
    this.topic = topic;
    this.driver = driver;
    this.headset = driver.headset;
    this.clock = driver.headset.clock;
    this.stop = stop;
    this.tell = tell;
    this.element = this.#build();
    this.#listen();
    Object.assign(driver, { bars: () => this.#bars(), changed: () => this.#show() });
    this.clock.mean([robot]);
    driver.aim({ topic, type, robots: [robot], groups: [], members: [robot] }, async () => {
      try {
        return await types.get(type, robot);
      } catch (error) {
        this.problem = error.message;
        return null;
      }
    });
    this.timer = setInterval(() => this.#read(performance.now()), 1000 / HZ);
  }

  /** What the robot said of itself: who has control, whether it is stopped. */
  setStatus(status) {
    const node = status?.nodes?.find((each) => each.name === this.topic && (each.control || each.deadman));
    // what it said before this hold says nothing of it
    if (node?.deadman && status !== this.status) this.driver.acted(this.robot, node.deadman.trips);
    this.status = status;
    this.control = node?.control ?? null;
    const holder = this.control?.holder ?? null;
    this.holder = holder;
    show(this.controlRow, this.control !== null);
    if (this.control !== null) {
      const mine = `You have control, ${digits(this.control.seconds_left ?? 0)} s`;
      say(this.controlText, !holder ? "Nobody has control" : holder === this.#own ? mine : `${holder} has control`);
      show(this.takeButton, holder === null);
      show(this.giveBackButton, holder === this.#own);
    }
    this.#tellLimits(node?.deadman, status);
    this.driver.judge();
  }

  /** The robot is there, or not: who is away is not driven, and not driven on when he is back. */
  setOnline(online) {
    this.#online = online;
    this.driver.judge();
  }

  /** Let go, also of what hands hold. */
  release(why) {
    this.pad.release();
    this.#opened.clear();
    this.driver.release(why);
  }

  close() {
    clearInterval(this.timer);
    this.#unlisten.forEach((end) => end());
    this.pad.close();
    this.driver.aim(null);
    this.clock.mean([]);
    Object.assign(this.driver, { bars: () => "no robot is chosen", changed: () => {} });
    this.element.remove();
  }

  get #own() {
    return `unity/${this.headset.id}`;
  }

  /** What the robot does by itself about commands that end, or are old. */
  #tellLimits(deadman, status) {
    const limits = [];
    if (deadman?.silence_s) limits.push(`Dead-man ${deadman.silence_s} s${deadman.trips ? ` · acted ${deadman.trips} times` : ""}`);
    const { known = false, maxAgeS = null } = this.clock.of(this.robot) ?? {};
    if (known && maxAgeS) limits.push(`Commands at most ${maxAgeS} s old`);
    else if (status && !this.#compares) limits.push("This robot does not compare clocks: it takes commands of any age");
    show(this.limitsText, limits.length > 0);
    say(this.limitsText, limits.join(" · "));
  }

  /** Whether the robot wants to know when commands were made. */
  get #compares() {
    return this.clock.tells(this.robot) || typeof this.status?.max_timed_command_age_s === "number";
  }

  /** Why nobody may drive now; empty when he may. */
  #bars() {
    if (!this.headset.connected) return "no connection";
    if (!this.#online) return "the robot is not online";
    if (this.driver.lacks) return this.problem ?? this.driver.lacks;
    if (this.status?.stopped) return "the robot is stopped";
    if (this.stop.bars(this.robot)) return this.stop.bars(this.robot);
    if (this.holder && this.holder !== this.#own) return `${this.holder} has control`;
    return this.#uncompared();
  }

  /** A robot that compares clocks and has not yet would take commands of any age, or none. */
  #uncompared() {
    if (!this.#compares || this.clock.of(this.robot)?.known) return "";
    const { reason = "" } = this.driver.aimed.node.refusals.get(this.robot) ?? {};
    return `robot ${this.robot} has not compared clocks yet${reason && ` (${reason})`}`;
  }

  /** Read what is held, as it was at `at`: what drove before goes on. */
  #read(at) {
    // who does not see what he drives drives nothing: what is held meanwhile has to be let go of
    const seen = document.hasFocus() && this.element.offsetParent !== null;
    if (!seen) this.#opened.clear();
    const held = seen ? this.#opened.held(readGamepads()) : [];
    if (this.pad.sample) held.push(this.pad.sample);
    const sample = held.find(({ source }) => source === this.driver.source) ?? held[0] ?? null;
    this.sample = sample;
    this.driver.limits = { forward: this.mostForward.valueAsNumber, turn: this.mostTurn.valueAsNumber, hz: HZ };
    this.driver.input(sample, at);
    this.#show();
  }

  #show() {
    const { held, barred, why, speed } = this.driver;
    this.pad.show({ held, barred, why, speed, ...(held ? this.sample : {}) });
  }

  #listen() {
    const on = (target, type, callback) => {
      target.addEventListener(type, callback);
      this.#unlisten.push(() => target.removeEventListener(type, callback));
    };
    on(window, "blur", () => this.release("the window lost the focus"));
    on(document, "visibilitychange", () => document.hidden && this.release("the page was hidden"));
    on(this.headset, "link", () => this.driver.judge());
    on(this.clock, "known", () => this.setStatus(this.status));
  }

  // -- what is shown -------------------------------------------------------------------------------------------------

  #build() {
    this.pad = new Pad({ label: `Drive pad for ${this.topic}`, changed: (at) => this.#read(at) });
    const range = (text, name, most, value, step) => {
      const input = h("input", { type: "range", id: name, min: step, max: most, step, value });
      const output = h("output", { for: name }, String(value));
      input.addEventListener("input", () => say(output, String(input.valueAsNumber)));
      return [input, h("label", { for: name }, text, output), input];
    };
    const [forward, ...forwardRow] = range("At most, m/s", "most-forward", 2, 0.5, 0.1);
    const [turn, ...turnRow] = range("At most, rad/s", "most-turn", 3, 1, 0.1);
    this.mostForward = forward;
    this.mostTurn = turn;
    this.controlText = h("span");
    this.takeButton = h("button", { type: "button", class: "small", onclick: () => this.#ask("take") }, "Take control");
    this.giveBackButton = h("button", { type: "button", class: "small", onclick: () => this.#ask("release") }, "Give it back");
    this.controlRow = h("p", { class: "control-row", hidden: true }, this.controlText, this.takeButton, this.giveBackButton);
    this.limitsText = h("p", { class: "muted", hidden: true });
    const settings = h("div", { class: "drive-settings" }, ...forwardRow, ...turnRow, this.controlRow, this.limitsText);
    const { pad, hint, speed } = this.pad;
    const body = h("div", { class: "drive" }, pad, h("div", { class: "drive-side" }, hint, settings));
    return panel(`Drive · ${this.topic}`, { id: "drive", tools: [speed] }, body);
  }

  async #ask(action) {
    try {
      const { done, reason } = await this.headset.ask(this.robot, "RobotControl", { action, topic: this.topic });
      if (!done) this.tell("control", reason || "the robot does not give control");
    } catch (error) {
      this.tell("control", error.message);
    }
  }
}
