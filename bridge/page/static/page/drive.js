/**
 * Driving: commands only while somebody holds on, and a zero command at once when he lets go, for whatever reason.
 *
 * Held is the pointer on the pad, a key while the pad has the focus, or a shoulder button of a gamepad. Lost is the hold
 * also when the window loses the focus, the tab is hidden, another view or robot is chosen, a modifier key is pressed, the
 * page closes or stood still, the connection is not fresh, the robot leaves, refuses, or is stopped. After that it has to
 * be taken anew: nothing drives on by itself.
 */

import { refused } from "../shared/words.js";
import { digits, h, panel, say, show } from "./dom.js";

export const COMMANDS = {
  "geometry_msgs/msg/Twist": (linear, angular) => ({ linear, angular }),
  "geometry_msgs/msg/TwistStamped": (linear, angular) => ({
    header: { stamp: stamp(), frame_id: "base_link" },
    twist: { linear, angular },
  }),
};

const EVERY_MS = 50;
/** A page that stood still for so long does not know what its user does now. */
const STILL_MS = 200;
/** Nothing goes to a gateway that has not answered for so long. */
const FRESH_MS = 200;
const ZEROS = [40, 80];
const KEYS = {
  ArrowUp: [1, 0],
  ArrowDown: [-1, 0],
  ArrowLeft: [0, 1],
  ArrowRight: [0, -1],
  KeyW: [1, 0],
  KeyS: [-1, 0],
  KeyA: [0, 1],
  KeyD: [0, -1],
};
const CLUTCH_BUTTONS = [4, 5, 6, 7];
const DEAD_ZONE = 0.08;
/** So long an answer is waited for, and then so long until it is asked again, as long as a zero command is owed. */
const ANSWER_MS = 5000;
const AGAIN_MS = 500;
const LATE_ZERO_MS = 1000;
/** headset → panels, closed ones too, whose last zero command may not have come. */
const debts = new WeakMap();

export class Drive {
  #source = null;
  #forward = 0;
  #turn = 0;
  #timer = null;
  #tickedAt = 0;
  #keys = new Set();
  #unlisten = [];
  #barred = "the robot is asked";
  /** Whether its button is down since before it would count: it has to be pressed anew to take hold. */
  #gamepadHeld = true;
  #gamepad = undefined;
  #online = true;

  constructor(robot, topic, type, { headset, clock, types, stop, tell }) {
    this.robot = robot;
    this.topic = topic;
    this.headset = headset;
    this.clock = clock;
    this.stop = stop;
    this.tell = tell;
    this.shape = COMMANDS[type];
    this.node = headset.advertise(topic, type, { robots: [robot] });
    clock.mean([robot]);
    this.debt = 0;
    this.away = false;
    this.element = this.#build();
    this.#listen();
    this.#inherit();
    types.get(type, robot).then(
      (found) => {
        this.type = found;
        this.zero = found.write(this.shape({}, {}));
        this.#judge();
      },
      (error) => this.#bar(error.message),
    );
  }

