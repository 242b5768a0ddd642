/** A panel of text and buttons, for rays and pointers: what it says is passed in whole, and drawn when it is another thing. */

import { Group } from "../vendor/three.js";
import { COLOURS } from "./stage.js";
import { FONT, Sheet, fitted, roundRect, tone } from "./surface.js";

const PIXELS_PER_M = 1000;
const PAD = 34;
const ROW = 46;
const BUTTON = 78;
const GAP = 16;

export class Board {
  #buttons = [];
  #hovered = null;
  #content = { title: "", rows: [], buttons: [] };

  constructor(width, height) {
    this.sheet = new Sheet(width, height, PIXELS_PER_M);
    this.group = new Group();
    this.group.add(this.sheet.mesh);
    this.group.userData.board = this;
    this.onPress = () => {};
  }

  /**
   * {title, badge: {text, tone}, rows: [{label, value, tone}], buttons: [[{id, label, tone, off}]]}: rows of text, then rows
   * of buttons at the lower edge.
   */
  set(content) {
    this.#content = content;
    this.#draw();
  }

  /** A ray points at (u, v) of it, or no more (null). The id of the button there. */
  hover(uv) {
    const { width, height } = this.sheet.canvas;
    const found = uv && this.#buttons.find(({ x, y, w, h }) => inside(uv.x * width - x, w) && inside((1 - uv.y) * height - y, h));
    const id = found && !found.off ? found.id : null;
    if (id !== this.#hovered) {
      this.#hovered = id;
      this.#draw();
    }
    return id;
  }

  /** The middle of a button in this panel's own metres; null where there is none. */
  placeOf(id) {
    const found = this.#buttons.find((each) => each.id === id);
    if (!found) return null;
    const { width, height } = this.sheet.canvas;
    return { x: (found.x + found.w / 2 - width / 2) / PIXELS_PER_M, y: (height / 2 - found.y - found.h / 2) / PIXELS_PER_M };
  }

  press(id) {
    this.onPress(id);
  }

  #draw() {
    this.sheet.say([this.#content, this.#hovered], (context, width, height) => {
      roundRect(context, 1, 1, width - 2, height - 2, 30, COLOURS.panel, COLOURS.border);
      this.#head(context, width);
      this.#rows(context, width);
      this.#placeButtons(context, width, height);
    });
  }

  #head(context, width) {
    const { title, badge } = this.#content;
    context.textBaseline = "middle";
    context.font = `700 38px ${FONT}`;
    context.fillStyle = COLOURS.text;
    context.fillText(fitted(context, title, width * 0.55), PAD, 54);
    if (!badge) return;
    context.font = `600 26px ${FONT}`;
    const text = fitted(context, badge.text, width * 0.4);
    const wide = context.measureText(text).width + 62;
    roundRect(context, width - PAD - wide, 30, wide, 48, 24, COLOURS.raised, tone(badge.tone));
    context.fillStyle = tone(badge.tone);
    context.beginPath();
    context.arc(width - PAD - wide + 26, 54, 8, 0, 7);
    context.fill();
    context.fillText(text, width - PAD - wide + 44, 55);
  }

  #rows(context, width) {
    let y = 116;
    for (const { label, value, tone: which } of this.#content.rows) {
      context.font = `27px ${FONT}`;
      context.fillStyle = COLOURS.muted;
      context.fillText(label, PAD, y);
      const from = label ? 210 : PAD;
      context.font = `${which ? 600 : 400} 27px ${FONT}`;
      context.fillStyle = which ? tone(which) : COLOURS.text;
      context.fillText(fitted(context, value, width - from - PAD), from, y);
      y += ROW;
    }
  }

  #placeButtons(context, width, height) {
    const { buttons } = this.#content;
    this.#buttons = [];
    let y = height - PAD - buttons.length * BUTTON - (buttons.length - 1) * GAP;
    for (const row of buttons) {
      const wide = (width - 2 * PAD - (row.length - 1) * GAP) / row.length;
      row.forEach((button, at) => this.#button(context, button, PAD + at * (wide + GAP), y, wide));
      y += BUTTON + GAP;
    }
  }

  #button(context, { id, label, tone: which, off, on }, x, y, w) {
    this.#buttons.push({ id, off, x, y, w, h: BUTTON });
    const hovered = id === this.#hovered;
    const red = which === "stop";
    const fill = red ? (hovered ? "#f04438" : COLOURS.stop) : on ? "#1d4f80" : hovered ? "#2b3b4d" : COLOURS.raised;
    roundRect(context, x, y, w, BUTTON, 18, fill, red ? "#ff9b93" : hovered || on ? COLOURS.accent : COLOURS.border);
    context.globalAlpha = off ? 0.4 : 1;
    context.font = `600 28px ${FONT}`;
    context.fillStyle = red ? "#ffffff" : COLOURS.text;
    context.textAlign = "center";
    context.fillText(fitted(context, label, w - 16), x + w / 2, y + BUTTON / 2 + 1);
    context.textAlign = "left";
    context.globalAlpha = 1;
  }
}

function inside(at, size) {
  return at >= 0 && at <= size;
}
