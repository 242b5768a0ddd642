/** What panels are made of: a bent rectangle, and a canvas that is drawn anew only when what it says has changed. */

import { CanvasTexture, LinearFilter, Mesh, MeshBasicMaterial, PlaneGeometry, SRGBColorSpace } from "../vendor/three.js";
import { COLOURS, FINE } from "./stage.js";

const MOST_BEND = 1.7;
const COLUMNS = 32;
export const FONT = 'system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", sans-serif';

/**
 * A rectangle of metres around its middle, bent about a vertical axis in front of it by `curve` (0: flat, 1: most). `whole`
 * is the width by which it is bent, so that a frame and what it frames have one axis. `part` is which part of a texture it
 * shows across, from 0 to 1; not `upright` is a texture whose first row is the upper one.
 */
export function bent(width, height, curve, { whole = width, part = [0, 1], at = [0, 0, 0], upright = true } = {}) {
  const geometry = new PlaneGeometry(width, height, COLUMNS, 1);
  const angle = curve * MOST_BEND;
  const { position, uv } = geometry.attributes;
  for (let each = 0; each < position.count; each++) {
    const x = position.getX(each) + at[0];
    position.setY(each, position.getY(each) + at[1]);
    const radius = angle > 0.01 ? whole / angle : 0;
    position.setX(each, radius ? (radius - at[2]) * Math.sin(x / radius) : x);
    position.setZ(each, radius ? radius - (radius - at[2]) * Math.cos(x / radius) : at[2]);
    uv.setX(each, part[0] + uv.getX(each) * (part[1] - part[0]));
    if (!upright) uv.setY(each, 1 - uv.getY(each));
  }
  geometry.computeBoundingSphere();
  return geometry;
}

/** The rectangle with round corners that a panel stands on: corners are cut by its texture's opacity. */
export class Sheet {
  #said = null;

  constructor(width, height, pixelsPerM = 640, curve = 0, placed = {}) {
    this.canvas = document.createElement("canvas");
    this.canvas.width = Math.round(width * pixelsPerM);
    this.canvas.height = Math.round(height * pixelsPerM);
    this.context = this.canvas.getContext("2d");
    this.texture = new CanvasTexture(this.canvas);
    this.texture.colorSpace = SRGBColorSpace;
    if (FINE) {
      this.texture.anisotropy = 4; // text is read from the side as well, and from afar
    } else {
      this.texture.minFilter = LinearFilter;
      this.texture.generateMipmaps = false;
    }
    this.material = new MeshBasicMaterial({ map: this.texture, transparent: true, toneMapped: false });
    this.mesh = new Mesh(bent(width, height, curve, placed), this.material);
  }

  /** Draw what this says, unless it is there already. `draw(context, width, height)`. */
  say(what, draw) {
    const said = JSON.stringify(what);
    if (said === this.#said) return false;
    this.#said = said;
    const { width, height } = this.canvas;
    this.context.clearRect(0, 0, width, height);
    draw(this.context, width, height);
    this.texture.needsUpdate = true;
    return true;
  }

  bend(width, height, curve, placed) {
    this.mesh.geometry.dispose();
    this.mesh.geometry = bent(width, height, curve, placed);
  }

  dispose() {
    this.mesh.removeFromParent();
    this.mesh.geometry.dispose();
    this.material.dispose();
    this.texture.dispose();
  }
}

export function roundRect(context, x, y, width, height, radius, fill, stroke = null) {
  context.beginPath();
  context.roundRect(x, y, width, height, radius);
  if (fill) {
    context.fillStyle = fill;
    context.fill();
  }
  if (stroke) {
    context.lineWidth = 2;
    context.strokeStyle = stroke;
    context.stroke();
  }
}

/** Text that ends with … where there is no room. */
export function fitted(context, text, width) {
  if (context.measureText(text).width <= width) return text;
  let most = text.length;
  while (most > 1 && context.measureText(`${text.slice(0, most)}…`).width > width) most -= 1;
  return `${text.slice(0, most)}…`;
}

/** Lines of text that fit into a width, at most so many. */
export function wrapped(context, text, width, most) {
  const lines = [];
  let line = "";
  for (const word of text.split(/\s+/)) {
    const longer = line ? `${line} ${word}` : word;
    if (context.measureText(longer).width > width && line) {
      lines.push(line);
      line = word;
    } else {
      line = longer;
    }
  }
  lines.push(line);
  if (lines.length > most) lines.splice(most - 1, Infinity, `${lines.slice(most - 1).join(" ")}`);
  return lines.map((each) => fitted(context, each, width));
}

/** A colour for good, middling and bad. */
export function tone(name) {
  return COLOURS[name] ?? COLOURS.text;
}
