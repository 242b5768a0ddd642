/**
 * ROS messages to what a scene draws: positions in the scene's axes, pixels, few numbers. Pure, and bounded whatever comes.
 */

import { heading } from "./axes.js";

const MAP_CELLS = 1024;
const SCAN_POINTS = 4000;
const JOINTS = 64;
const FRAMES = 256;
const DEPTH = 64;
/** How numbers of PointField are read, and how long they are, by their number there. */
const FIELDS = ["", "getInt8", "getUint8", "getInt16", "getUint16", "getInt32", "getUint32", "getFloat32", "getFloat64"];
const SIZES = [0, 1, 1, 2, 2, 4, 4, 4, 8];

/** A time in ms; 0 where the message has none. */
export function stampMs(message) {
  const { sec = 0, nanosec = 0 } = message.header?.stamp ?? {};
  return sec * 1000 + nanosec / 1e6;
}

/** LaserScan → {points}: x, y, z of the scene, one after the other. */
export function scan(message) {
  const { ranges, angle_min: first, angle_increment: step, range_min: least, range_max: most } = message;
  const every = Math.max(1, Math.ceil(ranges.length / SCAN_POINTS));
  const points = new Float32Array(3 * Math.ceil(ranges.length / every));
  let at = 0;
  for (let each = 0; each < ranges.length; each += every) {
    const range = ranges[each];
    if (!(range >= least && range <= most)) continue;
    const angle = first + each * step;
    points[at++] = -range * Math.sin(angle);
    points[at++] = 0;
    points[at++] = -range * Math.cos(angle);
  }
  return { points: points.slice(0, at) };
}

/** PointCloud2 → {points, colours, total}: at most `most` points, taken evenly. Throws Error where it makes no sense. */
export function cloud(message, most) {
  const { width, height, point_step: step, row_step: row, data, is_bigendian: big, fields } = message;
  const total = width * height;
  const named = (name) => fields.find((field) => field.name === name && FIELDS[field.datatype]);
  const axes = ["x", "y", "z"].map(named);
  if (axes.some((field) => !field)) throw new Error("a point cloud without x, y and z");
  const colour = fields.find((field) => ["rgb", "rgba"].includes(field.name));
  const reach = Math.max(...axes.map((field) => field.offset + SIZES[field.datatype]), colour ? colour.offset + 4 : 0);
  if (!step || reach > step || row < width * step || data.length < (height - 1) * row + width * step) {
    if (total) throw new Error("a point cloud that is shorter than it says");
  }
  const view = new DataView(data.buffer, data.byteOffset, data.byteLength);
  const every = Math.max(1, Math.ceil(total / Math.max(1, most)));
  const points = new Float32Array(3 * Math.ceil(total / every));
  const colours = new Uint8Array(points.length);
  const readers = axes.map((field) => [FIELDS[field.datatype], field.offset]);
  let to = 0;
  for (let each = 0; most > 0 && each < total; each += every) {
    const at = Math.floor(each / width) * row + (each % width) * step;
    const [x, y, z] = readers.map(([read, offset]) => view[read](at + offset, !big));
    if (!Number.isFinite(x + y + z)) continue;
    points[to] = -y;
    points[to + 1] = z;
    points[to + 2] = -x;
    if (colour) {
      const packed = view.getUint32(at + colour.offset, !big);
      colours[to] = packed >> 16;
      colours[to + 1] = packed >> 8;
      colours[to + 2] = packed;
    } else {
      byHeight(colours, to, z);
    }
    to += 3;
  }
  return { points: points.slice(0, to), colours: colours.slice(0, to), total };
}

/** Low is blue, high is warm: from -0.5 to 2.5 m. */
function byHeight(colours, at, z) {
  const part = Math.max(0, Math.min(1, (z + 0.5) / 3));
  colours[at] = 70 + 170 * part;
  colours[at + 1] = 150 + 60 * (1 - Math.abs(2 * part - 1));
  colours[at + 2] = 240 - 170 * part;
}

