/**
 * The scene for headsets: `/xr`. It reads hands and shows the world; what goes out and comes in is in two workers.
 */

import { asked, login } from "../page/login.js";
import { h } from "../page/dom.js";
import { Press } from "../shared/press.js";
import { TWIST } from "../shared/twist.js";
import { Hands } from "./hands.js";
import { Immersion } from "./immersion.js";
import { Input } from "./input.js";
import { KeptGuards } from "./kept-guards.js";
import { Links } from "./links.js";
import { Looking } from "./looking.js";
import { Overlay } from "./overlay.js";
import { Pointing } from "./pointing.js";
import { Room } from "./room.js";
import { Settings } from "./settings.js";
import { Stage } from "./stage.js";
import { Telling } from "./telling.js";
import { driveTopic, firstOf, guardOf, namedBy, pictureKey, targets, wishes } from "./targets.js";
import { POSE_TYPES, SHOWN } from "./wire-types.js";

const OFFERS_MS = 2000;
const IDLE_MS = 100;
const SURE_MS = 3000;
const CHOSEN = "macs.xr.robot";

class Scene {
  #idleAt = 0;
  #stopping = new Press();
  #before = 0;
  #absent = "";
  #blurred = false;
  /** Why nothing is drawn; empty: all is. */
  #undrawn = "";
  #space = null;
  /** Whether the origin has moved since somebody took hold of something: then poses are of another place. */
  #moved = false;

