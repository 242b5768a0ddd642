/** Numbers of a topic over time: the last minute, in a fixed amount of memory. */

import { uPlot } from "../vendor/libraries.js";
import { numberAt } from "../ros.js";
import { digits, h, panel, say } from "./dom.js";

const POINTS = 1200;
const SPAN_S = 60;
const LEAST_MS = 50;
const COLOURS = ["--plot-1", "--plot-2", "--plot-3", "--plot-4"];

export class Plot {
  #end = null;
  #lastAt = 0;

  /** `paths` are the numbers that are drawn, as pose.position.x; all of the type can be chosen. */
  constructor(robot, topic, type, paths, { topics, types }, { title = topic, onClose } = {}) {
    this.robot = robot;
    this.topic = topic;
    this.paths = paths;
    this.data = [[], ...paths.map(() => [])];
    this.figures = h("span", { class: "figures" });
    this.place = h("div", { class: "plot" });
    const tools = [this.figures];
    if (onClose) {
      tools.push(h("button", { type: "button", class: "small", "aria-label": `close plot of ${title}`, onclick: onClose }, "×"));
    }
    const id = `plot-${`${topic}-${paths.join("-")}`.replace(/\W+/g, "-")}`;
    this.element = panel(title, { id, tools }, this.place);
    this.element.classList.add("plotted");
    this.resized = new ResizeObserver(() => this.#size());
    this.resized.observe(this.place);
    types.get(type, robot).then(
      (found) => {
        if (this.ended) return;
        this.type = found;
        this.#make();
        this.#end = topics.watch(robot, topic, type, (message) => this.#take(message));
      },
      (error) => say(this.figures, error.message),
    );
  }

  /** With each frame that the screen shows. */
  draw() {
    if (!this.dirty || !this.chart) return;
    this.dirty = false;
    const last = this.data[0].at(-1) ?? 0;
    this.chart.batch(() => {
      this.chart.setData(this.data, false);
      this.chart.setScale("x", { min: last - SPAN_S, max: last });
    });
    this.element.dataset.points = this.data[0].length;
  }

  /** The colours are others now. */
  restyle() {
    if (!this.chart) return;
    this.chart.destroy();
    this.#make();
    this.dirty = true;
  }

  close() {
    this.ended = true;
    this.#end?.();
    this.resized.disconnect();
    this.chart?.destroy();
    this.element.remove();
  }

  #take(message) {
    const now = performance.now();
    if (now - this.#lastAt < LEAST_MS) return;
    this.#lastAt = now;
    const value = this.type.read(message.data);
    this.data[0].push(Date.now() / 1000);
    const numbers = this.paths.map((path) => numberAt(value, path));
    numbers.forEach((number, at) => this.data[at + 1].push(number));
    if (this.data[0].length > POINTS) this.data.forEach((list) => list.shift());
    say(this.figures, numbers.map((number) => (number === null ? "–" : digits(number))).join(" · "));
    this.dirty = true;
  }

  #make() {
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(name).trim();
    const axis = {
      stroke: colour("--muted"),
      grid: { stroke: colour("--grid"), width: 1 },
      ticks: { show: false },
      font: "11px system-ui, sans-serif",
    };
    const series = this.paths.map((path, at) => ({
      label: path,
      stroke: colour(COLOURS[at % COLOURS.length]),
      width: 2,
      points: { show: false },
    }));
    this.chart = new uPlot(
      {
        width: Math.max(100, this.place.clientWidth),
        height: Math.max(80, this.place.clientHeight),
        series: [{}, ...series],
        axes: [{ ...axis, size: 24, space: 80, values: (_, seconds) => seconds.map(clock) }, { ...axis, size: 44 }],
        legend: { show: this.paths.length > 1, live: false },
        cursor: { show: false },
        scales: { x: { auto: false }, y: { range: (_, least, most) => ranged(least, most) } },
      },
      this.data,
      this.place,
    );
    this.#size();
  }

  #size() {
    if (!this.chart) return;
    const legend = this.place.querySelector(".u-legend")?.offsetHeight ?? 0;
    this.chart.setSize({
      width: Math.max(100, this.place.clientWidth),
      height: Math.max(60, this.place.clientHeight - legend),
    });
  }
}

function clock(seconds) {
  return new Date(seconds * 1000).toLocaleTimeString([], { hour12: false });
}

function ranged(least, most) {
  if (least === null || most === null || !Number.isFinite(least + most)) return [0, 1];
  const room = Math.max((most - least) * 0.1, Math.abs(most) * 0.05, 0.05);
  return [least - room, most + room];
}
