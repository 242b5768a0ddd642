/** Where a robot is and was, on a grid of metres: ROS axes, x to the right and y up. */

import { digits, h, panel, say } from "./dom.js";

export const POSES = {
  "geometry_msgs/msg/PoseStamped": (message) => message.pose,
  "geometry_msgs/msg/PoseWithCovarianceStamped": (message) => message.pose.pose,
  "nav_msgs/msg/Odometry": (message) => message.pose.pose,
};
const POINTS = 4000;
const STEP_M = 0.02;

export class Trail {
  #end = null;

  constructor(robot, topic, type, { topics, types }) {
    this.points = new Float32Array(2 * POINTS);
    this.count = 0;
    this.pose = null;
    this.span = 4; // metres from side to side
    this.canvas = h("canvas", { role: "img", "aria-label": `trail of robot ${robot}` });
    this.context = this.canvas.getContext("2d");
    this.figures = h("span", { class: "figures" });
    const clear = h("button", { type: "button", class: "small", onclick: () => this.#clear() }, "Clear");
    this.element = panel(`Position · ${topic}`, { id: "trail", tools: [this.figures, clear] }, this.canvas);
    this.dirty = true;
    this.pick = POSES[type];
    new ResizeObserver(() => (this.dirty = true)).observe(this.canvas);
    types.get(type, robot).then(
      (found) => {
        if (this.ended) return;
        this.type = found;
        this.#end = topics.watch(robot, topic, type, (message) => this.#take(message), { bufferSize: 1 });
      },
      (error) => say(this.figures, error.message),
    );
  }

  /** With each frame that the screen shows. */
  draw() {
    if (!this.dirty) return;
    this.dirty = false;
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    if (this.canvas.width !== Math.round(width * ratio) || this.canvas.height !== Math.round(height * ratio)) {
      this.canvas.width = Math.round(width * ratio);
      this.canvas.height = Math.round(height * ratio);
    }
    const style = getComputedStyle(this.canvas);
    const context = this.context;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const scale = Math.min(width, height) / this.span;
    const centre = this.pose ?? { x: 0, y: 0 };
    const at = (x, y) => [width / 2 + (x - centre.x) * scale, height / 2 - (y - centre.y) * scale];
    this.#grid(context, style, { width, height, scale, centre, at });
    this.#line(context, style.getPropertyValue("--trail"), at);
    if (this.pose) this.#arrow(context, style.getPropertyValue("--accent"), at);
  }

  close() {
    this.ended = true;
    this.#end?.();
    this.element.remove();
  }

  #take(message) {
    const { position, orientation: q } = this.pick(this.type.read(message.data));
    const heading = Math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z));
    this.pose = { x: position.x, y: position.y, heading };
    const last = 2 * ((this.count - 1) % POINTS);
    const far = !this.count || Math.hypot(position.x - this.points[last], position.y - this.points[last + 1]) > STEP_M;
    if (far) {
      this.points.set([position.x, position.y], 2 * (this.count % POINTS));
      this.count += 1;
    }
    this.canvas.dataset.x = position.x.toFixed(3);
    this.canvas.dataset.y = position.y.toFixed(3);
    this.canvas.dataset.heading = heading.toFixed(3);
    const degrees = Math.round((heading * 180) / Math.PI);
    say(this.figures, `x ${digits(position.x)} m · y ${digits(position.y)} m · ${degrees}°`);
    this.dirty = true;
  }

  #clear() {
    this.count = 0;
    this.dirty = true;
  }

  #grid(context, style, { width, height, scale, centre, at }) {
    const step = scale > 40 ? 0.5 : scale > 8 ? 1 : 10;
    context.lineWidth = 1;
    for (const metres of [step, 2 * step]) {
      context.strokeStyle = style.getPropertyValue(metres === step ? "--grid" : "--grid-strong");
      context.beginPath();
      for (let x = Math.ceil((centre.x - width / scale) / metres) * metres; x < centre.x + width / scale; x += metres) {
        const [across] = at(x, 0);
        context.moveTo(Math.round(across) + 0.5, 0);
        context.lineTo(Math.round(across) + 0.5, height);
      }
      for (let y = Math.ceil((centre.y - height / scale) / metres) * metres; y < centre.y + height / scale; y += metres) {
        const [, down] = at(0, y);
        context.moveTo(0, Math.round(down) + 0.5);
        context.lineTo(width, Math.round(down) + 0.5);
      }
      context.stroke();
    }
    context.fillStyle = style.getPropertyValue("--muted");
    context.font = "11px system-ui, sans-serif";
    context.fillText(`${2 * step} m`, 8, height - 8);
  }

  #line(context, colour, at) {
    const known = Math.min(this.count, POINTS);
    if (known < 2) return;
    context.strokeStyle = colour;
    context.lineWidth = 2;
    context.lineJoin = "round";
    context.beginPath();
    for (let each = this.count - known; each < this.count; each++) {
      const place = 2 * (each % POINTS);
      context.lineTo(...at(this.points[place], this.points[place + 1]));
    }
    if (this.pose) context.lineTo(...at(this.pose.x, this.pose.y));
    context.stroke();
  }

  #arrow(context, colour, at) {
    const [x, y] = at(this.pose.x, this.pose.y);
    context.save();
    context.translate(x, y);
    context.rotate(-this.pose.heading);
    context.fillStyle = colour;
    context.beginPath();
    context.moveTo(14, 0);
    context.lineTo(-9, 9);
    context.lineTo(-5, 0);
    context.lineTo(-9, -9);
    context.closePath();
    context.fill();
    context.restore();
  }
}
