/** What stands about who looks: panels of cameras, the board that tells, the board that is pressed, the model of the world. */

import { digits } from "../page/dom.js";
import { ONLY_BY_GROUP } from "../shared/words.js";
import { Board } from "./board.js";
import { Model } from "./model.js";
import { face } from "./pointing.js";
import { Screen } from "./screen.js";

const EYES = { x: 0, y: 1.6, z: 0.2 };
/** Where panels stand at first: the first one in front. */
const PLACES = [
  { at: [0, 1.72, -2.1], width: 1.6 },
  { at: [1.42, 1.78, -1.75], width: 0.95 },
  { at: [-1.5, 2.35, -1.7], width: 0.95 },
  { at: [1.6, 2.5, -1.3], width: 0.8 },
  { at: [-0.8, 2.75, -1.9], width: 0.8 },
  { at: [0.8, 2.75, -1.9], width: 0.8 },
];
const STATUS = [-1.34, 1.68, -1.7];
const MENU = [0.98, 1.12, -1.2];

export class Room {
  constructor(stage, settings) {
    this.stage = stage;
    this.settings = settings;
    this.screens = new Map();
    this.model = new Model();
    this.status = new Board(0.86, 0.62);
    this.menu = new Board(0.56, 0.62);
    stage.scene.add(this.model.group, this.status.group, this.menu.group);
    this.arrange();
  }

  /** All that rays meet. */
  get targets() {
    return [...[...this.screens.values()].map(({ group }) => group), this.status.group, this.menu.group];
  }

  /** Panels for these topics, in this order; others go. */
  setPanels(topics) {
    for (const [topic, screen] of this.screens) {
      if (topics.includes(topic)) continue;
      screen.dispose();
      this.screens.delete(topic);
    }
    topics.forEach((topic) => {
      if (this.screens.has(topic)) return;
      const at = Math.min(this.screens.size, PLACES.length - 1);
      const screen = new Screen(topic, { topic, width: PLACES[at].width, curve: this.settings.get("curve") });
      screen.stereo = this.settings.get("stereo");
      this.screens.set(topic, screen);
      this.stage.scene.add(screen.group);
      this.#put(screen.group, PLACES[at].at);
    });
  }

  /** Everything back to where it stood at first. */
  arrange() {
    [...this.screens.values()].forEach((screen, at) => {
      screen.group.scale.setScalar(1);
      this.#put(screen.group, PLACES[Math.min(at, PLACES.length - 1)].at);
    });
    this.#put(this.status.group, STATUS);
    this.#put(this.menu.group, MENU);
  }

  follow(name, value) {
    if (name === "curve") for (const screen of this.screens.values()) screen.setCurve(value);
    if (name === "stereo") for (const screen of this.screens.values()) screen.stereo = value;
    if (name === "scale") this.model.setScale(value);
    if (name === "layers") this.model.setLayers(value);
  }

  /** What the panels say below their pictures; `blind` is why driving is off for the first one. */
  tellPictures(rates, wishes, blind, now) {
    let first = true;
    for (const [topic, screen] of this.screens) {
      const wish = wishes.find((each) => each.panel === topic && each.eye === "left");
      const rate = rates.get(wish?.key);
      const age = rate && rate.pictureAgeMs !== null ? rate.pictureAgeMs + (now - rate.at) : null;
      const size = screen.picture ? `${screen.picture.width} × ${screen.picture.height} · ` : "";
      const figures = rate ? `${size}${digits(rate.hz)} Hz · ${age === null ? "–" : `${Math.round(age)} ms`}` : "asked for";
      const old = age === null || age > 300;
      const late = age > 1000 ? `no picture for ${(age / 1000).toFixed(1)} s` : "";
      const veil = rate?.problem || (first && blind ? `Driving is off: ${blind}` : late);
      screen.say({ figures, tone: old ? (age > 1000 || age === null ? "bad" : "warn") : "good", veil });
      first = false;
    }
  }

  #put(group, [x, y, z]) {
    group.position.set(x, y, z);
    face(group, EYES);
  }
}

/** The rows of the board that tells. */
export function statusRows({ state, stop, battery, picture, event, values }) {
  const link = !state.connected ? ["lost", "bad"] : state.roundTripMs === null ? ["connected", "good"] : quality(state.roundTripMs, 20, 60);
  const rows = [
    { label: "Gateway", value: link[0], tone: link[1] },
    { label: "Pictures", value: picture.text, tone: picture.tone },
    { label: "Driving", value: driving(state), tone: state.held ? "good" : state.barred ? "bad" : "muted" },
    { label: "Control", value: control(state), tone: controlTone(state) },
  ];
  if (battery) rows.push({ label: "Battery", value: battery.text, tone: battery.tone });
  if (stop.text) rows.push({ label: "Stop", value: stop.text, tone: "bad" });
  if (state.exclusive && state.byGroup) rows.push({ label: "", value: ONLY_BY_GROUP, tone: "muted" });
  for (const line of values.slice(0, 4)) rows.push({ label: "", value: line });
  if (event) rows.push({ label: "Last", value: event, tone: "muted" });
  return rows;
}

/** A time in ms as text and colour: good up to `good`, bad from `bad`. */
export function quality(ms, good, bad) {
  return [`${digits(ms)} ms`, ms <= good ? "good" : ms < bad ? "warn" : "bad"];
}

function driving(state) {
  if (state.held) return `${state.speed.linear.toFixed(2)} m/s · ${state.speed.angular.toFixed(2)} rad/s`;
  return state.barred ? `off: ${state.barred}` : "hold grip or pinch";
}

function controlTone({ unknown, holder }) {
  if (unknown.length) return "bad";
  if (holder === "you") return "good";
  return holder ? "warn" : undefined;
}

function control(state) {
  if (state.unknown.length) return `robot ${state.unknown.join(", ")} does not say`;
  if (!state.exclusive) return "not exclusive";
  if (state.holder === null) return "nobody has it";
  return state.holder === "you" ? `you, for ${digits(state.secondsLeft)} s` : `${state.holder} has it`;
}
