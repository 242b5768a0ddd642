/**
 * What buttons and fingers mean. Pure: values of WebXR's input sources in, meanings out.
 *
 * Buttons are those of the mapping `xr-standard`: 0 trigger, 1 grip, 3 the stick's, 4 A or X, 5 B or Y; axes 2 and 3 are
 * the stick's. Joints are positions in metres.
 */

import { deflection } from "../shared/gamepads.js";

const PINCH_M = 0.02;
/** Wider than it began with: a pinch at the edge does not flutter. */
const UNPINCH_M = 0.035;
/** A hand that moves so far from where it pinched drives at full speed. */
export const REACH_M = 0.15;
const REST_M = 0.02;

const apart = (one, other) => Math.hypot(one.x - other.x, one.y - other.y, one.z - other.z);

/** {forward, turn} of a controller's stick while its grip is held, else null. */
export function stickDrive(gamepad) {
  if (!gamepad?.buttons[1]?.pressed) return null;
  const at = gamepad.axes.length >= 4 ? 2 : 0;
  return { forward: deflection(-gamepad.axes[at + 1]), turn: deflection(-gamepad.axes[at]) };
}

/** Both face buttons of one controller: the stop, by one thumb. */
export function stopButtons(gamepad) {
  return Boolean(gamepad?.buttons[4]?.pressed && gamepad.buttons[5]?.pressed);
}

/** Whether thumb and index finger are together, where they were before. */
export function pinched(joints, before = false) {
  const thumb = joints?.["thumb-tip"];
  const index = joints?.["index-finger-tip"];
  return Boolean(thumb && index && apart(thumb, index) < (before ? UNPINCH_M : PINCH_M));
}

/** The stop of a hand: thumb and little finger together, the index finger apart. */
export function stopHand(joints, before = false) {
  const thumb = joints?.["thumb-tip"];
  const little = joints?.["pinky-finger-tip"];
  const index = joints?.["index-finger-tip"];
  if (!thumb || !little || !index) return false;
  return apart(thumb, little) < (before ? UNPINCH_M : PINCH_M) && apart(thumb, index) > UNPINCH_M;
}

/** Where a pinch is: between the two tips. */
export function pinchPoint(joints) {
  const [one, other] = [joints["thumb-tip"], joints["index-finger-tip"]];
  return { x: (one.x + other.x) / 2, y: (one.y + other.y) / 2, z: (one.z + other.z) / 2 };
}

/**
 * {forward, turn} of a hand that pinched at `from` and is at `to` now, for a head that looked to `facing` then (radians to
 * the left of -z, about y).
 */
export function handDrive(from, to, facing) {
  const [dx, dz] = [to.x - from.x, to.z - from.z];
  const forward = -dz * Math.cos(facing) - dx * Math.sin(facing);
  const left = dz * Math.sin(facing) - dx * Math.cos(facing);
  const part = (metres) => deflection(metres / REACH_M, REST_M / REACH_M);
  return { forward: Math.max(-1, Math.min(1, part(forward))), turn: Math.max(-1, Math.min(1, part(left))) };
}

/** sensor_msgs/Joy of both controllers: axes left x, left y, right x, right y, triggers, grips; then the buttons. */
export function joy(left, right) {
  const axes = [];
  const buttons = [];
  for (const gamepad of [left, right]) {
    const at = gamepad && gamepad.axes.length >= 4 ? 2 : 0;
    axes.push(-(gamepad?.axes[at] ?? 0) || 0, -(gamepad?.axes[at + 1] ?? 0) || 0);
    for (let each = 0; each < 6; each++) buttons.push(gamepad?.buttons[each]?.pressed ? 1 : 0);
  }
  for (const button of [0, 1]) for (const gamepad of [left, right]) axes.push(gamepad?.buttons[button]?.value ?? 0);
  return { axes, buttons };
}
