/** Types of velocities, and the time in their headers. Pure. */

/** Seconds and nanoseconds of a time in ms since 1970. */
export function stamp(ms) {
  const sec = Math.floor(ms / 1000);
  return { sec, nanosec: Math.min(999999999, Math.floor((ms - sec * 1000) * 1e6)) };
}

/**
 * When something was done that was done at `at` of performance.now(), in ms since 1970 by the clock on the wall, as it is now. What
 * performance.timeOrigin has was so when the page began: it follows no step of that clock, and no machine that slept. But Date.now()
 * has whole milliseconds, cut off: within that one the other clock says where.
 */
export function wallTime(at, now = performance.now(), wall = Date.now(), began = performance.timeOrigin) {
  return Math.min(Math.max(began + now, wall), wall + 1) - (now - at);
}

/** Type → a message of it; `ms` is its time since 1970. */
export const TWIST = {
  "geometry_msgs/msg/Twist": (linear, angular) => ({ linear, angular }),
  "geometry_msgs/msg/TwistStamped": (linear, angular, ms) => ({
    header: { stamp: stamp(ms), frame_id: "base_link" },
    twist: { linear, angular },
  }),
};
