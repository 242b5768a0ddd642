/** What is known, told in words and colours: on the boards, below the pictures, and on the screen. */

import { digits } from "../page/dom.js";
import { Aged } from "./aged.js";
import { quality, statusRows } from "./room.js";

/** Before the worker of commands has said anything. */
const NOTHING = {
  connected: false,
  roundTripMs: null,
  held: false,
  source: null,
  barred: "nothing is known yet",
  why: "",
  blind: "",
  speed: { linear: 0, angular: 0 },
  exclusive: false,
  byGroup: false,
  holder: null,
  candidates: [],
  secondsLeft: 0,
  deadmanS: null,
  drops: {},
  unknown: [],
  maxAgeS: null,
  clockless: [],
};
const REPEATED_MS = 5000;

export class Telling {
  constructor(scene) {
    this.scene = scene;
    this.state = NOTHING;
    this.stop = { state: "free", text: "" };
    this.batteries = new Aged();
    this.texts = new Aged();
    this.last = { text: "", at: 0 };
    const { links } = scene;
    links.addEventListener("state", ({ detail }) => this.#take(detail));
    links.addEventListener("stop", ({ detail }) => {
      this.stop = detail;
      this.tell();
    });
    links.addEventListener("event", ({ detail }) => this.event(detail.text));
    links.addEventListener("link", ({ detail: { which, up, why, resumed } }) => {
      this.event(up ? `${which}: connected${resumed ? " again, as the same headset" : ""}` : `${which}: connection lost (${why})`);
    });
  }

  /** Of another robot nothing is known. */
  clear() {
    this.batteries.clear();
    this.texts.clear();
  }

  /** Something happened, in words. */
  event(text) {
    const now = performance.now();
    if (text === this.last.text && now - this.last.at < REPEATED_MS) return;
    this.last = { text, at: now };
    this.scene.overlay.tell(text);
  }

  setBattery({ topic, percentage, voltage }) {
    const part = Number.isFinite(percentage) ? `${Math.round(percentage * 100)} % · ` : "";
    const tone = percentage > 0.4 ? "good" : percentage > 0.2 ? "warn" : "bad";
    const value = { text: `${part}${digits(voltage)} V`, tone: Number.isFinite(percentage) ? tone : undefined };
    this.batteries.note(topic, value, performance.now());
  }

  setText(topic, lines) {
    this.texts.note(topic, lines.map((line) => `${topic.split("/").pop()}: ${line}`), performance.now());
  }

  /** All of it, as it is now. */
  tell() {
    this.#tellScreen();
    this.#tellPictures();
    this.#tellStatus(performance.now());
    this.#tellMenu();
  }

  /**
   * Four times a second: of what has to be drawn and uploaded each part once, so that no frame has it all. Who wears the headset
   * does not see the page: its figures are written as seldom then.
   */
  tick() {
    this.turn = ((this.turn ?? 0) + 1) % 4;
    if (this.turn === 1 || !this.scene.stage.immersive) this.#tellScreen();
    if (this.turn === 0) this.#tellStatus(performance.now());
    else if (this.turn === 2) this.#tellPictures();
  }

  #tellScreen() {
    this.scene.overlay.setState(this.state, this.scene.sample ?? {});
    this.scene.overlay.setStop(this.stop, this.scene.sure);
  }

  #tellPictures() {
    const { room, links, wishes } = this.scene;
    room.tellPictures(links.rates, wishes, this.state.blind, performance.now());
  }

  #take(state) {
    const changed = state.barred !== this.state.barred || state.held !== this.state.held || state.holder !== this.state.holder;
    this.state = state;
    if (changed) this.tell();
  }

  #tellStatus(now) {
    const { scene, state, stop } = this;
    const limits = [
      state.deadmanS ? `dead-man ${state.deadmanS} s` : "",
      state.maxAgeS ? `commands at most ${state.maxAgeS} s old` : "",
      state.clockless.length ? `robot ${state.clockless.join(", ")} does not compare clocks` : "",
    ].filter(Boolean);
    const values = [...(limits.length ? [limits.join(" · ")] : []), ...this.#texts(now)];
    const rows = { state, stop, battery: this.#battery(now), picture: this.#picture(now), event: this.last.text, values };
    scene.room.status.set({
      title: scene.target?.label ?? scene.waiting,
      badge: badge(state),
      rows: statusRows(rows),
      buttons: [],
    });
  }

  #topics(shown) {
    return this.scene.wishes.filter((wish) => wish.shown === shown).map(({ topic }) => topic);
  }

  #battery(now) {
    this.batteries.keep(this.#topics("battery"));
    const [found] = this.batteries.all(now);
    if (!found) return null;
    const { value, age } = found;
    return age ? { text: `${value.text} · ${age}`, tone: "muted" } : value;
  }

  #texts(now) {
    this.texts.keep(this.#topics("text"));
    return this.texts.all(now).flatMap(({ value, age }) => (age ? value.map((line) => `${line} · ${age}`) : value));
  }

  /** How old the picture is that driving depends on. */
  #picture(now) {
    const { links, wishes } = this.scene;
    if (!links.sightUp.connected) return { text: "connection lost", tone: "bad" };
    const rate = links.rates.get(wishes.find(({ guards }) => guards)?.key);
    if (!rate) return { text: this.state.blind || "none chosen", tone: "muted" };
    const age = rate.pictureAgeMs === null ? null : rate.pictureAgeMs + now - rate.at;
    const [text, tone] = age === null ? ["none yet", "bad"] : quality(age, 150, 300);
    return { text: `${digits(rate.hz)} Hz · ${text} old · ${digits(rate.bytesPerS / 1000)} kB/s`, tone };
  }

  #tellMenu() {
    const { scene, stop } = this;
    const { settings } = scene;
    const off = !scene.me.may.includes("stop");
    const release = stop.state === "free" ? [] : [{ id: "release", label: scene.sure ? "Sure?" : "Release", off }];
    scene.room.menu.set({
      title: "Menu",
      rows: [],
      buttons: [
        [{ id: "before", label: "‹ Robot" }, { id: "after", label: "Robot ›" }],
        this.#control(),
        [{ id: "smaller", label: "World −" }, { id: "larger", label: "World +" }, { id: "arrange", label: "Arrange" }],
        [
          { id: "flat", label: "Curve", on: settings.get("curve") > 0 },
          { id: "hand", label: settings.get("hand") === "left" ? "Pinch L" : "Pinch R" },
          { id: "leave", label: "Leave", off: !scene.immersion.session },
        ],
        [{ id: "stop", label: "STOP", tone: "stop", off }, ...release],
      ],
    });
  }

  #control() {
    const { exclusive, byGroup, holder, candidates } = this.state; // who is named on a button gets it, whoever comes meanwhile
    if (holder !== "you") return [{ id: "take", label: "Take control", off: !exclusive || byGroup || holder !== null }];
    const [other] = candidates;
    return [
      { id: "back", label: "Give back" },
      { id: `give ${other ?? ""}`, label: other === undefined ? "Give" : `Give to ${other}`, off: other === undefined },
    ];
  }
}

function badge({ connected, held, barred }) {
  if (!connected) return { text: "no connection", tone: "bad" };
  if (held) return { text: "driving", tone: "good" };
  return barred ? { text: "not driving", tone: "warn" } : { text: "ready", tone: "accent" };
}
