/** The topics of a robot: how often they come, how much, how old; the last message of one of them. */

import { shown } from "../ros.js";
import { Keyed, age, digits, h, panel, say, show } from "./dom.js";

const SHOW_MS = 250;

export class TopicTable {
  #ends = new Map();
  #rows = new Map();
  #shownAt = 0;

  /** `plot(topic, type, path)` opens a plot. */
  constructor(robot, { topics, types, plot }) {
    this.robot = robot;
    this.topics = topics;
    this.types = types;
    this.plot = plot;
    this.offered = {};
    this.body = h("tbody");
    this.keyed = new Keyed(this.body, (topic) => this.#row(topic));
    this.filter = h("input", {
      type: "search",
      placeholder: "filter",
      "aria-label": "Filter topics",
      oninput: () => this.#list(),
    });
    const heads = ["Receive", "Topic", "Type", "Hz", "kB/s", "Age"];
    const table = h(
      "table",
      {},
      h("thead", {}, h("tr", {}, ...heads.map((text, at) => h("th", { scope: "col", class: at > 2 ? "number" : "" }, text)))),
      this.body,
    );
    const scroll = h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Topics" }, table);
    this.messageTitle = h("h3");
    this.numbers = h("select", { "aria-label": "Number to plot" });
    const plotButton = h("button", { type: "button", class: "small", onclick: () => this.#plotChosen() }, "Plot");
    this.numberRow = h("div", { class: "row" }, this.numbers, plotButton);
    this.message = h("pre", { class: "output", tabindex: "0", "aria-label": "Last message" });
    this.detail = h("div", { class: "message", hidden: true }, this.messageTitle, this.numberRow, this.message);
    this.element = panel("Topics", { id: "topics", tools: [this.filter] }, scroll, this.detail);
  }

  setOffers({ publishers = {} }) {
    const known = JSON.stringify(publishers);
    if (known === this.known) return;
    this.known = known;
    this.offered = publishers;
    for (const topic of [...this.#ends.keys()]) if (!(topic in publishers)) this.#receive(topic, false);
    this.#list();
  }

  /** Figures, a few times a second. */
  tick(now) {
    for (const [topic, row] of this.#rows) {
      const rate = this.topics.rate(this.robot, topic, now);
      const refusal = rate ? this.topics.refusal(this.robot, topic) : "";
      say(row.hz, rate ? digits(rate.hz) : "–");
      say(row.size, rate ? digits(rate.bytesPerS / 1000) : "–");
      say(row.age, refusal ? "refused" : rate ? age(rate.ageMs) : "–");
      row.age.title = refusal;
      const late = rate !== null && rate.ageMs !== null && rate.ageMs > 2000;
      row.age.classList.toggle("late", late || Boolean(refusal));
    }
  }

  close() {
    for (const end of this.#ends.values()) end();
    this.#ends.clear();
    this.element.remove();
  }

  #list() {
    const wanted = this.filter.value.trim().toLowerCase();
    const names = Object.keys(this.offered).filter((topic) => topic.toLowerCase().includes(wanted));
    const kept = new Set(names);
    for (const topic of this.#rows.keys()) if (!kept.has(topic)) this.#rows.delete(topic);
    this.keyed.set(names.sort());
  }

  #row(topic) {
    const type = this.offered[topic];
    const receive = h("input", {
      type: "checkbox",
      "aria-label": `receive ${topic}`,
      onchange: (event) => this.#receive(topic, event.target.checked),
    });
    receive.checked = this.#ends.has(topic);
    const name = h("button", { type: "button", class: "link", onclick: () => this.#open(topic) }, topic);
    const cells = { hz: h("td", { class: "number" }), size: h("td", { class: "number" }), age: h("td", { class: "number" }) };
    this.#rows.set(topic, { ...cells, receive });
    return h(
      "tr",
      { "data-topic": topic },
      h("td", {}, receive),
      h("td", {}, name),
      h("td", { class: "muted" }, type),
      cells.hz,
      cells.size,
      cells.age,
    );
  }

  #receive(topic, wanted) {
    this.#ends.get(topic)?.();
    this.#ends.delete(topic);
    const row = this.#rows.get(topic);
    if (row) row.receive.checked = wanted;
    if (!wanted) {
      if (this.opened === topic) {
        this.opened = null;
        show(this.detail, false);
      }
      return;
    }
    this.#ends.set(topic, this.topics.watch(this.robot, topic, this.offered[topic], (message) => this.#take(topic, message)));
  }

  async #open(topic) {
    if (!this.#ends.has(topic)) this.#receive(topic, true);
    this.opened = topic;
    this.type = null;
    say(this.messageTitle, topic);
    say(this.message, "waiting for a message");
    show(this.detail, true);
    show(this.numberRow, false);
    try {
      const type = await this.types.get(this.offered[topic], this.robot);
      if (this.opened !== topic) return;
      this.type = type;
      const paths = type.numbers();
      this.numbers.replaceChildren(...paths.map((path) => h("option", { value: path }, path)));
      show(this.numberRow, paths.length > 0);
    } catch (error) {
      if (this.opened === topic) say(this.message, error.message);
    }
  }

  #plotChosen() {
    this.plot(this.opened, this.offered[this.opened], this.numbers.value);
  }

  #take(topic, message) {
    if (topic !== this.opened || !this.type) return;
    const now = performance.now();
    if (now - this.#shownAt < SHOW_MS) return;
    this.#shownAt = now;
    try {
      say(this.message, shown(this.type.read(message.data)));
    } catch (error) {
      say(this.message, error.message);
    }
  }
}
