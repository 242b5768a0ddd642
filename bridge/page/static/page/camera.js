/** Pictures of a robot: the newest one only, decoded beside the page. */

import { age, digits, h, panel, say, show } from "./dom.js";

export const PICTURES = new Set(["sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"]);
const FROZEN_MS = 1000;

export class Camera {
  #waiting = null;
  #busy = false;
  #end = null;
  #worker = null;

  constructor(robot, topic, type, { topics, types }) {
    this.robot = robot;
    this.topic = topic;
    this.topics = topics;
    this.compressed = type.endsWith("/CompressedImage");
    this.canvas = h("canvas", { width: 320, height: 240, role: "img", "aria-label": `camera ${topic} of robot ${robot}` });
    this.context = this.canvas.getContext("2d");
    this.note = h("p", { class: "overlay" }, "waiting for a picture");
    this.figures = h("span", { class: "figures" });
    this.shown = 0;
    const frame = h("div", { class: "picture" }, this.canvas, this.note);
    this.element = panel(topic, { id: `camera-${topic.replace(/\W+/g, "-")}`, tools: [this.figures] }, frame);
    this.element.classList.add("camera");
    types.get(type, robot).then(
      (found) => {
        if (this.ended) return;
        this.type = found;
        this.#end = topics.watch(robot, topic, type, (message) => this.#take(message), { bufferSize: 1 });
      },
      (error) => say(this.note, error.message),
    );
  }

  /** Once a second and more: what stands below the picture. */
  tick(now) {
    const rate = this.topics.rate(this.robot, this.topic, now);
    if (rate === null) return;
    const refusal = this.topics.refusal(this.robot, this.topic);
    const frozen = rate.ageMs === null || rate.ageMs > FROZEN_MS;
    show(this.note, frozen || Boolean(this.problem));
    if (refusal) say(this.note, refusal);
    else if (this.problem) say(this.note, this.problem);
    else if (rate.ageMs !== null) say(this.note, `no picture for ${age(rate.ageMs)}`);
    const size = this.shown ? `${this.canvas.width} × ${this.canvas.height} · ` : "";
    say(this.figures, `${size}${digits(rate.hz)} Hz · ${digits(rate.bytesPerS / 1000)} kB/s`);
  }

  close() {
    this.ended = true;
    this.#end?.();
    this.#worker?.terminate();
    this.element.remove();
  }

  #take(message) {
    this.#waiting = message;
    if (!this.#busy) this.#decode();
  }

  async #decode() {
    this.#busy = true;
    try {
      while (this.#waiting !== null && !this.ended) {
        const message = this.#waiting;
        this.#waiting = null;
        try {
          this.#draw(await this.#bitmap(this.type.read(message.data)));
          this.problem = "";
        } catch (error) {
          this.problem = error.message;
        }
      }
    } finally {
      this.#busy = false;
    }
  }

  #bitmap(picture) {
    if (this.compressed) return createImageBitmap(new Blob([picture.data]));
    this.#worker ??= new Worker(new URL("./image-worker.js", import.meta.url), { type: "module" });
    const { width, height, step, encoding } = picture;
    const data = new Uint8Array(picture.data); // a copy: it is handed over
    return new Promise((resolve, reject) => {
      this.#worker.onmessage = ({ data: { bitmap, problem } }) => (bitmap ? resolve(bitmap) : reject(new Error(problem)));
      this.#worker.postMessage({ data, width, height, step, encoding, bigEndian: picture.is_bigendian }, [data.buffer]);
    });
  }

  #draw(bitmap) {
    if (this.canvas.width !== bitmap.width || this.canvas.height !== bitmap.height) {
      this.canvas.width = bitmap.width;
      this.canvas.height = bitmap.height;
    }
    this.context.drawImage(bitmap, 0, 0);
    bitmap.close();
    this.shown += 1;
    this.canvas.dataset.shown = this.shown;
  }
}
