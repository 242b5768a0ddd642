/** Driving at a screen: a pad for pointer and fingers, and keys while it or the scene has the focus. */

import { h, say } from "../page/dom.js";

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

  /** `focusable` are elements that keys count in, besides the pad. */
  constructor(focusable) {
    this.knob = h("span", { class: "knob" });
    const label = "Drive pad: arrow keys or W, A, S, D while it has the focus";
    this.pad = h("div", { class: "pad", id: "pad", tabindex: "0", role: "group", "aria-label": label }, this.knob);
    this.hint = h("p", { class: "hint", id: "drive-hint", role: "status" });
    this.speed = h("p", { class: "figures", id: "drive-speed" });
    this.element = h("section", { class: "xr-drive", "aria-label": "Drive" }, this.pad, h("div", {}, this.hint, this.speed));
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

  /** What the worker says of it. */
  show({ held, barred, why, speed, forward = 0, turn = 0 }) {
    this.pad.classList.toggle("held", held);
    this.pad.classList.toggle("barred", Boolean(barred));
    this.pad.setAttribute("aria-disabled", String(Boolean(barred)));
    const idle = why ? `Released: ${why}.` : "Hold and drag, or focus it and use the arrow keys.";
    say(this.hint, barred ? `${barred[0].toUpperCase()}${barred.slice(1)}.` : held ? "Driving. Let go to stop." : idle);
    say(this.speed, `${speed.linear.toFixed(2)} m/s · ${speed.angular.toFixed(2)} rad/s`);
    this.knob.style.transform = `translate(${-50 - 76 * turn}%, ${-50 - 76 * forward}%)`;
  }

  #listen() {
    const { pad } = this;
    pad.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      this.#pointer = event.pointerId;
      pad.setPointerCapture(event.pointerId);
      pad.focus({ preventScroll: true });
      this.#follow(event);
    });
    pad.addEventListener("pointermove", (event) => {
      if (event.pointerId !== this.#pointer) return;
      if (event.buttons & 1) this.#follow(event);
      else this.release();
    });
    for (const type of ["pointerup", "pointercancel", "lostpointercapture"]) {
      pad.addEventListener(type, (event) => event.pointerId === this.#pointer && this.release());
    }
    pad.addEventListener("contextmenu", (event) => event.preventDefault());
    for (const element of this.focusable) {
      element.addEventListener("keydown", (event) => this.#key(event, true));
      element.addEventListener("keyup", (event) => this.#key(event, false));
      element.addEventListener("blur", () => this.#keys.clear());
    }
  }

  #follow(event) {
    const { left, top, width, height } = this.pad.getBoundingClientRect();
    const turn = -((2 * (event.clientX - left)) / width - 1) / TRAVEL;
    const forward = -((2 * (event.clientY - top)) / height - 1) / TRAVEL;
    this.#at = { forward: Math.max(-1, Math.min(1, forward)), turn: Math.max(-1, Math.min(1, turn)) };
  }

  #key(event, down) {
    // with a modifier a key is another one, and its end may never be told
    if (event.ctrlKey || event.metaKey || event.altKey) return this.#keys.clear();
    if (!(event.code in KEYS)) return;
    event.preventDefault();
    if (down && !event.repeat) this.#keys.add(event.code);
    if (!down) this.#keys.delete(event.code);
  }
}
