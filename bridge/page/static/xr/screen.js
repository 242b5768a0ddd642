/** A camera's panel: its newest picture, on a bent screen that can be grabbed, with what there is to say of it below. */

import { DataTexture, Group, LinearFilter, Mesh, MeshBasicMaterial, SRGBColorSpace, Texture } from "../vendor/three.js";
import { COLOURS } from "./stage.js";
import { FONT, Sheet, bent, fitted, roundRect, wrapped } from "./surface.js";

/** Wider pictures are of two eyes, side by side. */
const STEREO_RATIO = 2.5;
const CAPTION_M = 0.075;
const EDGE_M = 0.018;
const LEAST_SCALE = 0.3;
const MOST_SCALE = 4;
/** The colour of a panel before its first picture. */
const EMPTY = 0x05070a;

export class Screen {
  constructor(key, { topic, width = 1.3, curve = 0.35 }) {
    this.key = key;
    this.topic = topic;
    this.width = width;
    this.curve = curve;
    this.ratio = 4 / 3;
    this.stereo = "auto";
    this.two = false;
    /** Pictures that were shown. */
    this.shown = 0;
    this.picture = null;
    this.group = new Group();
    this.group.userData.grabs = this;
    this.material = new MeshBasicMaterial({ color: EMPTY, toneMapped: false });
    this.rightMaterial = new MeshBasicMaterial({ color: EMPTY, toneMapped: false });
    this.left = new Mesh(undefined, this.material);
    this.right = new Mesh(undefined, this.rightMaterial);
    this.frame = new Mesh(undefined, new MeshBasicMaterial({ color: 0x1a2430, toneMapped: false }));
    this.group.add(this.left, this.right, this.frame);
    this.#build();
  }

  get height() {
    return this.width / this.ratio;
  }

  /**
   * A new picture, a bitmap or {data, width, height, close()}, that is this panel's from now on. `eye` is where it goes when each eye has
   * its own topic.
   */
  show(picture, eye = "left") {
    const wide = this.stereo === "side-by-side" || (this.stereo === "auto" && picture.width / picture.height >= STEREO_RATIO);
    const two = this.other || (this.stereo !== "off" && wide);
    const ratio = picture.width / picture.height / (wide && two && !this.other ? 2 : 1);
    if (Math.abs(ratio - this.ratio) > 0.01 || two !== this.two) {
      this.ratio = ratio;
      this.two = two;
      this.#build();
    }
    this.#put(eye === "left" ? this.material : this.rightMaterial, picture);
    if (!this.other) this.rightMaterial.map = this.material.map;
    this.shown += 1;
    this.picture = { width: picture.width, height: picture.height };
  }

  /** Whether the right eye has a topic of its own. */
  setOther(other) {
    if (other === Boolean(this.other)) return;
    this.other = other;
    if (this.rightMaterial.map !== this.material.map) drop(this.rightMaterial.map);
    // each eye of two topics has a texture of its own: before its first picture, none
    this.rightMaterial.map = other ? null : this.material.map;
    this.rightMaterial.color.set(this.rightMaterial.map ? 0xffffff : EMPTY);
    this.rightMaterial.needsUpdate = true;
  }

  setCurve(curve) {
    this.curve = curve;
    this.#build();
  }

  /** Twice as large, say; within limits. */
  scaleBy(by) {
    const scale = Math.max(LEAST_SCALE, Math.min(MOST_SCALE, this.group.scale.x * by));
    this.group.scale.setScalar(scale);
  }

  /** What stands below: {figures, tone}, and over it when there is a problem: `veil`. */
  say({ figures, tone, veil }) {
    this.caption.say([this.topic, figures, tone], (context, width, height) => {
      context.fillStyle = COLOURS[tone];
      context.beginPath();
      context.arc(26, height / 2, 9, 0, 7);
      context.fill();
      context.textBaseline = "middle";
      context.font = `600 26px ${FONT}`;
      context.fillStyle = COLOURS.text;
      const name = fitted(context, this.topic, width * 0.55);
      context.fillText(name, 48, height / 2);
      context.font = `24px ${FONT}`;
      context.fillStyle = COLOURS.muted;
      context.textAlign = "right";
      context.fillText(fitted(context, figures, width * 0.42), width - 14, height / 2);
      context.textAlign = "left";
    });
    this.veil.mesh.visible = Boolean(veil);
    if (veil) this.veil.say(veil, (context, width, height) => drawVeil(context, width, height, veil));
  }

