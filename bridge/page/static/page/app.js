/** The page: who may see it, its connection, its views, its stop. */

import { CommandClock } from "../macs-clock.js";
import { Headset } from "../macs.js";
import { Types } from "../ros.js";
import { Driver } from "../shared/driver.js";
import { digits, h, say, show } from "./dom.js";
import { LatencyView } from "./latency-view.js";
import { asked, login } from "./login.js";
import { MeshView } from "./mesh-view.js";
import { RecordView } from "./record-view.js";
import { RobotView } from "./robot-view.js";
import { Stop } from "./stop.js";
import { Topics } from "./topics.js";

const TICK_MS = 250;
const FOLLOW_MS = 1000;
const SILENCE_MS = 3000;
/** A robot that is asked whether it is stopped, and does not say in time, is asked anew. */
const STATUS_MS = 3000;
const REPEATED_MS = 5000;
const RETRY_MS = [50, 100, 200, 300, 500];

class Page {
  constructor(me) {
    this.me = me;
    this.may = new Set(me.may);
    const scheme = location.protocol === "https:" ? "wss:" : "ws:";
    this.headset = new Headset(`${scheme}//${location.host}/macs`, { silenceMs: SILENCE_MS, retryMs: RETRY_MS });
    this.clock = new CommandClock(this.headset);
    this.driver = new Driver({
      headset: this.headset,
      bars: () => "no robot is chosen",
      changed: () => {},
      say: (text) => this.tell("drive", text),
      still: "the page stood still",
    });
    this.topics = new Topics(this.headset);
    this.types = new Types("", (url) => this.get(url).then((answer) => answer ?? { error: "the gateway does not answer" }));
    this.tell = (kind, text) => this.#tell(kind, text);
    this.stop = new Stop(this.headset, this.tell, (path) => this.get(path, STATUS_MS), me);
    this.stop.onChange = () => this.robotView?.mark();
    this.online = { robots: [], headsets: [] };
    this.robotView = new RobotView(this);
    this.meshView = new MeshView(this);
    this.latencyView = new LatencyView(this);
    this.recordView = me.recordings ? new RecordView(this) : null;
    this.#build();
    this.#listen();
  }

  start() {
    this.headset.keepConnecting();
    this.headset.follow(FOLLOW_MS);
    setInterval(() => this.#tick(), TICK_MS);
    const draw = () => {
      if (!this.view.element.hidden) this.view.draw();
      requestAnimationFrame(draw);
    };
    requestAnimationFrame(draw);
  }

  /** JSON of the gateway; null while it does not answer, or not within `patienceMs`. */
  async get(path, patienceMs = null) {
    try {
      const signal = patienceMs === null ? null : AbortSignal.timeout(patienceMs);
      const response = await fetch(path, { cache: "no-store", signal });
      return response.ok ? await response.json() : null;
    } catch {
      return null;
    }
  }

  /** The robot that the address names. */
  wanted() {
    const [, robot] = /^#robot\/(\d+)$/.exec(location.hash) ?? [];
    return robot === undefined ? null : Number(robot);
  }

  /** A robot was chosen. */
  chosen(robot) {
    if (this.view === this.robotView) history.replaceState(null, "", `#robot/${robot}`);
  }

  #build() {
    this.link = h("span", { class: "link-state", id: "link", role: "status" });
    this.tabs = [
      ["robot", "Robot", this.robotView],
      ["mesh", "Mesh", this.meshView],
      ["latency", "Latency", this.latencyView],
      ...(this.recordView === null ? [] : [["recordings", "Recordings", this.recordView]]),
    ].map(([name, title, view]) => {
      const tab = h("a", { href: `#${name}`, class: "tab" }, title);
      return { name, view, tab };
    });
    const name = this.me.name ? h("span", { class: "muted who" }, this.me.name) : null;
    const nav = h("nav", { "aria-label": "Views" }, ...this.tabs.map(({ tab }) => tab));
    const brand = h("span", { class: "brand" }, "macs");
    const head = h("header", { class: "top" }, brand, nav, h("div", { class: "right" }, name, this.link), this.stop.element);
    this.lastEvent = h("footer", { class: "last-event" });
    const main = h("main", {}, ...this.tabs.map(({ view }) => view.element));
    document.body.replaceChildren(head, main, this.lastEvent);
    this.#route();
    this.#tellLink("connecting");
  }

