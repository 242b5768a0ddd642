/**
 * The world as a model on a round table: the robot in its middle, where it was, what its laser and cameras measured, the map,
 * frames and joints. Its axes are those of ROS, seen from behind the robot's x axis; its scale is a setting, up to life-size.
 */

import {
  BoxGeometry,
  BufferAttribute,
  BufferGeometry,
  CircleGeometry,
  Color,
  ConeGeometry,
  CylinderGeometry,
  DataTexture,
  DynamicDrawUsage,
  Group,
  Line,
  LineSegments,
  LinearFilter,
  Mesh,
  MeshBasicMaterial,
  MeshStandardMaterial,
  NearestFilter,
  PlaneGeometry,
  Points,
  SRGBColorSpace,
  ShaderMaterial,
  TorusGeometry,
} from "../vendor/three.js";
import { heading, toScene } from "./axes.js";
import { joined } from "./joined.js";

export const TABLE = { radius: 0.46, height: 0.86, away: 0.95 };
const TRAIL_POINTS = 4000;
const TRAIL_STEP_M = 0.02;
const FRAMES = 128;
const BASES = ["base_link", "base_footprint"];
const LEAST_ROBOT = 0.055;
const EDGE_M = TABLE.radius + 0.05;

/** What is drawn on the table ends at its edge: `reach` is that, in metres of the model. */
function edged({ points = false, colours = false, map = null, colour = 0xffffff, opacity = 1, size = 4 }, reach) {
  return new ShaderMaterial({
    uniforms: { reach, size: { value: size }, colour: { value: new Color(colour) }, opacity: { value: opacity }, map: { value: map } },
    vertexColors: colours,
    transparent: true,
    depthWrite: !map,
    vertexShader: `
      uniform float size; varying vec3 at; varying vec3 tint; varying vec2 where;
      void main() {
        vec4 world = modelMatrix * vec4(position, 1.0);
        at = world.xyz;
        tint = ${colours ? "color.rgb" : "vec3(1.0)"};
        where = uv;
        gl_Position = projectionMatrix * viewMatrix * world;
        ${points ? "gl_PointSize = clamp(size / gl_Position.w, 1.5, 9.0);" : ""}
      }`,
    fragmentShader: `
      uniform vec4 reach; uniform vec3 colour; uniform float opacity; uniform sampler2D map;
      varying vec3 at; varying vec3 tint; varying vec2 where;
      void main() {
        float off = length(at.xz - reach.xy) / reach.z;
        if (off > 1.0) discard;
        ${points ? "if (length(gl_PointCoord - 0.5) > 0.5) discard;" : ""}
        vec4 found = ${map ? "texture2D(map, where)" : "vec4(colour * tint, 1.0)"};
        gl_FragColor = vec4(found.rgb, found.a * opacity * (1.0 - smoothstep(0.88, 1.0, off)));
        #include <colorspace_fragment>
      }`,
  });
}

export class Model {
  /** What is shown: names of layers. */
  #shown = new Set();
  #trail = { count: 0, positions: new Float32Array(3 * TRAIL_POINTS) };