  dispose() {
    this.group.removeFromParent();
    for (const map of new Set([this.material.map, this.rightMaterial.map])) drop(map);
    for (const mesh of [this.left, this.right, this.frame]) {
      mesh.geometry.dispose();
      mesh.material.dispose();
    }
    this.caption.dispose();
    this.veil.dispose();
  }

  #put(material, picture) {
    let texture = material.map;
    const before = texture?.image;
    const same = before && before.width === picture.width && before.height === picture.height && !before.data === !picture.data;
    if (!same) {
      drop(texture);
      texture = picture.data ? new DataTexture() : new Texture();
      texture.colorSpace = SRGBColorSpace;
      texture.minFilter = texture.magFilter = LinearFilter;
      texture.generateMipmaps = false;
      texture.flipY = false; // the panel is turned, which costs nothing
      material.map = texture;
      material.color.set(0xffffff);
      if (!this.other) {
        this.rightMaterial.map = texture;
        this.rightMaterial.color.set(0xffffff);
      }
      this.material.needsUpdate = this.rightMaterial.needsUpdate = true;
    }
    texture.image = picture;
    texture.needsUpdate = true;
    if (same) before.close?.();
  }

  #build() {
    const { width, height, curve } = this;
    const half = this.two && !this.other;
    for (const [mesh, part, layer] of [
      [this.left, half ? [0, 0.5] : [0, 1], this.two ? 1 : 0],
      [this.right, half ? [0.5, 1] : [0, 1], 2],
    ]) {
      mesh.geometry?.dispose();
      mesh.geometry = bent(width, height, curve, { part, upright: false });
      mesh.layers.set(layer);
    }
    this.right.visible = Boolean(this.two);
    const framed = { whole: width, at: [0, -CAPTION_M / 2, -0.012] };
    this.frame.geometry?.dispose();
    this.frame.geometry = bent(width + 2 * EDGE_M, height + CAPTION_M + 2 * EDGE_M, curve, framed);
    this.#overlay(width, height, curve);
  }

  #overlay(width, height, curve) {
    const below = { whole: width, at: [0, -height / 2 - CAPTION_M / 2, 0.002] };
    const before = { whole: width, at: [0, 0, 0.006] };
    if (!this.caption) {
      this.caption = new Sheet(width, CAPTION_M, 800, curve, below);
      this.veil = new Sheet(width, height, 500, curve, before);
      this.group.add(this.caption.mesh, this.veil.mesh);
      this.say({ figures: "waiting for a picture", tone: "muted", veil: "" });
    } else {
      this.caption.bend(width, CAPTION_M, curve, below);
      this.veil.bend(width, height, curve, before);
    }
  }
}

/** A texture, with the picture that is its own. */
function drop(texture) {
  texture?.image?.close?.();
  texture?.dispose();
}

function drawVeil(context, width, height, text) {
  context.fillStyle = "rgb(10 6 8 / 55%)";
  context.fillRect(0, 0, width, height);
  context.font = `600 34px ${FONT}`;
  const lines = wrapped(context, text, width * 0.72, 3);
  const [across, down] = [width * 0.82, 50 + 44 * lines.length];
  roundRect(context, (width - across) / 2, (height - down) / 2, across, down, 20, "rgb(122 27 20 / 92%)", COLOURS.bad);
  context.fillStyle = "#ffffff";
  context.textAlign = "center";
  context.textBaseline = "middle";
  lines.forEach((line, at) => context.fillText(line, width / 2, height / 2 + (at - (lines.length - 1) / 2) * 44));
  context.textAlign = "left";
}
