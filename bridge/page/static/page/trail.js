/** Where a robot is and was, on a map or a grid of metres: ROS axes, x to the right and y up. */

import { digits, h, panel, say, show } from "./dom.js";
import { MapLayer } from "./map.js";

export const POSES = {
  "geometry_msgs/msg/PoseStamped": (message) => message.pose,
  "geometry_msgs/msg/PoseWithCovarianceStamped": (message) => message.pose.pose,
  "nav_msgs/msg/Odometry": (message) => message.pose.pose,
};
const POINTS = 4000;
const STEP_M = 0.02;
const SPANS = [2, 4, 8, 16, 32, 64, 128];

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
    const button = (text, title, onclick) => h("button", { type: "button", class: "small", "aria-label": title, title, onclick }, text);
    const tools = [
      this.figures,
      button("−", "Show more around it", () => this.#zoom(1)),
      button("+", "Show less around it", () => this.#zoom(-1)),
      h("button", { type: "button", class: "small", onclick: () => this.#clear() }, "Clear"),
    ];
    this.map = new MapLayer(robot, { topics, types }, () => this.#mapChanged());
    this.mapChoice = h("select", { class: "small", id: "trail-map", onchange: () => this.map.choose(this.mapChoice.value) });
    this.mapFigures = h("span", { class: "figures" });
    const chosen = h("div", { class: "row message" }, h("label", { for: "trail-map" }, "Map"), this.mapChoice, this.mapFigures);
    show((this.mapRow = chosen), false);
    this.element = panel(`Position · ${topic}`, { id: "trail", tools }, this.canvas, chosen);
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

  /** The maps that the robot has. Its own (`/map`) is shown by itself; costmaps and the like are heavy, and chosen. */
  setMaps(maps) {
    const known = maps.join(" ");
    if (known === this.knownMaps) return;
    this.knownMaps = known;
    const chosen = maps.includes(this.map.topic) ? this.map.topic : (maps.find((topic) => topic === "/map") ?? "");
    const options = ["", ...maps].map((topic) => h("option", { value: topic }, topic || "none"));
    this.mapChoice.replaceChildren(...options);
    this.mapChoice.value = chosen;
    show(this.mapRow, maps.length > 0);
    if (chosen !== this.map.topic) this.map.choose(chosen);
  }

  restyle() {
    this.map.restyle();
    this.dirty = true;
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
    this.map.draw(context, style, at, scale);
    this.#grid(context, style, { width, height, scale, centre, at });
    this.#line(context, style.getPropertyValue("--trail"), at);
    if (this.pose) this.#arrow(context, style.getPropertyValue("--accent"), at);
  }

  close() {
    this.ended = true;
    this.#end?.();
    this.map.close();
    this.element.remove();
  }

  #take(message) {
    const read = this.type.read(message.data);
    const { position, orientation: q } = this.pick(read);
    if (this.frame !== read.header.frame_id) {
      this.frame = read.header.frame_id;
      this.#mapChanged();
    }
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

  #zoom(by) {
    const at = SPANS.indexOf(this.span) + by;
    this.span = SPANS[Math.max(0, Math.min(SPANS.length - 1, at))];
    this.dirty = true;
  }

  #mapChanged() {
    const other = this.map.size && this.frame && this.map.frame !== this.frame;
    say(this.mapFigures, `${this.map.text}${other ? `, the place in ${this.frame}` : ""}`);
    this.mapFigures.classList.toggle("bad", Boolean(other || this.map.problem));
    this.canvas.dataset.map = this.map.size?.join("x") ?? "";
    this.dirty = true;
  }

  #clear() {
    this.count = 0;
    this.dirty = true;
  }

  #grid(context, style, { width, height, scale, centre, at }) {
    const step = scale > 40 ? 0.5 : scale > 16 ? 1 : scale > 4 ? 5 : 10;
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