  /** What the robot said of itself: who has control, whether it is stopped. */
  setStatus(status) {
    this.status = status;
    const node = status?.nodes?.find((each) => each.name === this.topic && (each.control || each.deadman));
    this.control = node?.control ?? null;
    const holder = this.control?.holder ?? null;
    const own = `unity/${this.headset.id}`;
    this.holder = holder;
    show(this.controlRow, this.control !== null);
    if (this.control !== null) {
      const left = digits(this.control.seconds_left ?? 0);
      say(this.controlText, !holder ? "Nobody has control" : holder === own ? `You have control, ${left} s` : `${holder} has control`);
      show(this.takeButton, holder === null);
      show(this.giveBackButton, holder === own);
    }
    this.#tellLimits(node?.deadman, status);
    this.#judge();
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

  get held() {
    return this.#source !== null;
  }

  /** The robot is there, or not: who is away is not driven, and not driven on when he is back. */
  setOnline(online) {
    this.#online = online;
    if (!online) this.away = true;
    this.#judge();
  }

  /** A gamepad is looked at with each frame that the screen shows, and before each command. */
  draw() {
    const pad = [...(navigator.getGamepads?.() ?? [])].find((each) => each?.connected);
    const clutch = pad && CLUTCH_BUTTONS.some((button) => pad.buttons[button]?.pressed);
    const another = pad && this.#source === "gamepad" && pad?.index !== this.#gamepad;
    if (another) {
      this.release("it is another gamepad");
    } else if (clutch && document.hasFocus()) {
      const [turn = 0, forward = 0] = pad.axes.map((axis) => (Math.abs(axis) < DEAD_ZONE ? 0 : -axis));
      if (this.#source === "gamepad" || (!this.#gamepadHeld && this.#take("gamepad"))) {
        this.#gamepad = pad.index;
        this.#point(forward, turn);
      }
      this.#gamepadHeld = true;
    } else {
      if (this.#source === "gamepad") this.release("the button was released");
      this.#gamepadHeld = Boolean(clutch);
    }
  }

  /** Let go: a zero command, at once and twice more, and once again when the way to the robot is known to be open. */
  release(why) {
    this.#gamepadHeld = true;
    if (this.#source === null) return;
    this.#source = null;
    this.#keys.clear();
    clearInterval(this.#timer);
    this.#point(0, 0);
    this.#sendZero();
    for (const ms of ZEROS) setTimeout(() => this.#source === null && this.#sendZero(), ms);
    this.#owe();
    this.pad.classList.remove("held");
    this.why = why;
    this.#judge();
  }

  close() {
    this.release("the panel was closed");
    this.#unlisten.forEach((end) => end());
    this.clock.mean([]);
    this.closed = true;
    if (!this.owing) this.node.deregister({ robots: [this.robot] }); // else when the last zero has gone
    this.element.remove();
  }

  // -- the last zero command -----------------------------------------------------------------------------------------

  /**
   * What is sent while a connection stands still or is lost comes too late or never, and a robot may keep its last speed.
   * So the zero is sent once more when the gateway has answered, with the robot online, and the panel's end changes
   * nothing about that. Whoever takes hold meanwhile says himself what is to be.
   */
  async #owe() {
    this.debt += 1;
    if (this.owing) return;
    this.owing = true;
    if (!debts.has(this.headset)) debts.set(this.headset, new Set());
    debts.get(this.headset).add(this);
    while (this.owing && !this.held) {
      const { debt } = this;
      const there = await this.headset.online({ timeoutMs: ANSWER_MS }).catch(() => null);
      if (!this.owing || this.held) break;
      if (debt !== this.debt) continue; // what was asked before the release tells nothing of it
      if (there?.robots.includes(this.robot)) {
        this.#sendZero();
        if (!this.away) break;
        this.away = false; // it may not have this topic yet: once more
        await pause(LATE_ZERO_MS);
      } else {
        this.away = true;
        await pause(AGAIN_MS);
      }
    }
    if (!this.owing) return;
    this.#paid();
    if (this.closed) this.node.deregister({ robots: [this.robot] });
  }

  #paid() {
    this.owing = false;
    debts.get(this.headset).delete(this);
  }

  /** What a panel of before owes this robot's topic is for this one to send now: their node is the same. */
  #inherit() {
    for (const each of [...(debts.get(this.headset) ?? [])]) {
      if (each.robot !== this.robot || each.topic !== this.topic) continue;
      each.#paid();
      this.lastZero = each.zero ?? each.lastZero;
      this.#owe();
    }
  }

  // -- the hold ------------------------------------------------------------------------------------------------------

  #take(source) {
    if (this.#source !== null || this.#barred || this.zero === undefined) return false;
    this.#source = source;
    this.away = false;
    this.#tickedAt = performance.now();
    this.pad.classList.add("held");
    this.#timer = setInterval(() => this.#tick(), EVERY_MS);
    this.#judge();
    return true;
  }

  /** Forward and left, each from -1 to 1, as it was at `at`. */
  #point(forward, turn, at = performance.now()) {
    const limited = (value) => Math.max(-1, Math.min(1, value));
    const first = !this.#forward && !this.#turn;
    this.#forward = limited(forward);
    this.#turn = limited(turn);
    this.knob.style.transform = `translate(${-50 - 38 * this.#turn * 2}%, ${-50 - 38 * this.#forward * 2}%)`;
    // what was done before the last command was made is in the next one
    const isNew = at > this.node.lastMadeAt;
    if (first && isNew && this.#source !== null && (this.#forward || this.#turn)) this.#send(at);
  }

  #tick() {
    if (this.#source === "gamepad") this.draw(); // nobody else looks while the robot's view is not shown
    if (!this.held) return;
    const now = performance.now();
    const still = now - this.#tickedAt;
    this.#tickedAt = now;
    if (still > STILL_MS) this.release(`the page stood still for ${Math.round(still)} ms`);
    else this.#send(now);
  }

  #send(madeAt) {
    const x = this.#forward * this.mostForward.valueAsNumber;
    const z = this.#turn * this.mostTurn.valueAsNumber;
    const message = this.type.write(this.shape({ x }, { z }));
    const sent = this.node.publish(message, { robots: [this.robot], freshMs: FRESH_MS, madeAt });
    if (sent) this.#shown(x, z);
    else this.release("the connection is not fresh");
  }

  #sendZero() {
    const zero = this.zero ?? this.lastZero;
    if (zero === undefined) return;
    this.node.publish(zero, { robots: [this.robot] });
    this.#shown(0, 0);
  }

