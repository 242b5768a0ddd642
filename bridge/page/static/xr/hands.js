/** What is seen of who wears the headset: controllers, hands, the rays they point with, and where those end. */

import {
  BufferAttribute,
  BufferGeometry,
  CylinderGeometry,
  Group,
  InstancedMesh,
  Line,
  LineBasicMaterial,
  Matrix4,
  Mesh,
  MeshBasicMaterial,
  MeshStandardMaterial,
  SphereGeometry,
  TorusGeometry,
} from "../vendor/three.js";
import { joined } from "./joined.js";

const JOINTS = 25;
const RAY_M = 3;

class Hand {
  constructor(scene) {
    this.controller = controller();
    this.joints = new InstancedMesh(
      new SphereGeometry(1, 10, 8),
      new MeshStandardMaterial({ color: 0xc9d8ea, roughness: 0.6 }),
      JOINTS,
    );
    this.joints.frustumCulled = false;
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(new Float32Array([0, 0, 0, 0, 0, -1]), 3));
    this.ray = new Line(geometry, new LineBasicMaterial({ color: 0x5cadff, transparent: true, opacity: 0.7 }));
    this.ray.frustumCulled = false;
    this.tip = new Mesh(new SphereGeometry(0.009, 12, 8), new MeshBasicMaterial({ color: 0xffffff }));
    this.matrix = new Matrix4();
    scene.add(this.controller, this.joints, this.ray, this.tip);
    this.hide();
  }

  hide() {
    for (const each of [this.controller, this.joints, this.ray, this.tip]) each.visible = false;
  }

  show(source, distance, driving) {
    this.controller.visible = source.kind === "controller" && Boolean(source.grip);
    if (this.controller.visible) {
      const { position: p, orientation: q } = source.grip;
      this.controller.position.set(p.x, p.y, p.z);
      this.controller.quaternion.set(q.x, q.y, q.z, q.w);
      this.controller.userData.ring.material.color.set(driving ? 0x4cc38a : 0x5cadff);
    }
    this.#showJoints(source.joints);
    this.ray.visible = Boolean(source.ray) && source.kind !== "mouse";
    this.tip.visible = this.ray.visible && distance !== null;
    if (!this.ray.visible) return;
    const { origin, direction } = source.ray;
    const length = distance ?? RAY_M;
    const end = origin.clone().addScaledVector(direction, length);
    const { array } = this.ray.geometry.attributes.position;
    array.set([origin.x, origin.y, origin.z, end.x, end.y, end.z]);
    this.ray.geometry.attributes.position.needsUpdate = true;
    this.ray.material.opacity = distance === null ? 0.25 : 0.8;
    this.tip.position.copy(end);
  }

  #showJoints(joints) {
    this.joints.visible = Boolean(joints);
    if (!joints) return;
    let at = 0;
    for (const joint of Object.values(joints)) {
      if (at === JOINTS) break;
      const size = Math.min(0.011, joint.radius || 0.008);
      this.matrix.makeScale(size, size, size).setPosition(joint.x, joint.y, joint.z);
      this.joints.setMatrixAt(at++, this.matrix);
    }
    this.joints.count = at;
    this.joints.instanceMatrix.needsUpdate = true;
  }
}

export class Hands {
  constructor(scene) {
    this.hands = { left: new Hand(scene), right: new Hand(scene) };
  }

  /** `sources` as `Input` gives them, with how far each ray reaches; `driving` is the hand that drives. */
  show(sources, distances, driving) {
    for (const [name, hand] of Object.entries(this.hands)) {
      const source = sources.find((each) => each.name === name);
      if (source) hand.show(source, distances.get(name) ?? null, driving === name);
      else hand.hide();
    }
  }
}

function controller() {
  const group = new Group();
  const dark = new MeshStandardMaterial({ color: 0x2a3440, roughness: 0.5 });
  const handle = new Mesh(new CylinderGeometry(0.016, 0.02, 0.1, 20), dark);
  handle.rotation.x = Math.PI / 2 - 0.2;
  handle.position.set(0, -0.008, 0.03);
  const head = new Mesh(new SphereGeometry(0.026, 20, 14), dark);
  head.scale.set(1, 0.62, 1.15);
  head.position.set(0, 0.008, -0.03);
  const ring = new Mesh(new TorusGeometry(0.021, 0.0025, 8, 32), new MeshBasicMaterial({ color: 0x5cadff }));
  ring.rotation.x = Math.PI / 2 - 0.25;
  ring.position.set(0, 0.022, -0.03);
  group.userData.ring = ring;
  group.add(joined(handle, head), ring);
  return group;
}
