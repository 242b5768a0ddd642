/** What is on the screen about the scene: the robots, the way into XR, the stop, the pad, the settings. */

import { digits, h, say, show } from "../page/dom.js";
import { ONLY_BY_GROUP } from "../shared/words.js";
import { Pad } from "../shared/pad.js";

const FIELDS = [
  ["Driving", [
    ["driveTopic", "Topic of velocities", "topic"],
    ["forward", "At most, m/s", "number"],
    ["turn", "At most, rad/s", "number"],
    ["hz", "Commands a second", "number"],
    ["hand", "Hand that drives by pinching", ["right", "left"]],
    ["lockoutS", "No driving with a picture older than, s (0: never)", "number"],
  ]],
  ["Pictures", [
    ["cameras", "Topics, the first one guards driving (empty: the first two; or none)", "list"],
    ["stereo", "Two eyes in one picture", ["auto", "off", "side-by-side"]],
    ["rightEye", "Topic of the right eye, for the first panel", "topic"],
    ["curve", "Curve of panels, 0 to 1", "number"],
  ]],
  ["World", [
    ["scale", "Scale of the model (1: life-size)", "number"],
    ["points", "Points of a cloud, at most", "number"],
    ["layers", "Shown: trail scan cloud map frames joints", "list"],
    ["values", "Topics shown as text", "list"],
  ]],
  ["Sent (empty: not sent)", [
    ["head", "Head, PoseStamped", "topic"],
    ["left", "Left controller or wrist, PoseStamped", "topic"],
    ["right", "Right controller or wrist, PoseStamped", "topic"],
    ["leftHand", "Left hand, PoseArray", "topic"],
    ["rightHand", "Right hand, PoseArray", "topic"],
    ["joy", "Buttons and sticks, Joy", "topic"],
    ["frame", "Frame of poses", "text"],
    ["poseHz", "Poses a second, at most", "number"],
  ]],
];

const MODES = [
  ["immersive-vr", "Enter VR"],
  ["immersive-ar", "Enter AR"],
];

export class Overlay {
  constructor({ canvas, settings, me, on }) {
    this.settings = settings;
    this.on = on;
    this.pad = new Pad({ focusable: [canvas] });
    const { pad, hint, speed } = this.pad;
    const drive = h("section", { class: "xr-drive", "aria-label": "Drive" }, pad, h("div", {}, hint, h("p", {}, speed)));
    this.link = h("span", { class: "link-state", id: "link", role: "status" }, "connecting …");
    this.targets = h("select", { id: "target", "aria-label": "Robot or group", onchange: () => on.choose(this.targets.value) });
    this.enter = Object.fromEntries(MODES.map(([mode, label]) => [mode, button(mode, "enter", label, () => on.enter(mode))]));
    this.none = h("span", { class: "muted", id: "no-xr" }, "no headset here: on a screen");
    this.control = h("span", { class: "muted", id: "control" });
    this.take = button("take", "small", "Take control", () => on.control("take"));
    this.give = button("give", "small", "Give", () => on.give(Number(this.give.value)));
    this.back = button("give-back", "small", "Give it back", () => on.control("release"));
    this.stop = button("stop", "stop", "", () => on.stop());
    this.stop.title = "Stop all robots (Escape)";
    this.stop.append(h("span", { class: "stop-sign", "aria-hidden": "true" }), h("span", {}, "Stop"));
    this.release = button("release", "quiet", "Release", () => on.release());
    this.stopStatus = h("p", { class: "stop-status", id: "stop-status", role: "status", "aria-live": "assertive" });
    this.stopBar = h("div", { class: "stop-bar" }, this.stopStatus, this.release, this.stop);
    show(this.stop, me.may.includes("stop"));
    this.event = h("footer", { class: "xr-event", id: "event" });
    this.dialog = this.#settingsDialog();
    const open = button("open-settings", "small", "Settings", () => this.dialog.show()); // the stop beside it stays
    show(open, true);
    const head = h("header", { class: "xr-top" },
      h("a", { class: "brand", href: "/" }, "macs"), this.targets, this.link, this.control, this.take, this.give, this.back,
      h("span", { class: "xr-space" }), ...Object.values(this.enter), this.none, open, this.stopBar);
    this.root = h("div", { class: "xr-overlay" }, head, this.dialog, drive, this.event);
  }