  constructor() {
    this.group = new Group();
    this.reach = { value: { x: 0, y: -TABLE.away, z: TABLE.radius, w: 0 } };
    this.table = table();
    this.world = new Group(); // the world's origin, in metres
    this.robot = robot();
    this.atRobot = new Group(); // the robot's place in the world
    this.world.add(this.atRobot);
    this.group.add(this.table, this.world, this.robot);
    this.pose = null;
    this.trail = new Line(new BufferGeometry(), edged({ colour: 0x5cadff }, this.reach));
    this.trail.geometry.setAttribute("position", new BufferAttribute(this.#trail.positions, 3).setUsage(DynamicDrawUsage));
    this.scan = new Points(new BufferGeometry(), edged({ points: true, colour: 0xff8a5c, size: 4.5 }, this.reach));
    this.cloud = new Points(new BufferGeometry(), edged({ points: true, colours: true, size: 3 }, this.reach));
    this.frames = new LineSegments(new BufferGeometry(), edged({ colours: true }, this.reach));
    this.joints = new Joints();
    this.world.add(this.trail, this.scan, this.cloud, this.frames);
    this.group.add(this.joints.group);
    for (const each of [this.trail, this.scan, this.cloud, this.frames]) {
      each.frustumCulled = false;
      each.visible = false;
    }
    this.setScale(0.1);
    this.place({ x: 0, y: 0, z: 0 }, 0);
  }

  setLayers(names) {
    this.#shown = new Set(names);
    for (const name of ["trail", "scan", "cloud", "frames"]) this[name].visible = this.#shown.has(name) && Boolean(this[name].userData.has);
    if (this.map) this.map.visible = this.#shown.has("map");
    this.joints.group.visible = this.#shown.has("joints");
  }

  /** 1 is life-size: then it is on the floor, as far as one can see. */
  setScale(scale) {
    this.scale = scale;
    const real = scale >= 0.99;
    this.table.visible = !real;
    this.group.position.set(0, real ? 0.01 : TABLE.height, real ? -2 : -TABLE.away);
    Object.assign(this.reach.value, { x: 0, y: this.group.position.z, z: real ? 30 : TABLE.radius });
    this.world.scale.setScalar(scale);
    this.joints.group.visible &&= !real;
    if (this.pose) this.place(this.pose.position, this.pose.heading);
    this.robot.scale.setScalar(Math.max(0.5 * scale, real ? 0.5 : LEAST_ROBOT));
  }

  /** The robot is there in its world; the model turns about it, with x away from who looks. */
  place(position, heading) {
    const [x, y, z] = toScene(position);
    this.world.position.set(-x * this.scale, -y * this.scale, -z * this.scale);
    this.atRobot.position.set(x, y, z);
    this.atRobot.rotation.set(0, heading, 0);
    this.robot.rotation.set(0, heading, 0);
  }

  /** What came of a robot, by how it is shown. */
  take(shown, value) {
    if (shown === "pose" && value.pose) {
      this.fromPose = true;
      this.#pose(value.pose);
    }
    if (shown === "scan" || shown === "cloud") this.#points(this[shown], shown, value);
    else if (shown === "map") this.#map(value);
    else if (shown === "frames") this.#frames(value.frames);
    else if (shown === "joints") this.joints.set(value.joints);
    this.setLayers([...this.#shown]);
  }

  /** Of another robot nothing is known yet. */
  clear() {
    this.#trail.count = 0;
    for (const name of ["trail", "scan", "cloud", "frames"]) {
      this[name].userData.has = false;
      this[name].geometry.setDrawRange(0, 0);
    }
    this.#dropMap(this.map);
    this.map = null;
    this.pose = null;
    this.fromPose = false;
    this.joints.set([]);
    this.setLayers([...this.#shown]);
  }

  #pose(pose) {
    this.pose = pose;
    this.place(pose.position, pose.heading);
    const kept = this.#trail;
    const [x, y, z] = toScene(pose.position);
    const last = 3 * ((kept.count - 1) % TRAIL_POINTS);
    if (kept.count && Math.hypot(x - kept.positions[last], z - kept.positions[last + 2]) < TRAIL_STEP_M) return;
    if (kept.count === TRAIL_POINTS) {
      kept.positions.copyWithin(0, 3 * (TRAIL_POINTS / 2)); // the older half is forgotten
      kept.count = TRAIL_POINTS / 2;
    }
    kept.positions.set([x, y + 0.01, z], 3 * kept.count);
    kept.count += 1;
    this.trail.geometry.attributes.position.needsUpdate = true;
    this.trail.geometry.setDrawRange(0, kept.count);
    this.trail.userData.has = kept.count > 1;
  }

  #points(object, name, { points, colours, place }) {
    fill(object.geometry, "position", points, 3);
    if (colours) fill(object.geometry, "color", colours, 3, true);
    object.geometry.setDrawRange(0, points.length / 3);
    object.userData.has = true;
    // where its frame is told, there; else it is on the robot
    const parent = place ? this.world : this.atRobot;
    if (object.parent !== parent) parent.add(object);
    setPlace(object, place);
  }

  #map({ pixels, width, height, size, origin }) {
    const before = this.map;
    const texture = new DataTexture(pixels, width, height);
    texture.colorSpace = SRGBColorSpace;
    texture.magFilter = NearestFilter;
    texture.minFilter = LinearFilter;
    texture.needsUpdate = true;
    const geometry = new PlaneGeometry(size[0], size[1]);
    geometry.translate(size[0] / 2, size[1] / 2, 0);
    const { array } = geometry.attributes.position;
    for (let at = 0; at < array.length; at += 3) array.set([-array[at + 1], -0.02, -array[at]], at);
    this.map = new Mesh(geometry, edged({ map: texture }, this.reach));
    this.map.material.side = 2;
    setPlace(this.map, origin);
    this.map.renderOrder = -0.5;
    this.world.add(this.map);
    this.#dropMap(before);
  }

  /** The graphics card keeps what is not given back. */
  #dropMap(map) {
    map?.removeFromParent();
    map?.geometry.dispose();
    map?.material.uniforms.map.value.dispose();
    map?.material.dispose();
  }

  #frames(frames) {
    const some = frames.slice(0, FRAMES);
    const points = new Float32Array(some.length * 18);
    const colours = new Uint8Array(some.length * 18);
    some.forEach(({ position, orientation: q }, each) => {
      const { x, y, z } = position;
      const long = 0.25;
      [
        [1 - 2 * (q.y * q.y + q.z * q.z), 2 * (q.x * q.y + q.w * q.z), 2 * (q.x * q.z - q.w * q.y)],
        [2 * (q.x * q.y - q.w * q.z), 1 - 2 * (q.x * q.x + q.z * q.z), 2 * (q.y * q.z + q.w * q.x)],
        [2 * (q.x * q.z + q.w * q.y), 2 * (q.y * q.z - q.w * q.x), 1 - 2 * (q.x * q.x + q.y * q.y)],
      ].forEach(([dx, dy, dz], axis) => {
        const at = each * 18 + axis * 6;
        points.set([...toScene(position), ...toScene({ x: x + long * dx, y: y + long * dy, z: z + long * dz })], at);
        for (const end of [at, at + 3]) colours.set([[255, 90, 80], [90, 220, 120], [90, 160, 255]][axis], end);
      });
    });
    fill(this.frames.geometry, "position", points, 3);
    fill(this.frames.geometry, "color", colours, 3, true);
    this.frames.geometry.setDrawRange(0, points.length / 3);
    this.frames.userData.has = some.length > 0;
    // who tells his place by no topic of its own tells it so
    const base = this.fromPose ? null : frames.find(({ name }) => BASES.includes(name));
    if (base) this.#pose({ ...base, heading: heading(base.orientation) });
  }
}

/** A dial for each joint, about the table's edge: its needle shows the angle. */
class Joints {
  #dials = [];

