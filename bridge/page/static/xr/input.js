/**
 * What hands, controllers, gamepads, keys and the mouse do now, in one shape, read once per frame.
 *
 * A source is {name, kind, ray, pressed, grip, joints, gamepad}: `kind` is `controller`, `hand` or `mouse`; `ray` is where it
 * points, {origin, direction}; `pressed` is its trigger, its pinch or the mouse's button; `grip` a pose of WebXR's.
 */

import { Vector3 } from "../vendor/three.js";
import { pose } from "./axes.js";
import { gamepadsStop, readGamepads } from "../shared/gamepads.js";
import { Opened } from "../shared/opened.js";
import { handDrive, joy, pinchPoint, pinched, stickDrive, stopButtons, stopHand } from "./gestures.js";

const WRIST = "wrist";

export class Input {
  #pinching = { left: false, right: false };
  #stopping = { left: false, right: false };
  /** hand → where it began to drive by pinching, and where the head looked then. */
  #begun = { left: null, right: null };
  #source = null;
  #opened = new Opened();

  constructor({ settings, pad }) {
    this.settings = settings;
    this.pad = pad;
  }

  /** The sources of a frame of WebXR. */
  read(frame, space, inputSources) {
    const sources = [];
    for (const each of inputSources) {
      if (each.handedness !== "left" && each.handedness !== "right") continue;
      const aim = frame.getPose(each.targetRaySpace, space);
      const source = { name: each.handedness, kind: each.hand ? "hand" : "controller", ray: aim && rayOf(aim.transform), taken: false };
      if (each.hand) this.#readHand(source, frame, space, each.hand);
      else this.#readController(source, frame, space, each);
      sources.push(source);
    }
    return sources;
  }

  /** Whether the stop is pressed anywhere. */
  stops(sources) {
    return sources.some(({ gamepad, stop }) => stop || stopButtons(gamepad)) || gamepadsStop();
  }

  /** {source, forward, turn} while somebody holds on, else null: what drove before goes on. */
  drive(sources, facing) {
    const read = [];
    for (const source of sources) {
      const hand = source.kind === "hand";
      if (!(hand ? source.joints : source.gamepad)) continue; // of what is not seen it is not known whether it holds on
      const drive = hand ? this.#byHand(source, facing) : stickDrive(source.gamepad);
      read.push({ source: source.name, kind: source.kind, drive, open: !drive && !(hand && source.pressed) });
    }
    const held = this.#opened.held([...read, ...readGamepads()]);
    if (this.pad.sample) held.push(this.pad.sample);
    const chosen = held.find(({ source }) => source === this.#source) ?? held[0] ?? null;
    this.#source = chosen?.source ?? null;
    return chosen;
  }

  /** Whatever is held has to be let go of, and that be seen, before it counts. */
  letGo() {
    this.#opened.clear();
    this.#begun = { left: null, right: null };
    this.#source = null;
    this.pad.release();
  }

  /** The poses and buttons of a frame, as fields of ROS messages without headers; only those in `wanted`. */
  poses(frame, space, sources, wanted) {
    const found = {};
    if (wanted.has("head")) {
      const viewer = frame.getViewerPose(space);
      if (viewer) found.head = { pose: pose(viewer.transform) };
    }
    const of = (name, kind) => sources.find((each) => each.name === name && each.kind === kind);
    for (const name of ["left", "right"]) {
      const source = of(name, "controller") ?? of(name, "hand");
      if (wanted.has(name) && source?.grip) found[name] = { pose: pose(source.grip) };
      const hand = of(name, "hand");
      if (wanted.has(`${name}Hand`) && hand?.poses) found[`${name}Hand`] = { poses: hand.poses.map(pose) };
    }
    if (wanted.has("joy")) found.joy = joy(of("left", "controller")?.gamepad, of("right", "controller")?.gamepad);
    return found;
  }

  #readController(source, frame, space, { gripSpace, gamepad }) {
    source.gamepad = gamepad;
    source.grip = gripSpace ? frame.getPose(gripSpace, space)?.transform : null;
    source.pressed = Boolean(gamepad?.buttons[0]?.pressed);
  }

  #readHand(source, frame, space, hand) {
    const joints = {};
    source.poses = [];
    for (const [name, jointSpace] of hand) {
      const joint = frame.getJointPose(jointSpace, space);
      if (!joint) continue;
      const { position } = joint.transform;
      joints[name] = { x: position.x, y: position.y, z: position.z, radius: joint.radius };
      source.poses.push(joint.transform);
      if (name === WRIST) source.grip = joint.transform;
    }
    const seen = Object.keys(joints).length > 0;
    source.joints = seen ? joints : null;
    source.pressed = this.#pinching[source.name] = seen && pinched(joints, this.#pinching[source.name]);
    source.stop = this.#stopping[source.name] = seen && stopHand(joints, this.#stopping[source.name]);
  }

  #byHand(source, facing) {
    const { name, joints, pressed, taken } = source;
    if (!pressed || !joints || taken || name !== this.settings.get("hand")) {
      this.#begun[name] = null;
      return null;
    }
    const at = pinchPoint(joints);
    this.#begun[name] ??= { at, facing };
    return handDrive(this.#begun[name].at, at, this.#begun[name].facing);
  }
}

function rayOf({ position, orientation: q }) {
  const origin = new Vector3(position.x, position.y, position.z);
  const direction = new Vector3(0, 0, -1).applyQuaternion({ x: q.x, y: q.y, z: q.z, w: q.w });
  return { origin, direction };
}