  #shown(x, z) {
    say(this.speed, `${x.toFixed(2)} m/s · ${z.toFixed(2)} rad/s`);
  }

  /** Why nobody may drive now; empty when he may. */
  #judge() {
    const own = `unity/${this.headset.id}`;
    if (!this.headset.connected) this.#bar("no connection");
    else if (!this.#online) this.#bar("the robot is not online");
    else if (this.zero === undefined) this.#bar("the type of its commands is asked for");
    else if (this.stop.isStopped(this.robot) || this.status?.stopped) this.#bar("the robot is stopped");
    else if (this.stop.isWanted(this.robot)) this.#bar("a stop is pressed");
    else if (this.holder && this.holder !== own) this.#bar(`${this.holder} has control`);
    else this.#bar(this.#uncompared());
  }

  /** A robot that compares clocks and has not yet would take commands of any age, or none. */
  #uncompared() {
    if (!this.#compares || this.clock.of(this.robot)?.known) return "";
    const { reason = "" } = this.node.refusals.get(this.robot) ?? {};
    return `robot ${this.robot} has not compared clocks yet${reason && ` (${reason})`}`;
  }

  #bar(why) {
    this.#barred = why;
    if (why && this.#source !== null) this.release(why);
    this.pad.setAttribute("aria-disabled", String(Boolean(why)));
    this.pad.classList.toggle("barred", Boolean(why));
    const hint = this.why ? `Released: ${this.why}.` : "Hold and drag. Or focus it and use the arrow keys.";
    say(this.hint, why ? `${why.charAt(0).toUpperCase()}${why.slice(1)}.` : this.held ? "Driving. Let go to stop." : hint);
  }

  #listen() {
    const on = (target, type, callback, options) => {
      target.addEventListener(type, callback, options);
      this.#unlisten.push(() => target.removeEventListener(type, callback, options));
    };
    on(this.pad, "pointerdown", (event) => {
      if (event.button !== 0 || isLate(event) || !this.#take("pointer")) return;
      this.pointer = event.pointerId;
      this.pad.setPointerCapture(event.pointerId);
      this.pad.focus({ preventScroll: true });
      this.#follow(event);
    });
    on(this.pad, "pointermove", (event) => {
      if (!this.#isPointer(event)) return;
      // while another button is down, the end of the first is told as a move
      if (isLate(event)) this.release("the page stood still");
      else if (event.buttons & 1) this.#follow(event);
      else this.release("let go");
    });
    for (const type of ["pointerup", "pointercancel", "lostpointercapture"]) {
      on(this.pad, type, (event) => this.#isPointer(event) && this.release("let go"));
    }
    on(this.pad, "contextmenu", (event) => event.preventDefault());
    on(this.pad, "keydown", (event) => this.#key(event, true));
    on(this.pad, "keyup", (event) => this.#key(event, false));
    on(this.pad, "blur", () => this.#source === "keys" && this.release("the pad lost the focus"));
    on(window, "blur", () => this.release("the window lost the focus"));
    on(document, "visibilitychange", () => document.hidden && this.release("the page was hidden"));
    on(this.headset, "link", ({ detail }) => {
      if (!detail.up) this.release("the connection is lost");
      this.#judge();
    });
    on(this.headset, "refused", ({ detail: { robot, name, kind, reason } }) => {
      if (name === this.topic && (!robot || robot === this.robot) && this.held) this.release(refused(kind, reason));
    });
    on(this.clock, "known", () => this.setStatus(this.status));
    on(this.clock, "anew", () => {
      this.release("another clock begins");
      this.#judge();
    });
  }

  #isPointer(event) {
    return this.#source === "pointer" && event.pointerId === this.pointer;
  }

  #follow(event) {
    const { left, top, width, height } = this.pad.getBoundingClientRect();
    const right = (2 * (event.clientX - left)) / width - 1;
    const down = (2 * (event.clientY - top)) / height - 1;
    this.#point(-down / 0.76, -right / 0.76, event.timeStamp);
  }

  #key(event, down) {
    // with a modifier a key is another one, and its end may never be told
    if (down && (event.ctrlKey || event.metaKey || event.altKey)) {
      if (this.#source === "keys") this.release("a modifier key was pressed");
      return;
    }
    if (!(event.code in KEYS)) return;
    event.preventDefault();
    if (down && isLate(event)) return;
    if (down && !event.repeat && (this.#source === "keys" || this.#take("keys"))) this.#keys.add(event.code);
    if (!down) this.#keys.delete(event.code);
    if (this.#source !== "keys") return;
    const sum = (axis) => [...this.#keys].reduce((all, code) => all + KEYS[code][axis], 0);
    if (this.#keys.size) this.#point(sum(0), sum(1), event.timeStamp);
    else this.release("let go");
  }

  // -- what is shown -------------------------------------------------------------------------------------------------

  #build() {
    this.knob = h("span", { class: "knob" });
    const label = `Drive pad for ${this.topic}: arrow keys or W, A, S, D while it has the focus`;
    this.pad = h("div", { class: "pad", id: "pad", tabindex: "0", role: "group", "aria-label": label }, this.knob);
    this.hint = h("p", { class: "hint", id: "drive-hint", role: "status" });
    this.speed = h("span", { class: "figures", id: "drive-speed" }, "0.00 m/s · 0.00 rad/s");
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
    const body = h("div", { class: "drive" }, this.pad, h("div", { class: "drive-side" }, this.hint, settings));
    return panel(`Drive · ${this.topic}`, { id: "drive", tools: [this.speed] }, body);
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

/** What was done so long ago, while the page stood still, takes hold of nothing. */
const isLate = (event) => performance.now() - event.timeStamp > STILL_MS;

const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

function stamp() {
  const now = Date.now();
  return { sec: Math.floor(now / 1000), nanosec: (now % 1000) * 1e6 };
}