  #route() {
    const [, wanted] = /^#(\w+)/.exec(location.hash) ?? [];
    const chosen = this.tabs.find(({ name }) => name === wanted) ?? this.tabs[0];
    // who does not see what he drives has let go
    if (this.view !== chosen.view) this.robotView.release("another view was chosen");
    this.view = chosen.view;
    for (const { tab, view } of this.tabs) {
      show(view.element, view === chosen.view);
      if (view === chosen.view) tab.setAttribute("aria-current", "page");
      else tab.removeAttribute("aria-current");
    }
    const robot = this.wanted();
    if (robot !== null) this.robotView.choose(robot);
  }

  #listen() {
    const { headset } = this;
    headset.addEventListener("link", ({ detail: { up, id, why } }) => {
      this.#tellLink(up ? "online" : "lost", why);
      this.tell("link", up ? `connected as headset ${id}` : `connection lost: ${why}`);
      if (!up) this.#setOnline({ robots: [], headsets: [] }, false);
    });
    headset.addEventListener("id", ({ detail }) => this.tell("link", `this page is headset ${detail.id} now`));
    headset.addEventListener("presence", ({ detail }) => this.#setOnline(detail, true));
    headset.addEventListener("gone", ({ detail }) => {
      const gone = (type, ids) => ids.filter((id) => !detail.some((each) => each.type === type && each.id === id));
      this.#setOnline({ robots: gone(1, this.online.robots), headsets: gone(2, this.online.headsets) }, true);
    });
    headset.addEventListener("refused", ({ detail: { robot, name, reason } }) => {
      this.tell("refused", `${robot ? `robot ${robot}` : "the gateway"} refused ${name}: ${reason}`);
    });
    headset.addEventListener("access", ({ detail: { kind, reason } }) => {
      this.tell("refused", reason);
      if (kind !== "changed" && kind !== "no_token" && kind !== "ended") return;
      this.reloads = true;
      location.reload();
    });
    window.addEventListener("hashchange", () => this.#route());
    window.addEventListener("beforeunload", (event) => {
      if (this.stop.open && !this.reloads) event.preventDefault(); // who closes it forgets a stop that is not confirmed
    });
    window.addEventListener("pagehide", () => {
      this.robotView.release("the page was closed"); // the zero command first
      headset.close();
    });
    window.addEventListener("pageshow", (event) => event.persisted && headset.keepConnecting());
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.tabs.forEach(({ view }) => view.restyle()));
  }

  #setOnline(now, told) {
    const { robots: before, headsets: beforeHeadsets } = this.online;
    this.online = now;
    if (told) {
      for (const [name, had, has] of [
        ["robot", before, now.robots],
        ["headset", beforeHeadsets, now.headsets],
      ]) {
        const came = has.filter((id) => !had.includes(id));
        const left = had.filter((id) => !has.includes(id));
        if (came.length) this.tell("came", `${name} ${listed(came)} came`);
        if (left.length) this.tell("left", `${name} ${listed(left)} left`);
      }
    }
    // the gateway tells only of robots that this token may name, by id or by group: a stop needs no more
    this.stop.setRobots(now.robots);
    const mine = this.me.robots === "any" ? now.robots : now.robots.filter((id) => this.me.robots.includes(id));
    this.robotView.setRobots(mine, now.robots.length - mine.length);
    this.latencyView.setRobots(mine);
  }

  #tick() {
    if (document.hidden) return;
    this.view.tick(performance.now());
    if (this.headset.connected && this.headset.roundTripMs !== null) {
      say(this.link, `${digits(this.headset.roundTripMs)} ms`);
    }
  }

  #tellLink(state, why = "") {
    this.link.dataset.state = state;
    this.link.title = why;
    say(this.link, { connecting: "connecting …", online: "connected", lost: "connection lost" }[state]);
  }

  #tell(kind, text) {
    const at = new Date();
    // who refuses says so again each second
    if (this.told?.text === text && at - this.told.at < REPEATED_MS) return;
    this.told = { text, at };
    this.meshView?.add(kind, text, at);
    if (this.lastEvent) say(this.lastEvent, `${at.toLocaleTimeString([], { hour12: false })} ${text}`);
  }
}

function listed(ids) {
  return ids.length > 8 ? `${ids.slice(0, 8).join(", ")} and ${ids.length - 8} more` : ids.join(", ");
}

async function begin() {
  const me = await asked();
  if (me.wanted) return login();
  const page = new Page(me);
  window.macsPage = page; // for tests, and for who looks at it from a console
  page.start();
}

begin();