  constructor(me) {
    this.me = me;
    this.settings = new Settings();
    this.canvas = h("canvas", { class: "xr-scene", id: "scene", tabindex: "0", "aria-label": "The robot and its pictures in a room" });
    const heading = h("h1", { class: "visually-hidden" }, "Headset");
    document.body.replaceChildren(h("main", {}, heading, this.canvas));
    this.stage = new Stage(this.canvas);
    this.kept = new KeptGuards(tabStore());
    this.links = new Links(me, this.kept);
    this.room = new Room(this.stage, this.settings);
    this.immersion = new Immersion(this.stage.renderer);
    this.overlay = new Overlay({ canvas: this.canvas, settings: this.settings, me, on: this.#actions() });
    document.body.append(this.overlay.root);
    this.hands = new Hands(this.stage.scene);
    this.input = new Input({ settings: this.settings, pad: this.overlay.pad });
    this.looking = new Looking(this.stage, this.canvas);
    this.pointing = new Pointing({
      head: () => this.stage.head(),
      mayGrab: ({ kind, name }) => kind !== "hand" || name !== this.settings.get("hand"),
    });
    this.telling = new Telling(this);
    this.online = [];
    this.members = {};
    this.target = null;
    /** Who is waited for: another one is not driven instead. */
    this.named = namedBy(location.hash, keptAs(CHOSEN));
    this.offers = { publishers: {}, subscribers: {} };
    this.wishes = [];
    /** How long the work of each of the last frames took, in ms. */
    this.frameMs = [];
    this.frames = 0;
  }

  start() {
    this.#listen();
    this.links.settings(this.settings.values);
    for (const name of ["curve", "scale", "layers"]) this.room.follow(name, this.settings.get(name));
    this.immersion.look();
    this.telling.tell();
    this.stage.renderer.setAnimationLoop((time, frame) => this.#frame(time, frame ?? null));
    setInterval(() => this.#askOffers(), OFFERS_MS);
    setInterval(() => this.telling.tick(), 250);
  }

  /** `kept`: somebody chose it, and means it next time. */
  choose(id, { kept = true } = {}) {
    const target = this.targets.find((each) => each.id === id);
    if (!target || JSON.stringify(target) === JSON.stringify(this.target)) return;
    const other = target.seen !== this.target?.seen;
    this.target = target;
    if (kept) keep(CHOSEN, id);
    if (other) {
      this.offers = { publishers: {}, subscribers: {} };
      this.room.model.clear();
      this.telling.clear();
      this.#wish();
    }
    this.#aim();
    this.#showTargets();
    this.#askOffers();
  }

  /** The one after the chosen one, or before it. */
  step(by) {
    const at = this.targets.findIndex(({ id }) => id === this.target?.id);
    const { length } = this.targets;
    if (length) this.choose(this.targets[(at + by + length) % length].id);
  }

  /** What is said while nobody is chosen. */
  get waiting() {
    return this.named ? `Waiting for ${this.named.replace("/", " ")}` : "No robot is online";
  }

  get targets() {
    return targets(this.online, this.members, this.me);
  }

  // -- each frame ----------------------------------------------------------------------------------------------------

  #frame(time, frame) {
    const began = performance.now();
    const dt = Math.min(0.1, (time - this.#before) / 1000);
    this.#before = time;
    const space = this.stage.renderer.xr.getReferenceSpace();
    const immersive = Boolean(frame && space && this.immersion.session);
    const sources = immersive ? this.input.read(frame, space, this.immersion.session.inputSources) : this.looking.sources();
    if (this.#stopping.read(this.input.stops(sources))) this.stop();
    this.#follows(immersive ? space : null);
    // what hands do goes out before anything is drawn, which takes a while; unless the frame before was not drawn
    const failed = this.#tried(() => this.#point(sources, dt));
    this.#undrawn = failed || this.#undrawn;
    this.#attend();
    const there = !this.#absent;
    const sample = there ? this.input.drive(sources, this.stage.head().facing) : null;
    if (sample) this.#moved = false;
    const posed = there && immersive && this.wanted.size && !this.#moved;
    const poses = posed ? this.input.poses(frame, space, sources, this.wanted) : null;
    this.sample = sample;
    // of who is not there it is not known whether he holds on: that he has let go has to be seen
    if (there) this.#send(sample, poses, began);
    this.#undrawn = failed || this.#tried(() => this.#draw(sources, dt));
    this.#attend();
    this.frames += 1;
    this.frameMs.push(performance.now() - began);
    if (this.frameMs.length > 600) this.frameMs.splice(0, 300);
  }

  /** Do what a frame needs to be drawn; why nothing is drawn, or "". */
  #tried(act) {
    try {
      act();
      return this.stage.lost ? "nothing is drawn: the browser took the graphics away" : "";
    } catch (error) {
      return `nothing is drawn: ${error.message}`;
    }
  }

  /** What rays meet, and which hand has a panel and so does not drive. */
  #point(sources, dt) {
    this.pointing.targets = this.room.targets;
    this.pointing.update(sources, dt);
    this.looking.free(sources, this.pointing.panelUnder("mouse"));
  }

  /** Draw all. Only what was drawn was shown. */
  #draw(sources, dt) {
    this.hands.show(sources, this.pointing.distances, this.telling.state.source);
    this.links.showPictures(this.room, this.wishes, dt);
    this.stage.render();
    if (!this.stage.lost) this.links.acknowledge();
  }

  /** The origin of all poses may move, as when who wears the headset centres his view: what is held then is held elsewhere. */
  #follows(space) {
    if (space === this.#space) return;
    this.#space = space;
    space?.addEventListener("reset", () => space === this.#space && this.#jumped());
    this.#moved = false;
  }

  #jumped() {
    this.#moved = true;
    this.input.letGo();
    this.links.away("the view was centred anew");
    this.links.away(this.#absent);
  }

  #send(sample, poses, at) {
    const idle = sample === null && poses === null && !this.driven;
    this.driven = sample !== null;
    if (idle && at - this.#idleAt < IDLE_MS) return;
    this.#idleAt = at;
    this.links.input(sample, poses, at);
  }

  /** Kinds of poses that have a topic. */
  get wanted() {
    return new Set(Object.keys(POSE_TYPES).filter((kind) => this.settings.get(kind)));
  }

  // -- what somebody does --------------------------------------------------------------------------------------------

  stop() {
    this.overlay.pad.release();
    this.links.stop();
    this.telling.event("stop pressed");
  }

  /** Twice within three seconds: a slip releases nothing. */
  release() {
    if (this.sure) {
      clearTimeout(this.calming);
      this.sure = false;
      this.links.release();
    } else {
      this.sure = true;
      this.calming = setTimeout(() => {
        this.sure = false;
        this.telling.tell();
      }, SURE_MS);
    }
    this.telling.tell();
  }

  #actions() {
    return {
      choose: (id) => this.choose(id),
      enter: (mode) => this.enter(mode),
      stop: () => this.stop(),
      release: () => this.release(),
      control: (action) => this.links.control({ action }),
      give: (to) => this.links.control({ action: "give", to }),
    };
  }

  async enter(mode) {
    this.links.poke(); // others lose their connection on entering
    try {
      await this.immersion.enter(mode);
    } catch (error) {
      this.telling.event(`the browser does not enter: ${error.message}`);
    }
  }

  /** A button of the board was pressed. */
  press(id) {
    const { settings } = this;
    const actions = {
      stop: () => this.stop(),
      release: () => this.release(),
      before: () => this.step(-1),
      after: () => this.step(1),
      take: () => this.links.control({ action: "take" }),
      back: () => this.links.control({ action: "release" }),
      smaller: () => settings.set("scale", Math.max(0.02, settings.get("scale") / 1.6)),
      larger: () => settings.set("scale", Math.min(1, settings.get("scale") * 1.6)),
      flat: () => settings.set("curve", settings.get("curve") > 0 ? 0 : 0.35),
      arrange: () => this.room.arrange(),
      hand: () => settings.set("hand", settings.get("hand") === "left" ? "right" : "left"),
      leave: () => this.immersion.leave(),
    };
    const [, to] = /^give (\d+)$/.exec(id) ?? [];
    if (to) this.links.control({ action: "give", to: Number(to) });
    else actions[id]?.();
    this.telling.tell();
  }

  // -- what happens --------------------------------------------------------------------------------------------------

  #listen() {
    this.links.addEventListener("presence", ({ detail }) => this.#setOnline(detail.robots));
    this.links.addEventListener("access", ({ detail: { kind, reason } }) => {
      this.telling.event(reason);
      if (["changed", "no_token", "ended"].includes(kind)) location.reload();
    });
    this.links.addEventListener("value", ({ detail }) => this.#take(detail));
    this.settings.addEventListener("change", ({ detail: { name, value } }) => this.#follow(name, value));
    this.room.menu.onPress = (id) => this.press(id);
    this.immersion.addEventListener("modes", () => this.overlay.setModes(this.immersion.modes));
    this.immersion.addEventListener("entered", () => this.#immersed(true));
    this.immersion.addEventListener("left", () => this.#immersed(false));
    this.immersion.addEventListener("attention", () => this.#attend());
    document.addEventListener("visibilitychange", () => this.#attend());
    for (const type of ["blur", "focus"]) {
      addEventListener(type, () => {
        this.#blurred = type === "blur";
        this.#attend();
      });
    }
    addEventListener("online", () => this.links.poke());
    navigator.connection?.addEventListener?.("change", () => this.links.poke());
    addEventListener("pagehide", () => this.links.away("the page was closed"));
    addEventListener("pageshow", (event) => event.persisted && location.reload());
    addEventListener("keydown", (event) => {
      if (event.key !== "Escape") return;
      this.stop();
      this.overlay.dialog.close();
    });
    this.canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  }

  #immersed(immersive) {
    this.input.letGo();
    this.overlay.dialog.close();
    this.links.away("the headset was put on or off");
    this.links.away(this.#absent);
    this.stage.setImmersive(immersive);
    this.stage.setReal(this.immersion.mode === "immersive-ar");
    this.links.poke();
    this.#attend();
  }

  /** Whoever is not there any more has let go of everything. */
  #attend() {
    const absent = this.#absence();
    if (absent) this.input.letGo();
    if (absent === this.#absent) return;
    this.#absent = absent;
    this.links.away(absent);
    if (!absent) this.links.poke();
  }

  /** Why nobody sees the scene, or means it with what he holds; empty: somebody does. */
  #absence() {
    const { session } = this.immersion;
    // in XR the window has no focus, and somebody is there all the same
    if (session && !this.immersion.attended) return "the headset is off";
    if (!session && document.hidden) return "the page is hidden";
    if (!session && (this.#blurred || !document.hasFocus())) return "the window lost the focus";
    return this.overlay.dialog.open ? "the settings are open" : this.#undrawn;
  }

  #follow(name, value) {
    this.room.follow(name, value);
    this.links.settings(this.settings.values);
    if (["cameras", "rightEye", "layers", "values"].includes(name)) this.#wish(true);
    if (name === "driveTopic") this.#aim();
  }

  #setOnline(robots) {
    this.online = robots;
    this.#askMembers();
    this.#showTargets();
    this.#chooseFirst();
  }

  #chooseFirst() {
    const id = this.target ? null : firstOf(this.targets, this.named);
    if (id) this.choose(id, { kept: false });
  }

  #showTargets() {
    const shown = this.targets;
    const lost = this.target && !shown.some(({ id }) => id === this.target.id);
    if (lost) shown.push({ ...this.target, label: `${this.target.label} · lost` });
    if (!this.target && this.named) shown.unshift({ id: this.named, label: `${this.waiting} …` });
    this.overlay.setTargets(shown, this.target?.id ?? this.named);
  }

  /** Which robots are in which group. */
  async #askMembers() {
    const mesh = await get("/view/mesh");
    if (!mesh?.robots) return;
    this.members = Object.fromEntries(mesh.robots.map(({ id, group }) => [id, group]));
    this.#chooseFirst(); // a group that was named is known only now
    this.#showTargets();
    if (this.target?.groups.length || this.target?.id.startsWith("group/")) this.choose(this.target.id, { kept: false });
  }

  async #askOffers() {
    const { target } = this;
    if (!target || document.hidden) return;
    const offers = await get(`/view/robots/${target.seen}/offers`);
    if (!offers || offers.error || this.target !== target) return;
    const before = JSON.stringify([this.offers.publishers, this.offers.subscribers]);
    this.offers = { publishers: offers.publishers ?? {}, subscribers: offers.subscribers ?? {} };
    if (JSON.stringify([this.offers.publishers, this.offers.subscribers]) === before) return;
    this.#wish();
    if (this.drive !== JSON.stringify(this.#driveTopic())) this.#aim();
  }

  #driveTopic() {
    return driveTopic(this.offers.subscribers, this.settings.get("driveTopic"), TWIST);
  }

  #aim() {
    const found = this.#driveTopic();
    this.drive = JSON.stringify(found);
    const [topic, type] = found ?? ["", ""];
    this.links.aim({ ...this.target, topic, type });
  }

  #wish(anew = false) {
    const { publishers } = this.offers;
    const { seen } = this.target ?? {};
    const guard = this.target && guardOf(publishers, this.settings.values, SHOWN, this.kept.guards.get(seen), anew);
    if (this.target) this.kept.note(seen, guard);
    this.links.guard(guard ? [pictureKey(seen, guard.topic)] : []);
    this.wishes = this.target ? wishes(seen, publishers, this.settings.values, SHOWN, guard) : [];
    this.room.setPanels(this.wishes.filter(({ eye }) => eye === "left").map(({ panel }) => panel));
    const right = this.wishes.find(({ eye }) => eye === "right")?.panel;
    for (const screen of this.room.screens.values()) screen.setOther(screen.key === right);
    this.links.watch(this.wishes);
  }

  #take(message) {
    if (message.robot !== this.target?.seen) return;
    if (message.shown === "battery") this.telling.setBattery(message);
    else if (message.shown === "text") this.telling.setText(message.topic, message.lines);
    else this.room.model.take(message.shown, message);
  }
}

async function get(path) {
  try {
    const response = await fetch(path, { cache: "no-store" });
    return response.ok ? await response.json() : null;
  } catch {
    return null;
  }
}

function tabStore() {
  try {
    return sessionStorage;
  } catch {
    return null; // a browser that keeps nothing
  }
}

function keep(name, value) {
  try {
    localStorage.setItem(name, value);
  } catch {
    // a browser that keeps nothing
  }
}

function keptAs(name) {
  try {
    return localStorage.getItem(name);
  } catch {
    return null;
  }
}

async function begin() {
  const me = await asked();
  if (me.wanted) return login();
  const scene = new Scene(me);
  window.macsXr = scene; // for tests, and for who looks at it from a console
  scene.start();
}

begin();
