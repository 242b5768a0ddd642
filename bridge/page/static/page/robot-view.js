/** One robot: pictures, place, plots, topics, services, driving. Which panels there are follows what it offers. */

import { ONLY_BY_GROUP } from "../shared/words.js";
import { Calls } from "./calls.js";
import { Camera, PICTURES } from "./camera.js";
import { TWIST } from "../shared/twist.js";
import { Drive } from "./drive.js";
import { Keyed, digits, h, say, show } from "./dom.js";
import { Plot } from "./plot.js";
import { TopicTable } from "./topic-table.js";
import { MAP } from "./map.js";
import { POSES, Trail } from "./trail.js";

const STATUS_MS = 500;
const OFFERS_MS = 2000;
const CAMERAS = 2;
const PLOTS = 6;
/** What is plotted by itself, of the first topic of such a type. */
const PLOTTED = {
  "sensor_msgs/msg/BatteryState": [["percentage"], "Battery"],
  "geometry_msgs/msg/PoseStamped": [["pose.position.x", "pose.position.y"], "Position, m"],
  "nav_msgs/msg/Odometry": [["twist.twist.linear.x", "twist.twist.angular.z"], "Speed"],
};

const NOBODY = "No robot is online. As soon as one is, it appears here.";
const ONLY_GROUPS = `This token names robots by their group: the mesh and the stop are for it, and /xr, where a group is driven as one. \
What is one robot's is not, nor is control to be taken: ${ONLY_BY_GROUP}.`;

export class RobotView {
  #shown = null;

  constructor(page) {
    this.page = page;
    this.robots = [];
    this.chips = h("div", { class: "chips", role: "group", "aria-label": "Robots" });
    this.keyed = new Keyed(this.chips, (robot) => this.#chip(robot));
    this.facts = h("p", { class: "facts", id: "facts", role: "status" });
    this.empty = h("p", { class: "empty" }, NOBODY);
    this.place = h("div", { class: "panels" });
    const heading = h("h1", { class: "visually-hidden" }, "Robot");
    this.element = h("div", { class: "view robot-view" }, heading, this.chips, this.facts, this.empty, this.place);
  }

  /** Who is online now, and how many more only as members of a group; the chosen robot stays chosen while it is away. */
  setRobots(robots, others = this.others ?? 0) {
    this.robots = robots;
    this.others = others;
    const chosen = this.#shown?.robot;
    const all = chosen === undefined || robots.includes(chosen) ? robots : [...robots, chosen].sort((a, b) => a - b);
    this.keyed.set(all);
    show(this.empty, all.length === 0);
    say(this.empty, others ? ONLY_GROUPS : NOBODY);
    if (chosen === undefined && robots.length) this.choose(this.page.wanted() ?? robots[0]);
    else if (chosen !== undefined) this.#setOnline(robots.includes(chosen));
    this.#mark();
  }

  choose(robot) {
    if (this.#shown?.robot === robot) return;
    this.#close();
    this.#shown = new Shown(robot, this.page, this.place, this.facts);
    this.#setOnline(this.robots.includes(robot));
    this.page.chosen(robot);
    if (!this.keyed.get(robot)) this.setRobots(this.robots);
    this.#mark();
  }

  get chosen() {
    return this.#shown?.robot ?? null;
  }

  tick(now) {
    this.#shown?.tick(now);
  }

  draw() {
    this.#shown?.draw();
  }

  restyle() {
    this.#shown?.restyle();
  }

  /** Drive on no more. */
  release(why) {
    this.#shown?.drive?.release(why);
  }

  /** The stop of a robot is another one. */
  mark() {
    this.#mark();
    this.#shown?.judge();
  }

  #setOnline(online) {
    this.#shown.setOnline(online);
    this.element.dataset.online = String(online);
  }

  #chip(robot) {
    return h("button", { type: "button", class: "chip", "data-robot": robot, onclick: () => this.choose(robot) }, `Robot ${robot}`);
  }

  #mark() {
    for (const chip of this.chips.children) {
      const robot = Number(chip.dataset.robot);
      chip.setAttribute("aria-pressed", String(robot === this.#shown?.robot));
      const stopped = this.page.stop.isStopped(robot);
      const state = !this.robots.includes(robot) ? "lost" : stopped ? "stopped" : "online";
      if (chip.dataset.state !== state) {
        chip.dataset.state = state;
        say(chip, `Robot ${robot}${state === "online" ? "" : ` · ${state}`}`);
      }
    }
  }

  #close() {
    this.#shown?.close();
    this.#shown = null;
    this.place.replaceChildren();
  }
}

/** The panels of one robot. */
class Shown {
  constructor(robot, page, place, facts) {
    this.robot = robot;
    this.page = page;
    this.place = place;
    this.facts = facts;
    this.cameras = new Map();
    this.plots = new Map();
    this.trail = null;
    this.drive = null;
    this.online = false;
    this.status = null;
    this.waits = new Set();
    const { headset, driver, topics, types, may } = page;
    this.parts = { headset, driver, topics, types, may, stop: page.stop, tell: page.tell };
    this.areas = Object.fromEntries(["cameras", "control", "plots", "tables"].map((name) => [name, h("div", { class: `area ${name}` })]));
    place.append(...Object.values(this.areas));
    const plot = (topic, type, path) => this.#plot(topic, type, [path], `${topic} · ${path}`);
    this.table = new TopicTable(robot, { ...this.parts, plot });
    this.calls = new Calls(robot, this.parts);
    this.areas.tables.append(this.table.element, this.calls.element);
    show(this.calls.element, false);
    this.#every(STATUS_MS, "status", (status) => this.#setStatus(status));
    this.#every(OFFERS_MS, "offers", (offers) => this.#setOffers(offers));
  }

