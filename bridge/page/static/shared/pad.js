/** Driving at a screen: a pad for pointer and fingers, and keys while it or what belongs to it has the focus. */

import { h, say } from "../page/dom.js";
import { STILL_MS } from "./hold.js";

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
const TRAVEL = 0.76;

export class Pad {
  #keys = new Set();
  #pointer = null;
  #at = { forward: 0, turn: 0 };
  #unlisten = [];

  /**
   * `label` is what it is called; `focusable` are elements that keys count in, besides the pad; `changed(at)` is called when what
   * is held is another one, as it was at `at`.
   */
  constructor({ label = "Drive pad", focusable = [], changed = () => {} } = {}) {
    this.changed = changed;
    this.knob = h("span", { class: "knob" });
    const name = `${label}: arrow keys or W, A, S, D while it has the focus`;
    this.pad = h("div", { class: "pad", id: "pad", tabindex: "0", role: "group", "aria-label": name }, this.knob);
    this.hint = h("p", { class: "hint", id: "drive-hint", role: "status" });
    this.speed = h("span", { class: "figures", id: "drive-speed" });
    this.focusable = [this.pad, ...focusable];
    this.#listen();
  }

  /** {source, forward, turn} while it is held, else null. */
  get sample() {
    if (this.#pointer !== null) return { source: "pointer", ...this.#at };
    if (!this.#keys.size) return null;
    const sum = (axis) => [...this.#keys].reduce((all, code) => all + KEYS[code][axis], 0);
    return { source: "keys", forward: sum(0), turn: sum(1) };
  }

  /** Let go, as the window or the scene did. */
  release() {
    this.#pointer = null;
    this.#keys.clear();
    this.#at = { forward: 0, turn: 0 };
  }

  /** What is said of it: whether it drives, why it may not, why it was let go of last, and what was sent. */
  show({ held, barred, why, speed, forward = 0, turn = 0 }) {
    this.pad.classList.toggle("held", held);
    this.pad.classList.toggle("barred", Boolean(barred));
    this.pad.setAttribute("aria-disabled", String(Boolean(barred)));
    const idle = why ? `Released: ${why}.` : "Hold and drag, or focus it and use the arrow keys.";
    say(this.hint, barred ? `${barred[0].toUpperCase()}${barred.slice(1)}.` : held ? "Driving. Let go to stop." : idle);
    say(this.speed, `${speed.linear.toFixed(2)} m/s · ${speed.angular.toFixed(2)} rad/s`);
    this.knob.style.transform = `translate(${-50 - 76 * turn}%, ${-50 - 76 * forward}%)`;
  }

  close() {
    this.release();
    this.#unlisten.forEach((end) => end());
  }

  #listen() {
    const { pad } = this;
    const on = (target, type, callback) => {
      target.addEventListener(type, callback);
      this.#unlisten.push(() => target.removeEventListener(type, callback));
    };
    on(pad, "pointerdown", (event) => {
      if (event.button !== 0 || isLate(event)) return;
      this.#pointer = event.pointerId;
      pad.setPointerCapture(event.pointerId);
      pad.focus({ preventScroll: true });
      this.#follow(event);
    });
    on(pad, "pointermove", (event) => {
      if (event.pointerId !== this.#pointer) return;
      // while another button is down, the end of the first is told as a move
      if (event.buttons & 1) this.#follow(event);
      else this.#letGo(event);
    });
    for (const type of ["pointerup", "pointercancel", "lostpointercapture"]) {
      on(pad, type, (event) => event.pointerId === this.#pointer && this.#letGo(event));
    }
    on(pad, "contextmenu", (event) => event.preventDefault());
    for (const element of this.focusable) {
      on(element, "keydown", (event) => this.#key(event, true));
      on(element, "keyup", (event) => this.#key(event, false));
      on(element, "blur", (event) => {
        this.#keys.clear();
        this.changed(event.timeStamp);
      });
    }
  }

  #letGo(event) {
    this.release();
    this.changed(event.timeStamp);
  }

  #follow(event) {
    const { left, top, width, height } = this.pad.getBoundingClientRect();
    const turn = -((2 * (event.clientX - left)) / width - 1) / TRAVEL;
    const forward = -((2 * (event.clientY - top)) / height - 1) / TRAVEL;
    this.#at = { forward: Math.max(-1, Math.min(1, forward)), turn: Math.max(-1, Math.min(1, turn)) };
    this.changed(event.timeStamp);
  }

  #key(event, down) {
    // with a modifier a key is another one, and its end may never be told
    if (event.ctrlKey || event.metaKey || event.altKey) this.#keys.clear();
    else if (!(event.code in KEYS)) return;
    else {
      event.preventDefault();
      if (down && !event.repeat && !isLate(event)) this.#keys.add(event.code);
      if (!down) this.#keys.delete(event.code);
    }
    this.changed(event.timeStamp);
  }
}

/** What was done so long ago, while the page stood still, takes hold of nothing. */
const isLate = (event) => performance.now() - event.timeStamp > STILL_MS;