  constructor() {
    this.group = new Group();
    this.ring = new TorusGeometry(0.026, 0.003, 8, 28);
    this.needle = new BoxGeometry(0.004, 0.024, 0.004).translate(0, 0.012, 0);
    this.dark = new MeshBasicMaterial({ color: 0x34506e });
    this.light = new MeshBasicMaterial({ color: 0xf2c94c });
  }

  set(joints) {
    const some = joints.slice(0, 16);
    while (this.#dials.length > some.length) this.#dials.pop().group.removeFromParent();
    while (this.#dials.length < some.length) this.#dials.push(this.#dial());
    some.forEach(({ position }, at) => {
      const { group, needle } = this.#dials[at];
      const angle = (at - (some.length - 1) / 2) * 0.15;
      group.position.set(Math.sin(angle) * EDGE_M, 0.04, Math.cos(angle) * EDGE_M);
      group.rotation.set(-0.7, angle, 0, "YXZ");
      needle.rotation.set(0, 0, position);
    });
  }

  #dial() {
    const group = new Group();
    const needle = new Mesh(this.needle, this.light);
    group.add(new Mesh(this.ring, this.dark), needle);
    this.group.add(group);
    return { group, needle };
  }
}

/** Room is made once and used again. */
function fill(geometry, name, values, size, normalized = false) {
  const had = geometry.getAttribute(name);
  if (had && had.array.length >= values.length && had.array.constructor === values.constructor) {
    had.array.set(values);
    had.clearUpdateRanges();
    had.addUpdateRange(0, values.length);
    had.needsUpdate = true;
    return;
  }
  if (had) geometry.dispose(); // the larger one is another one
  const room = new values.constructor(size * Math.max(256, Math.ceil((values.length / size) * 1.25))); // whole points only
  room.set(values);
  geometry.setAttribute(name, new BufferAttribute(room, size, normalized).setUsage(DynamicDrawUsage));
}

function setPlace(object, place) {
  if (!place) {
    object.position.set(0, 0, 0);
    object.quaternion.set(0, 0, 0, 1);
    return;
  }
  const { orientation: q } = place;
  object.position.set(...toScene(place.position));
  object.quaternion.set(-q.y, q.z, -q.x, q.w);
}

function table() {
  const group = new Group();
  const top = new Mesh(
    new CircleGeometry(TABLE.radius, 64),
    new MeshBasicMaterial({ color: 0x0d151f, transparent: true, opacity: 0.92 }),
  );
  top.rotation.x = -Math.PI / 2;
  top.position.y = -0.012;
  top.renderOrder = -1;
  const rim = new Mesh(new TorusGeometry(TABLE.radius, 0.006, 12, 96), new MeshBasicMaterial({ color: 0x5cadff }));
  rim.rotation.x = Math.PI / 2;
  rim.position.y = -0.008;
  const metal = new MeshStandardMaterial({ color: 0x22303f, roughness: 0.5, metalness: 0.3 });
  const foot = new Mesh(new CylinderGeometry(0.05, 0.14, TABLE.height - 0.03, 32), metal);
  foot.position.y = -TABLE.height / 2 - 0.01;
  const dim = new MeshBasicMaterial({ color: 0x2c4159 });
  const rings = [0.25, 0.5, 0.75].map((part) => {
    const ring = new Mesh(new TorusGeometry(TABLE.radius * part, 0.0012, 6, 80), dim);
    ring.rotation.x = Math.PI / 2;
    ring.position.y = -0.009;
    return ring;
  });
  group.add(top, rim, foot, joined(...rings));
  return group;
}

/** A robot about one unit long that looks along -z, which is ROS' x. */
function robot() {
  const group = new Group();
  const body = new MeshStandardMaterial({ color: 0xe8edf3, roughness: 0.45 });
  const dark = new MeshStandardMaterial({ color: 0x27323f, roughness: 0.7 });
  const blue = new MeshBasicMaterial({ color: 0x5cadff });
  const hull = new Mesh(new BoxGeometry(0.62, 0.22, 0.86), body);
  hull.position.y = 0.26;
  const head = new Mesh(new BoxGeometry(0.34, 0.16, 0.3), dark);
  head.position.set(0, 0.45, -0.16);
  const eyes = new Mesh(new BoxGeometry(0.24, 0.05, 0.02), blue);
  eyes.position.set(0, 0.46, -0.32);
  const nose = new Mesh(new ConeGeometry(0.12, 0.3, 4), blue);
  nose.rotation.set(-Math.PI / 2, Math.PI / 4, 0, "XYZ");
  nose.position.set(0, 0.3, -0.58);
  const wheel = new CylinderGeometry(0.16, 0.16, 0.1, 24).rotateZ(Math.PI / 2);
  const wheels = [[-0.36, -0.28], [0.36, -0.28], [-0.36, 0.28], [0.36, 0.28]].map(([x, z]) => {
    const each = new Mesh(wheel, dark);
    each.position.set(x, 0.16, z);
    return each;
  });
  group.add(hull, joined(head, ...wheels), joined(eyes, nose));
  return group;
}
