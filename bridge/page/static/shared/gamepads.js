/** Gamepads that are no part of a headset: what they say, read again and again. */

export const DEAD_ZONE = 0.1;
const CLUTCH_BUTTONS = [4, 5, 6, 7];

/** A stick's deflection without what it has at rest, from -1 to 1. */
export function deflection(value, dead = DEAD_ZONE) {
  const size = Math.abs(value);
  return size <= dead || !Number.isFinite(value) ? 0 : (Math.sign(value) * Math.min(1, size - dead)) / (1 - dead);
}

/** {forward, turn} of a gamepad's left stick while a shoulder button is held, else null. */
export function gamepadDrive(gamepad) {
  if (!gamepad || !CLUTCH_BUTTONS.some((button) => gamepad.buttons[button]?.pressed)) return null;
  return { forward: deflection(-gamepad.axes[1]), turn: deflection(-gamepad.axes[0]) };
}

/** The stop of a gamepad: its two lower face buttons, A and B, by one thumb. */
function stopGamepad(gamepad) {
  return Boolean(gamepad?.buttons[0]?.pressed && gamepad.buttons[1]?.pressed);
}

/** Whether the stop is held at any of them. */
export function gamepadsStop() {
  return gamepads().some(stopGamepad);
}

function gamepads() {
  return [...(navigator.getGamepads?.() ?? [])].filter((each) => each?.connected && each.mapping !== "xr-standard");
}

/** What each of them does, as `Opened` has it. */
export function readGamepads() {
  return gamepads().map((each) => {
    const drive = gamepadDrive(each);
    return { source: `gamepad ${each.index}`, kind: "gamepad", drive, open: !drive };
  });
}