/** OccupancyGrid → {pixels, width, height, size, origin}: red, green, blue and opacity, the first row at the origin. */
export function map(message) {
  const { width, height, resolution, origin } = message.info;
  if (!(width * height > 0) || message.data.length < width * height) throw new Error("a map that is shorter than it says");
  const every = Math.max(1, Math.ceil(Math.max(width, height) / MAP_CELLS));
  const [across, up] = [Math.ceil(width / every), Math.ceil(height / every)];
  const pixels = new Uint8Array(across * up * 4);
  let to = 0;
  for (let y = 0; y < height; y += every) {
    for (let x = 0; x < width; x += every, to += 4) {
      const value = message.data[y * width + x];
      const full = value < 0 ? 0 : Math.min(100, value) / 100;
      pixels[to] = 60 + 170 * full;
      pixels[to + 1] = 78 + 110 * full;
      pixels[to + 2] = 110 + 20 * full;
      pixels[to + 3] = value < 0 ? 0 : 70 + 185 * full;
    }
  }
  return { pixels, width: across, height: up, size: [width * resolution, height * resolution], origin };
}

/** JointState → [{name, position}], the first 64. */
export function joints({ name, position }) {
  return name.slice(0, JOINTS).map((each, at) => ({ name: each.slice(0, 64), position: position[at] ?? 0 }));
}

/** The pose in a message of one of these types; null where it has none. */
export function poseOf(message) {
  const pose = message.pose?.pose ?? message.pose;
  return pose?.position ? { ...pose, heading: heading(pose.orientation), frame: message.header?.frame_id ?? "" } : null;
}

/** A quaternion after another one. */
function times(a, b) {
  return {
    x: a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
    y: a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x,
    z: a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w,
    w: a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z,
  };
}

function turned(q, { x, y, z }) {
  const tx = 2 * (q.y * z - q.z * y);
  const ty = 2 * (q.z * x - q.x * z);
  const tz = 2 * (q.x * y - q.y * x);
  return {
    x: x + q.w * tx + q.y * tz - q.z * ty,
    y: y + q.w * ty + q.z * tx - q.x * tz,
    z: z + q.w * tz + q.x * ty - q.y * tx,
  };
}

/** Where frames are, as /tf and /tf_static tell it. Loops and endless chains have no place. */
export class Frames {
  #parents = new Map();

  take({ transforms }) {
    for (const { header, child_frame_id: child, transform } of transforms.slice(0, FRAMES)) {
      if (this.#parents.size >= FRAMES && !this.#parents.has(child)) continue;
      this.#parents.set(child, { parent: header.frame_id, position: transform.translation, orientation: transform.rotation });
    }
  }

  get names() {
    return [...this.#parents.keys()];
  }

  /** {position, orientation, root} of a frame in the one that has no parent; null for one that is not told of. */
  place(name) {
    let position = { x: 0, y: 0, z: 0 };
    let orientation = { x: 0, y: 0, z: 0, w: 1 };
    let at = name;
    for (let steps = 0; steps < DEPTH; steps++) {
      const above = this.#parents.get(at);
      if (above === undefined) return steps || name === at && this.#isRoot(at) ? { position, orientation, root: at } : null;
      const there = turned(above.orientation, position);
      position = { x: there.x + above.position.x, y: there.y + above.position.y, z: there.z + above.position.z };
      orientation = times(above.orientation, orientation);
      at = above.parent;
    }
    return null;
  }

  /** All frames with their places, for who draws them. */
  all() {
    const found = [];
    for (const name of this.#parents.keys()) {
      const place = this.place(name);
      if (place) found.push({ name: name.slice(0, 64), ...place });
    }
    return found;
  }

  #isRoot(name) {
    return [...this.#parents.values()].some(({ parent }) => parent === name);
  }
}