  /** Which ways into XR there are: names of modes. */
  setModes(modes) {
    for (const [mode, button] of Object.entries(this.enter)) show(button, modes.has(mode));
    show(this.none, modes.size === 0);
  }

  /** Robots and groups: [{id, label}], and which is chosen. */
  setTargets(targets, chosen) {
    const said = JSON.stringify([targets, chosen]);
    if (said === this.said) return;
    this.said = said;
    const options = targets.map(({ id, label }) => h("option", { value: id, selected: id === chosen }, label));
    this.targets.replaceChildren(...(options.length ? options : [h("option", { value: "" }, "no robot is online")]));
  }

  setState(state, pad) {
    this.link.dataset.state = state.connected ? "online" : "lost";
    const reached = state.roundTripMs === null ? "connected" : `${digits(state.roundTripMs)} ms`;
    say(this.link, state.connected ? reached : "connection lost");
    const whose = state.holder ? `${state.holder} ${state.holder === "you" ? "have" : "has"} control` : "nobody has control";
    const unknown = state.unknown.length ? `robot ${state.unknown.join(", ")} does not say who has control` : "";
    say(this.control, unknown || (state.exclusive ? `${whose}${state.byGroup ? ` · ${ONLY_BY_GROUP}` : ""}` : ""));
    show(this.take, state.exclusive && !state.byGroup && state.holder === null);
    show(this.back, state.exclusive && state.holder === "you");
    show(this.give, state.exclusive && state.holder === "you" && state.candidates.length > 0);
    this.give.value = state.candidates[0] ?? "";
    if (state.candidates.length) say(this.give, `Give to headset ${this.give.value}`);
    this.pad.show({ ...state, ...pad });
  }

  setStop({ state, text }, sure) {
    this.stopBar.dataset.state = state;
    say(this.stopStatus, text);
    show(this.release, state !== "free");
    say(this.release, sure ? "Release: sure?" : "Release");
  }

  tell(text) {
    say(this.event, text);
  }

  #settingsDialog() {
    const part = ([title, fields]) => h("fieldset", {}, h("legend", {}, title), ...fields.map((field) => this.#field(...field)));
    const form = h("form", { method: "dialog" }, ...FIELDS.map(part), h("button", { type: "submit" }, "Close"));
    return h("dialog", { class: "xr-settings", id: "settings", "aria-label": "Settings" }, form);
  }

  #field(name, label, kind) {
    const value = this.settings.get(name);
    const id = `setting-${name}`;
    let input;
    if (Array.isArray(kind)) {
      input = h("select", { id }, ...kind.map((each) => h("option", { value: each, selected: each === value }, each)));
    } else {
      const text = kind === "list" ? listed(value) : String(value);
      const type = kind === "number" ? "number" : "text";
      input = h("input", { id, type, step: "any", value: text, spellcheck: "false", autocomplete: "off" });
    }
    input.addEventListener("change", () => {
      const words = input.value.trim();
      const none = name === "cameras" ? null : [];
      const list = words === "none" ? [] : words ? words.split(/[\s,]+/) : none;
      const taken = this.settings.set(name, kind === "number" ? input.valueAsNumber : kind === "list" ? list : words);
      input.setAttribute("aria-invalid", String(!taken));
    });
    return h("label", { for: id }, h("span", {}, label), input);
  }
}

function listed(value) {
  if (value === null) return "";
  return value.length ? value.join(" ") : "none";
}

/** A button that is hidden at first. */
function button(id, kind, label, onclick) {
  return h("button", { type: "button", class: kind, id, hidden: id !== "stop", onclick }, label);
}
