/** A map (nav_msgs/OccupancyGrid) as a picture that lies under a robot's trail, in a bounded amount of memory. */

export const MAP = "nav_msgs/msg/OccupancyGrid";

const MOST_PIXELS = 2048; // in a row and in a column; of larger maps several cells share a pixel
const OCCUPIED = 100;

/** The cells of a grid as {width, height, values, share}: the most occupied of the `share` × `share` cells of each. */
export function reduced({ info: { width, height }, data }, most = MOST_PIXELS) {
  if (!(width > 0 && height > 0) || data.length !== width * height) return null;
  const share = Math.ceil(Math.max(width, height) / most);
  if (share === 1) return { width, height, values: data, share };
  const across = Math.ceil(width / share);
  const down = Math.ceil(height / share);
  const values = new Int8Array(across * down).fill(-1);
  for (let row = 0, at = 0; row < height; row++) {
    const first = Math.floor(row / share) * across;
    for (let column = 0; column < width; column++, at++) {
      const to = first + Math.floor(column / share);
      if (data[at] > values[to]) values[to] = data[at];
    }
  }
  return { width: across, height: down, values, share };
}

/** The map of a robot that is shown, if any: received only while somebody has chosen it. */
export class MapLayer {
  #end = null;
  #cells = null;
  #picture = null;

  constructor(robot, { topics, types }, onChange) {
    this.robot = robot;
    this.topics = topics;
    this.types = types;
    this.onChange = onChange;
    this.topic = "";
    this.problem = "";
  }

  /** Show this topic's map from now on; empty: none. */
  choose(topic) {
    this.#end?.();
    this.#end = this.#cells = this.#picture = null;
    this.topic = topic;
    this.problem = "";
    this.onChange();
    if (!topic) return;
    this.types.get(MAP, this.robot).then(
      (type) => {
        if (this.topic !== topic || this.#end) return;
        const take = (message) => this.#take(type.read(message.data));
        this.#end = this.topics.watch(this.robot, topic, MAP, take, { bufferSize: 1 });
      },
      (error) => {
        if (this.topic === topic) this.problem = error.message;
        this.onChange();
      },
    );
  }

  close() {
    this.choose("");
  }

  /** Its colours are others. */
  restyle() {
    this.#picture = null;
  }

  /** What is known of it, for a person. */
  get text() {
    if (!this.topic) return "";
    if (this.problem) return `${this.topic}: ${this.problem}`;
    return this.#cells ? `${this.topic} · ${this.size.join(" × ")}${this.frame ? ` in ${this.frame}` : ""}` : `${this.topic}: waiting`;
  }

  /** Its cells across and down; null while there is none. */
  get size() {
    return this.#cells ? [this.#cells.columns, this.#cells.rows] : null;
  }

  /** Draw it: `at(x, y)` is where a place in metres is on the canvas, `scale` its pixels per metre. */
  draw(context, style, at, scale) {
    if (!this.#cells) return;
    this.#picture ??= this.#paint(style);
    const { x, y, yaw, resolution, share, rows } = this.#cells;
    const size = resolution * share * scale;
    context.save();
    context.translate(...at(x, y));
    context.rotate(-yaw);
    context.imageSmoothingEnabled = size < 1;
    // its last pixel may stand for more cells than there are: its first row is at the origin all the same
    context.drawImage(this.#picture, 0, -this.#picture.height * size, this.#picture.width * size, this.#picture.height * size);
    context.restore();
  }

  #take(message) {
    const { info, header } = message;
    const found = reduced(message);
    if (found === null || !(info.resolution > 0)) {
      this.problem = "what comes is no map";
      this.onChange();
      return;
    }
    const { position, orientation: q } = info.origin;
    const yaw = Math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z));
    const place = { x: position.x, y: position.y, yaw, resolution: info.resolution };
    this.#cells = { ...found, ...place, columns: info.width, rows: info.height };
    this.frame = header.frame_id;
    this.problem = "";
    this.#picture = null;
    this.onChange();
  }

  /** A pixel per cell, north up: unknown ones are left clear, the rest goes from free to occupied. */
  #paint(style) {
    const { width, height, values } = this.#cells;
    const [free, occupied] = ["--map-free", "--map-occupied"].map((name) => rgb(style.getPropertyValue(name)));
    const palette = new Uint32Array(OCCUPIED + 1).map((_, value) => {
      const [red, green, blue] = free.map((from, part) => Math.round(from + ((occupied[part] - from) * value) / OCCUPIED));
      return new Uint32Array(new Uint8Array([red, green, blue, 255]).buffer)[0];
    });
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [width, height];
    const context = canvas.getContext("2d");
    const image = context.createImageData(width, height);
    const pixels = new Uint32Array(image.data.buffer);
    for (let row = 0, at = 0; row < height; row++) {
      const first = (height - 1 - row) * width;
      for (let column = 0; column < width; column++, at++) {
        const value = values[at];
        if (value >= 0 && value <= OCCUPIED) pixels[first + column] = palette[value];
      }
    }
    context.putImageData(image, 0, 0);
    return canvas;
  }
}

function rgb(colour) {
  const number = Number.parseInt(colour.trim().slice(1), 16);
  return [(number >> 16) & 255, (number >> 8) & 255, number & 255];
}
