/** Recordings: start, stop, the last minute; the list with downloads; what happened in one, and a replay from there. */

import { Keyed, h, panel, say, show } from "./dom.js";

const EVERY_MS = 1000;
const BEFORE_S = 5;
const KINDS = ["stop", "deadman", "refusal", "loss", "control"];

export class RecordView {
  constructor(page) {
    this.page = page;
    this.refused = "";
    this.state = h("p", { class: "facts", role: "status", id: "record-state" }, "Asking the recorder …");
    this.problem = h("p", { class: "bad", role: "alert", id: "record-problem" });
    this.commands = h("input", { type: "checkbox", id: "record-commands", checked: true });
    this.startButton = this.#button("record-start", "Start", () => this.#order("start", { commands: this.commands.checked }));
    this.stopButton = this.#button("record-stop", "Stop", () => this.#order("stop"));
    this.ringButton = this.#button("record-ring", "Write the last minute", () => this.#order("ring"));
    this.playing = h("span", { id: "replay-state" });
    this.playingStop = this.#button("replay-stop", "Stop the replay", () => this.#order("replay-stop"));
    this.files = h("tbody", { id: "recordings-list" });
    this.keyed = new Keyed(this.files, (name) => this.#row(name));
    const heads = ["Recording", "Began", "Length", "Size", "Messages", "Lost", ""];
    const head = h("tr", {}, ...heads.map((text, at) => h("th", { scope: "col", class: at > 1 && at < 5 ? "number" : "" }, text)));
    const table = h("table", {}, h("thead", {}, head), this.files);
    this.timeline = h("div", { class: "timeline", "aria-hidden": "true" });
    this.events = h("ol", { class: "events happened" });
    this.chosen = h("p", { class: "muted", id: "happened-of" }, "Choose a recording.");
    this.filters = new Map(KINDS.map((kind) => [kind, h("input", { type: "checkbox", id: `kind-${kind}`, checked: true })]));
    for (const box of this.filters.values()) box.addEventListener("change", () => this.#draw());
    const choices = [...this.filters].map(([kind, box]) => h("label", { for: `kind-${kind}` }, box, ` ${kind}`));
    const scroll = (label, child) => h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": label }, child);
    this.element = h(
      "div",
      { class: "view record-view" },
      h("h1", { class: "visually-hidden" }, "Recordings"),
      h(
        "div",
        { class: "row choices" },
        this.startButton,
        h("label", { for: "record-commands" }, this.commands, " with commands"),
        this.stopButton,
        this.ringButton,
        this.playing,
        this.playingStop,
      ),
      this.state,
      this.problem,
      h(
        "div",
        { class: "panels" },
        panel("Recordings", { id: "recordings" }, scroll("Recordings", table)),
        panel(
          "What happened",
          { id: "happened" },
          h("div", { class: "message" }, this.chosen, h("div", { class: "row choices" }, ...choices)),
          this.timeline,
          scroll("What happened", this.events),
        ),
      ),
    );
    this.#follow();
  }

  tick() {}

  draw() {}

  restyle() {}

  async #follow() {
    for (;;) {
      if (!this.element.hidden && !document.hidden) this.#show(await this.page.get("/recordings/state"));
      await new Promise((resolve) => setTimeout(resolve, EVERY_MS));
    }
  }

  #show(told) {
    if (told === null || told.error) {
      say(this.state, told?.error ?? "the gateway does not answer");
      for (const button of [this.startButton, this.stopButton, this.ringButton]) button.disabled = true;
      return;
    }
    const { recording, ring, replay, files } = told;
    this.startButton.disabled = recording !== null;
    this.stopButton.disabled = recording === null;
    this.ringButton.disabled = ring === null;
    const parts = [recording === null ? "nothing is recorded" : `recording ${recording.name}: ${progress(recording)}`];
    if (ring !== null) parts.push(`the last minute: ${progress(ring)}`);
    parts.push(`${size(told.bytes)} of ${size(told.most_bytes)}, ${size(told.free_bytes)} free on the disk`);
    say(this.state, parts.join(" · "));
    this.state.dataset.recording = recording === null ? "" : recording.name;
    say(this.problem, [this.refused, told.problem].filter(Boolean).join(" · "));
    this.#showReplay(replay);
    this.keyed.set(files.map(({ name }) => name));
    for (const file of files) this.#fill(this.keyed.get(file.name), file);
  }