  setOnline(online) {
    const came = online && !this.online;
    if (came) this.page.types.forget(this.robot);
    this.online = online;
    if (came) for (const ask of this.waits) ask();
    this.drive?.setOnline(online);
    this.place.classList.toggle("lost", !online);
    this.#tellFacts();
  }

  tick(now) {
    for (const camera of this.cameras.values()) camera.tick(now);
    this.table.tick(now);
  }

  draw() {
    this.trail?.draw();
    for (const plot of this.plots.values()) plot.draw();
  }

  restyle() {
    this.trail?.restyle();
    for (const plot of this.plots.values()) plot.restyle();
  }

  judge() {
    this.drive?.setStatus(this.status);
    this.#tellFacts();
  }

  close() {
    this.ended = true;
    for (const part of [...this.cameras.values(), ...this.plots.values(), this.trail, this.drive, this.table, this.calls]) {
      part?.close();
    }
  }

  /** Ask the gateway as soon as the robot is there, and every so often, while the page is seen. */
  async #every(ms, what, take) {
    while (!this.ended) {
      if (this.online && this.page.headset.connected && !document.hidden) {
        const answer = await this.page.get(`/view/robots/${this.robot}/${what}`);
        if (this.ended) return;
        if (answer !== null && !answer.error) take(answer);
        this.problem = answer?.error ?? "";
        this.#tellFacts();
      }
      await new Promise((resolve) => {
        const ask = () => (clearTimeout(timer), this.waits.delete(ask), resolve());
        const timer = setTimeout(ask, ms);
        this.waits.add(ask);
      });
    }
  }

  #setStatus(status) {
    this.status = status;
    this.drive?.setStatus(status);
    this.#tellFacts();
  }

  #tellFacts() {
    const facts = [];
    if (!this.online) facts.push("lost: it is not online");
    else if (this.problem) facts.push(this.problem);
    const stop = this.status?.stop;
    if (this.page.stop.isStopped(this.robot)) facts.push(`stopped${stop?.by ? ` by ${stop.by}` : ""}`);
    const lost = Object.entries(this.status?.drops ?? {}).filter(([, count]) => count);
    if (lost.length) facts.push(`lost: ${lost.map(([name, count]) => `${name} ${count}`).join(", ")}`);
    const roundTrip = this.page.headset.roundTripMs;
    if (this.online && roundTrip !== null) facts.push(`gateway ${digits(roundTrip)} ms away`);
    say(this.facts, facts.join(" · "));
  }

  #setOffers(offers) {
    this.table.setOffers(offers);
    this.calls.setOffers(offers);
    const publishers = Object.entries(offers.publishers ?? {});
    // compressed pictures first: raw ones cost a link ten times as much
    const pictures = publishers.filter(([, type]) => PICTURES.has(type)).sort(([, one], [, other]) => one.localeCompare(other));
    for (const [topic, type] of pictures) {
      if (this.cameras.has(topic) || this.cameras.size >= CAMERAS) continue;
      const area = this.cameras.size ? this.areas.plots : this.areas.cameras;
      this.cameras.set(topic, new Camera(this.robot, topic, type, this.parts));
      area.append(this.cameras.get(topic).element);
    }
    if (!this.drive && this.page.may.has("command")) {
      const found = Object.entries(offers.subscribers ?? {}).find(([, type]) => type in TWIST);
      if (found) {
        this.drive = new Drive(this.robot, ...found, this.parts);
        this.drive.setOnline(this.online);
        this.drive.setStatus(this.status);
        this.areas.control.prepend(this.drive.element);
      }
    }
    // the robot's own place before that of its parts
    const own = ([topic]) => /^\/(pose|odom|amcl_pose)$/.test(topic);
    publishers.sort((one, other) => own(other) - own(one));
    const pose = publishers.find(([, type]) => type in POSES);
    if (!this.trail && pose) {
      this.trail = new Trail(this.robot, ...pose, this.parts);
      this.areas.control.append(this.trail.element);
    }
    this.trail?.setMaps(publishers.flatMap(([topic, type]) => (type === MAP ? [topic] : [])).sort());
    for (const [wanted, [paths, title]] of Object.entries(PLOTTED)) {
      const found = publishers.find(([, type]) => type === wanted);
      if (found && !this.plotted?.has(wanted)) {
        this.plotted = (this.plotted ?? new Set()).add(wanted);
        this.#plot(found[0], wanted, paths, title);
      }
    }
  }

  #plot(topic, type, paths, title) {
    const key = `${topic} ${paths}`;
    if (this.plots.has(key) || this.plots.size >= PLOTS) return;
    const onClose = () => {
      this.plots.get(key)?.close();
      this.plots.delete(key);
    };
    const plot = new Plot(this.robot, topic, type, paths, this.parts, { title, onClose });
    this.plots.set(key, plot);
    this.areas.plots.append(plot.element);
  }
}
