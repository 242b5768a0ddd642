/** Services and actions of a robot: a form made from their type, and what comes back. */

import { shown } from "../ros.js";
import { h, panel, say, show } from "./dom.js";
import { form } from "./form.js";

const STATUS = ["unknown", "accepted", "executing", "canceling", "succeeded", "canceled", "aborted"];

export class Calls {
  constructor(robot, { headset, types, may }) {
    this.robot = robot;
    this.headset = headset;
    this.types = types;
    this.may = may;
    this.known = "";
    this.choice = h("select", { id: "call-name", onchange: () => this.#choose() });
    this.place = h("div", { class: "call-form" });
    this.button = h("button", { type: "submit", disabled: true }, "Call");
    this.cancelButton = h("button", { type: "button", class: "quiet", hidden: true }, "Cancel goal");
    this.output = h("pre", { class: "output", id: "call-output", role: "status", tabindex: "0", "aria-label": "Answer" });
    const body = h(
      "form",
      { class: "call" },
      h("label", { for: "call-name" }, "Service or action"),
      this.choice,
      this.place,
      h("div", { class: "row" }, this.button, this.cancelButton),
      this.output,
    );
    body.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#submit();
    });
    this.element = panel("Services and actions", { id: "calls" }, body);
  }

  /** What the robot offers now. */
  setOffers({ services = {}, actions = {} }) {
    const parts = [
      ["service", "Services", this.may.has("call") ? services : {}],
      ["action", "Actions", this.may.has("act") ? actions : {}],
    ];
    const known = JSON.stringify(parts);
    if (known === this.known) return;
    this.known = known;
    const before = this.choice.value;
    this.choice.replaceChildren(h("option", { value: "" }, "choose …"));
    for (const [kind, title, found] of parts) {
      const names = Object.keys(found).sort();
      if (!names.length) continue;
      const options = names.map((name) => h("option", { value: `${kind} ${name} ${found[name]}` }, name));
      this.choice.append(h("optgroup", { label: title }, ...options));
    }
    this.choice.value = before;
    if (this.choice.value !== before) this.#choose();
    show(this.element, this.choice.length > 1);
  }

  close() {
    this.element.remove();
  }

  async #choose() {
    const [kind, name, type] = this.choice.value.split(" ");
    this.chosen = null;
    this.button.disabled = true;
    this.place.replaceChildren();
    say(this.output, "");
    show(this.cancelButton, false);
    if (!name) return;
    try {
      const parts = await (kind === "service" ? this.types.service(type, this.robot) : this.types.action(type, this.robot));
      if (this.choice.value !== `${kind} ${name} ${type}`) return;
      this.chosen = { kind, name, type, parts, form: form(parts.request ?? parts.goal) };
      this.place.replaceChildren(this.chosen.form.element);
      say(this.button, kind === "service" ? "Call" : "Send goal");
      this.button.disabled = false;
    } catch (error) {
      say(this.output, error.message);
    }
  }

  async #submit() {
    if (!this.chosen) return;
    this.button.disabled = true;
    say(this.output, "…");
    try {
      if (this.chosen.kind === "service") await this.#call(this.chosen);
      else await this.#act(this.chosen);
    } catch (error) {
      say(this.output, error.message);
    } finally {
      this.button.disabled = false;
      show(this.cancelButton, false);
    }
  }

  async #call({ name, type, parts, form: made }) {
    const began = performance.now();
    const answer = await this.headset.call(name, type, this.robot, parts.request.write(made.value()));
    const tookMs = performance.now() - began;
    say(this.output, `${shown(parts.response.read(answer))}\n${tookMs.toFixed(1)} ms`);
  }

  async #act({ name, type, parts, form: made }) {
    const action = this.headset.action(name, type, { robots: [this.robot] });
    const onFeedback = (cdr) => say(this.output, `feedback ${shown(parts.feedback.read(cdr))}`);
    const goal = await action.sendGoal(this.robot, parts.goal.write(made.value()), { onFeedback });
    say(this.output, "accepted");
    this.cancelButton.onclick = () => action.cancel(goal).catch((error) => say(this.output, error.message));
    show(this.cancelButton, true);
    const { status, data } = await goal.result;
    say(this.output, `${STATUS[status] ?? status} ${shown(parts.result.read(data))}`);
  }
}