  #showReplay(replay) {
    const key = JSON.stringify(replay);
    if (key === this.replayed) return;
    this.replayed = key;
    show(this.playingStop, replay !== null);
    if (replay === null) return this.playing.replaceChildren();
    const links = Object.entries(replay.robots).map(([old, as]) => {
      return h("a", { href: `#robot/${as}`, class: "replayed" }, `robot ${old} as ${as}`);
    });
    this.playing.replaceChildren(`playing ${replay.name} from ${replay.start_s.toFixed(1)} s: `, ...spaced(links));
  }

  #row(name) {
    const link = h("a", { href: `/recordings/files/${encodeURIComponent(name)}`, download: name }, name);
    const buttons = h("td", { class: "tools" });
    buttons.append(
      h("button", { type: "button", class: "happened-button", onclick: () => this.#choose(name) }, "What happened"),
      h("button", { type: "button", class: "replay-button", onclick: () => this.#replay(name, 0) }, "Replay"),
    );
    const cells = Array.from({ length: 5 }, (_, at) => h("td", { class: at && at < 4 ? "number" : "" }));
    return h("tr", { "data-name": name }, h("td", {}, link), ...cells, buttons);
  }

  #fill(row, file) {
    const whole = file.state === "whole";
    const lost = Object.entries(file.lost ?? {}).map(([name, count]) => `${name} ${count}`);
    const texts = [
      whole ? new Date(file.start_ns / 1e6).toLocaleString([], { hour12: false }) : "–",
      whole ? seconds((file.end_ns - file.start_ns) / 1e9) : "–",
      size(file.bytes),
      whole ? String(file.messages) : "–",
      whole ? lost.join(", ") || "nothing" : (file.problem ?? "is being recorded"),
    ];
    texts.forEach((text, at) => say(row.children[at + 1], text));
    row.children[5].className = whole && lost.length ? "bad" : "";
    row.dataset.state = file.state;
    for (const button of row.querySelectorAll("button")) button.disabled = !whole;
  }

  async #choose(name) {
    this.told = null;
    this.name = name;
    say(this.chosen, `${name}: reading …`);
    const told = await this.page.get(`/recordings/happened/${encodeURIComponent(name)}`);
    if (this.name !== name) return;
    if (told === null || told.error) {
      say(this.chosen, `${name}: ${told?.error ?? "it cannot be read"}`);
      return;
    }
    this.told = told;
    this.#draw();
  }

  #draw() {
    if (!this.told) return;
    const { start_ns: start, end_ns: end, happened, left_out: leftOut } = this.told;
    const length = Math.max(0.001, (end - start) / 1e9);
    const seen = happened.filter(({ kind }) => this.filters.get(kind)?.checked);
    const more = leftOut ? `, and ${leftOut} more` : "";
    say(this.chosen, `${this.name}: ${seen.length} of ${happened.length} shown${more}. A click replays it from ${BEFORE_S} s before.`);
    this.timeline.replaceChildren(
      ...seen.map(({ at_s: at, kind, text }) => {
        const mark = h("span", { class: "mark", "data-kind": kind, title: text });
        mark.style.setProperty("--at", `${(100 * Math.min(1, Math.max(0, at / length))).toFixed(2)}%`);
        return mark;
      }),
    );
    this.events.replaceChildren(
      ...seen.map(({ at_s: at, kind, robot, text }) => {
        const jump = () => this.#replay(this.name, Math.max(0, at - BEFORE_S));
        const what = h("button", { type: "button", class: "jump", onclick: jump }, `${robot ? `robot ${robot}: ` : ""}${text}`);
        return h("li", { "data-kind": kind }, h("time", {}, seconds(Math.max(0, at))), what);
      }),
    );
  }

  #replay(name, from) {
    return this.#order("replay", { name, start_s: from });
  }

  /** Ask for something; what comes of it, or why it is not done, is shown. */
  async #order(what, said = {}) {
    this.refused = "";
    say(this.problem, "");
    let told = null;
    try {
      const response = await fetch(`/recordings/${what}`, { method: "POST", body: JSON.stringify(said) });
      told = await response.json();
    } catch {
      told = { error: "the gateway does not answer" };
    }
    this.refused = told.error ?? "";
    say(this.problem, this.refused);
    this.#show(await this.page.get("/recordings/state"));
  }

  #button(id, text, onclick) {
    return h("button", { type: "button", id, onclick }, text);
  }
}

function spaced(elements) {
  return elements.flatMap((each, at) => (at ? [", ", each] : [each]));
}

function progress({ seconds: for_s = 0, messages = 0, bytes = 0, lost = {} }) {
  const gone = Object.values(lost).reduce((all, each) => all + each, 0);
  return `${seconds(for_s)}, ${messages} messages, ${size(bytes)}, lost ${gone}`;
}

function seconds(value) {
  const whole = Math.floor(value);
  const two = (number) => String(number).padStart(2, "0");
  return `${Math.floor(whole / 3600)}:${two(Math.floor(whole / 60) % 60)}:${two(whole % 60)}.${Math.floor((value - whole) * 10)}`;
}

function size(bytes) {
  let value = bytes;
  for (const unit of ["B", "kB", "MB", "GB"]) {
    if (value < 1000) return `${unit === "B" ? value : value.toFixed(1)} ${unit}`;
    value /= 1000;
  }
  return `${value.toFixed(1)} TB`;
}
