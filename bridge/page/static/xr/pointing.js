/**
 * What rays point at and take hold of: buttons of boards are pressed, panels grabbed, moved, turned to who looks, pushed,
 * pulled and scaled.
 */

import { Raycaster, Vector3 } from "../vendor/three.js";
import { deflection } from "../shared/gamepads.js";

const PUSH_M_S = 1.2;
const SCALE_S = 0.9;
const LEAST_M = 0.35;
const MOST_M = 8;

export class Pointing {
  #grabs = new Map();
  #pressed = new Map();
  #over = new Map();

  constructor({ head, mayGrab }) {
    this.raycaster = new Raycaster();
    this.raycaster.layers.enableAll();
    this.head = head;
    /** Whether this source may grab panels: a hand that drives by pinching does not. */
    this.mayGrab = mayGrab;
    /** Groups of panels: those of boards have `userData.board`, those that can be grabbed `userData.grabs`. */
    this.targets = [];
    this.distances = new Map();
  }

  /** With each frame: sources as `Input` gives them, and seconds since the last one. Marks those whose press is used here. */
  update(sources, dt) {
    this.distances.clear();
    for (const name of this.#pressed.keys()) if (!sources.some((each) => each.name === name)) this.#forget(name);
    for (const source of sources) this.#follow(source, dt);
    for (const group of this.targets) {
      const { board } = group.userData;
      if (board) board.hover([...this.#over.values()].find((hit) => hit?.board === board)?.uv ?? null);
    }
  }

  /** Whether something is grabbed by this source. */
  grabs(name) {
    return this.#grabs.has(name);
  }

  /** The panel that a source points at; null: none. */
  panelUnder(name) {
    return this.#over.get(name)?.panel ?? null;
  }

  #follow(source, dt) {
    const { name, ray, pressed } = source;
    const before = this.#pressed.get(name) ?? { pressed: true, taken: true }; // who comes with it pressed has pressed nothing
    const grab = this.#grabs.get(name);
    const hit = ray ? this.#hit(ray) : null;
    this.#over.set(name, hit);
    this.distances.set(name, hit?.distance ?? null);
    let { taken } = before;
    if (pressed && !before.pressed) taken = this.#press(source, hit);
    if (!pressed) {
      if (grab) this.#grabs.delete(name);
      taken = false;
    } else if (grab && ray) {
      this.#move(source, grab, dt);
      this.distances.set(name, grab.distance);
    }
    this.#pressed.set(name, { pressed, taken });
    source.taken = taken;
  }

  #press(source, hit) {
    if (!hit) return false;
    if (hit.board) {
      const id = hit.board.hover(hit.uv);
      if (id) hit.board.press(id);
      if (id || source.kind !== "hand") return true;
    }
    if (hit.panel && this.mayGrab(source)) {
      const { origin, direction } = source.ray;
      const centre = hit.group.position;
      this.#grabs.set(source.name, {
        group: hit.group,
        panel: hit.panel,
        distance: hit.distance,
        offset: centre.clone().sub(origin.clone().addScaledVector(direction, hit.distance)),
      });
      return true;
    }
    return false;
  }

  #move({ ray, gamepad }, grab, dt) {
    if (gamepad && !gamepad.buttons[1]?.pressed) {
      const at = gamepad.axes.length >= 4 ? 2 : 0;
      const push = -deflection(gamepad.axes[at + 1], 0.2) * PUSH_M_S * dt;
      grab.distance = Math.max(LEAST_M, Math.min(MOST_M, grab.distance + push));
      grab.panel.scaleBy(1 + deflection(gamepad.axes[at], 0.2) * SCALE_S * dt);
    }
    const place = ray.origin.clone().addScaledVector(ray.direction, grab.distance).add(grab.offset);
    place.y = Math.max(0.2, Math.min(4, place.y));
    grab.group.position.copy(place);
    face(grab.group, this.head().position);
  }

  #hit({ origin, direction }) {
    this.raycaster.set(origin, direction);
    this.raycaster.far = MOST_M;
    const [first] = this.raycaster.intersectObjects(this.targets, true).filter(({ object }) => object.visible);
    if (!first) return null;
    let group = first.object;
    while (group && !group.userData.board && !group.userData.grabs) group = group.parent;
    if (!group) return null;
    return { group, uv: first.uv, distance: first.distance, board: group.userData.board ?? null, panel: group.userData.grabs ?? null };
  }

  #forget(name) {
    this.#pressed.delete(name);
    this.#grabs.delete(name);
    this.#over.delete(name);
  }
}

/** Turn a panel to who looks at it, about the vertical axis, and a little up or down. */
export function face(group, head) {
  const to = new Vector3().subVectors(head, group.position);
  const level = Math.hypot(to.x, to.z);
  group.rotation.set(-Math.atan2(to.y, level) * 0.8, Math.atan2(to.x, to.z), 0, "YXZ");
}
