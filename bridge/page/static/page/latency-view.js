/** Where the time of a robot's messages goes: a stacked bar per hop, one column per look, and the hops as a table. */

import { Keyed, digits, h, panel, say, show } from "./dom.js";

const EVERY_MS = 500;
const COLUMNS = 120;
/** A topic's messages are told every second; one that comes more seldom is waited for. */
const SILENT_MS = 5000;
/** Chosen in the place of a topic. */
const COMMANDS = "commands";
const COLOURS = ["--plot-1", "--plot-2", "--plot-3", "--plot-4", "--hop-5", "--hop-6", "--hop-7", "--hop-8"];

export class LatencyView {
  constructor(page) {
    this.page = page;
    this.looks = [];
    this.hops = [];
    this.robotChoice = h("select", { id: "trace-robot", onchange: () => this.#robotChosen() });
    this.topicChoice = h("select", { id: "trace-topic", onchange: () => this.#clear() });
    this.state = h("p", { class: "facts", role: "status", id: "trace-state" }, "Choose a robot and a topic, or commands.");
    this.canvas = h("canvas", { class: "bars", role: "img", "aria-label": "Time by hop, the newest at the right" });
    this.context = this.canvas.getContext("2d");
    this.body = h("tbody");
    this.keyed = new Keyed(this.body, (hop) => this.#row(hop));
    this.clocks = h("p", { class: "muted" });
    const heads = ["Hop", "p50 ms", "p99 ms"];
    const head = h("tr", {}, ...heads.map((text, at) => h("th", { scope: "col", class: at ? "number" : "" }, text)));
    const table = h("table", {}, h("thead", {}, head), this.body);
    const choices = h(
      "div",
      { class: "row choices" },
      h("label", { for: "trace-robot" }, "Robot"),
      this.robotChoice,
      h("label", { for: "trace-topic" }, "What"),
      this.topicChoice,
    );
    const scroll = h("div", { class: "scroll-x", tabindex: "0", role: "region", "aria-label": "Hops" }, table);
    this.element = h(
      "div",
      { class: "view latency-view" },
      h("h1", { class: "visually-hidden" }, "Latency"),
      choices,
      this.state,
      h(
        "div",
        { class: "panels" },
        panel("Time by hop", { id: "bars" }, this.canvas),
        panel("Hops", { id: "hops" }, scroll, h("div", { class: "message" }, this.clocks)),
      ),
    );
    new ResizeObserver(() => (this.dirty = true)).observe(this.canvas);
    this.#follow();
  }

  setRobots(robots) {
    const known = JSON.stringify(robots);
    if (known === this.known) return;
    this.known = known;
    const before = this.robotChoice.value;
    this.robotChoice.replaceChildren(...robots.map((robot) => h("option", { value: robot }, `Robot ${robot}`)));
    if (robots.includes(Number(before))) this.robotChoice.value = before;
    else if (robots.length) this.#robotChosen();
  }

  tick() {}

  draw() {
    if (!this.dirty) return;
    this.dirty = false;
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    const style = getComputedStyle(this.canvas);
    const colour = (name) => style.getPropertyValue(name);
    const context = this.context;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    const whole = (look) => look.hops.reduce((all, hop) => all + Math.max(0, hop.p50_ms), 0);
    const most = Math.max(0.1, ...this.looks.map(whole)) * 1.15;
    const [left, below] = [46, 20];
    const scale = (height - below - 8) / most;
    context.font = "11px system-ui, sans-serif";
    for (let part = 0; part <= 4; part++) {
      const value = (most * part) / 4;
      const y = height - below - value * scale;
      context.fillStyle = colour("--grid-strong");
      context.fillRect(left, Math.round(y), width - left, 1);
      context.fillStyle = colour("--muted");
      context.fillText(`${digits(value)}`, 8, y + 4);
    }
    context.fillText("ms", 8, height - 4);
    const step = (width - left) / COLUMNS;
    this.looks.forEach((look, at) => {
      const x = width - (this.looks.length - at) * step;
      let y = height - below;
      for (const hop of look.hops) {
        const size = Math.max(0, hop.p50_ms) * scale;
        context.fillStyle = colour(this.#colourOf(hop.hop));
        context.fillRect(x, y - size, Math.max(1, step - 1), size);
        y -= size;
      }
    });
  }

  restyle() {
    this.dirty = true;
  }

  #colourOf(hop) {
    return COLOURS[Math.max(0, this.hops.indexOf(hop)) % COLOURS.length];
  }

  async #robotChosen() {
    const robot = this.robotChoice.value;
    const offers = await this.page.get(`/view/robots/${robot}/offers`);
    if (this.robotChoice.value !== robot) return;
    this.types = offers?.publishers ?? {};
    const topics = Object.keys(this.types).sort();
    const commands = h("option", { value: COMMANDS }, "Commands from this gateway");
    this.topicChoice.replaceChildren(...topics.map((topic) => h("option", { value: topic }, topic)), commands);
    const own = topics.find((topic) => /^\/(pose|odom)$/.test(topic));
    if (own) this.topicChoice.value = own;
    this.#clear();
  }

  #clear() {
    this.looks = [];
    this.hops = [];
    this.lookedAt = performance.now();
    this.keyed.set([]);
    show(this.clocks, false);
    say(this.state, this.#commands ? "Waiting for commands: somebody has to drive." : "Waiting for messages.");
    this.dirty = true;
  }

  get #commands() {
    return this.topicChoice.value === COMMANDS;
  }

  /** Ask while it is seen: nothing is traced otherwise. */
  async #follow() {
    for (;;) {
      const seen = !this.element.hidden && !document.hidden && this.page.headset.connected;
      const [robot, topic] = [this.robotChoice.value, this.topicChoice.value];
      if (seen && robot && !topic) await this.#robotChosen(); // what it offers could not be told the last time
      const type = this.types?.[topic];
      this.#receive(seen && robot && type ? [Number(robot), topic, type] : null);
      if (seen && robot && topic) {
        const what = this.#commands ? "commands=1" : `topic=${encodeURIComponent(topic)}`;
        const told = await this.page.get(`/view/trace/${robot}?${what}`);
        if (robot === this.robotChoice.value && topic === this.topicChoice.value) this.#take(told);
      }
      await new Promise((resolve) => setTimeout(resolve, EVERY_MS));
    }
  }

  /** What is traced has to come here: receive it, and nothing else. */
  #receive(wanted) {
    const key = JSON.stringify(wanted);
    if (key === this.received) return;
    this.received = key;
    this.leave?.();
    this.leave = wanted === null ? null : this.page.topics.watch(...wanted, () => {}, { bufferSize: 1 });
  }

  #take(told) {
    if (told === null || told.error) {
      say(this.state, told?.error ?? "the gateway does not answer");
      return;
    }
    const [look] = told.ways;
    const now = performance.now();
    if (!look) {
      if (now - this.lookedAt < SILENT_MS) return;
      const what = this.#commands ? "command has been sent" : `message of ${this.topicChoice.value} has come`;
      say(this.state, `no ${what} for ${Math.round((now - this.lookedAt) / 1000)} s that was traced`);
      return;
    }
    this.lookedAt = now;
    this.looks.push(look);
    if (this.looks.length > COLUMNS) this.looks.shift();
    for (const { hop } of look.hops) if (!this.hops.includes(hop)) this.hops.push(hop);
    const { p50_ms: p50, p99_ms: p99 } = look.end_to_end;
    say(this.state, `end to end ${p50.toFixed(2)} ms, p99 ${p99.toFixed(2)} ms, of ${look.count} messages to ${look.receiver}`);
    const clocks = Object.entries(look.clocks_within_ms).map(([name, bound]) => {
      return bound === null ? `${name} not known` : `${name} within ${bound.toFixed(3)} ms`;
    });
    say(this.clocks, `Clocks: ${clocks.join(", ")}`);
    this.keyed.set(look.hops.map(({ hop }) => hop));
    for (const hop of look.hops) {
      const cells = this.keyed.get(hop.hop).children;
      say(cells[1], hop.p50_ms.toFixed(3));
      say(cells[2], hop.p99_ms.toFixed(3));
    }
    show(this.clocks, clocks.length > 0);
    this.dirty = true;
  }

  #row(hop) {
    const key = h("span", { class: "key" });
    key.style.setProperty("--key", `var(${this.#colourOf(hop)})`);
    return h("tr", {}, h("td", {}, key, hop), h("td", { class: "number" }), h("td", { class: "number" }));
  }
}
