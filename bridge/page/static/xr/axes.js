/**
 * From WebXR's axes to those of ROS and back (REP 103). Pure.
 *
 * WebXR: x to the right, y up, z towards who looks. ROS: x forward, y to the left, z up. Both are right-handed, in metres;
 * quaternions are x, y, z, w. The frame's origin is the floor below where the session began, x forward from there.
 */

/** {x, y, z} of ROS for one of WebXR. */
export function position({ x, y, z }) {
  return { x: -z || 0, y: -x || 0, z: y };
}

/** {x, y, z, w} of ROS for one of WebXR: its axis turns as a position does. */
export function orientation({ x, y, z, w }) {
  return { x: -z || 0, y: -x || 0, z: y, w };
}

/** geometry_msgs/Pose of a WebXR rigid transform, or of anything with `position` and `orientation`. */
export function pose(transform) {
  return { position: position(transform.position), orientation: orientation(transform.orientation) };
}

/** A position of ROS as [x, y, z] of WebXR, which are also those of three. */
export function toScene({ x, y, z }) {
  return [-y, z, -x];
}

/** Turned about the vertical axis: how far a ROS orientation looks to the left of x, in radians. */
export function heading({ x, y, z, w }) {
  return Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z));
}
