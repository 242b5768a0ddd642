/** At a screen: the mouse points as a ray, and turns the look where it points at nothing. */

import { Raycaster, Vector2 } from "../vendor/three.js";

const TURN = 0.0042;
const MOST_PITCH = 1.2;
const WHEEL = 0.0012;

export class Looking {
  #at = null;
  #down = false;
  #moved = { x: 0, y: 0 };
  #turning = false;
  #wheel = 0;

  constructor(stage, canvas) {
    this.stage = stage;
    this.canvas = canvas;
    this.raycaster = new Raycaster();
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      this.#down = true;
      this.#follow(event);
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (this.#turning) {
        this.#moved.x += event.movementX;
        this.#moved.y += event.movementY;
      }
      this.#follow(event);
    });
    for (const type of ["pointerup", "pointercancel", "lostpointercapture"]) canvas.addEventListener(type, () => (this.#down = false));
    canvas.addEventListener("pointerleave", () => (this.#at = null));
    canvas.addEventListener("wheel", (event) => (this.#wheel += event.deltaY), { passive: true });
  }

  /** The mouse as a source, where it is over the scene. */
  sources() {
    if (!this.#at) return [];
    this.raycaster.setFromCamera(this.#at, this.stage.camera);
    const { origin, direction } = this.raycaster.ray;
    const ray = { origin: origin.clone(), direction: direction.clone() };
    return [{ name: "mouse", kind: "mouse", ray, pressed: this.#down, taken: false }];
  }

  /** After rays were followed: a press that nothing took turns the look; the wheel scales the panel that is pointed at. */
  free(sources, panel = null) {
    const [mouse] = sources;
    this.#turning = Boolean(mouse?.kind === "mouse" && mouse.pressed && !mouse.taken);
    const { look } = this.stage;
    look.yaw += this.#moved.x * TURN;
    look.pitch = Math.max(-MOST_PITCH, Math.min(MOST_PITCH, look.pitch + this.#moved.y * TURN));
    this.#moved = { x: 0, y: 0 };
    if (this.#wheel) panel?.scaleBy(Math.exp(-this.#wheel * WHEEL));
    this.#wheel = 0;
  }

  #follow({ clientX, clientY }) {
    const { left, top, width, height } = this.canvas.getBoundingClientRect();
    this.#at = new Vector2(((clientX - left) / width) * 2 - 1, 1 - ((clientY - top) / height) * 2);
  }
}
