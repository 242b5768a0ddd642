/**
 * What a headset sees: pictures, clouds, maps and all else that robots send, on a socket of their own, in a worker.
 *
 * Only the newest counts: a picture that comes while the one before is decoded or not yet shown replaces the one that waits.
 * How old pictures are is told to the worker of commands directly, past the scene, which may hang.
 */

import { Headset } from "../macs.js";
import { Rate } from "../page/topics.js";
import { Types, numberAt } from "../ros.js";
import { persisted, soon } from "./asking.js";
import { Frames, cloud, joints, map, poseOf, scan, stampMs } from "./decode.js";
import { Freshness, WINDOW_MS } from "./freshness.js";
import { Pictures } from "./pictures.js";
import { Poke } from "./poke.js";

const SILENCE_MS = 3000;
const RETRY_MS = [50, 100, 200, 500, 1000];
const TOLD_MS = 250;
/** What is no picture is shown so often at most. */
const OTHERS_MS = 33;
const VALUE_LINES = 8;
/** Of so many pictures it is known how late they come. */
const LEASTS = 64;

/** One topic of a robot that is received. */
class Watched {
  constructor(wish, least) {
    Object.assign(this, wish);
    this.rate = new Rate();
    this.freshness = new Freshness(least);
    this.waiting = null;
    this.busy = false;
    this.unshown = 0;
    this.readAt = -Infinity;
    this.replaced = 0;
    this.problem = "";
  }
}

export class SightLink {
  #watched = new Map();
  #nodes = new Map();
  #frames = new Map();
  /** key → {ms, at}: how little later than their stamps pictures came, by the time of day, and when that was so. */
  #least;

  /**
   * `tell(message, transfer)` tells the scene, `commands` is the port to the worker of commands, `least` what the page before
   * was told of that.
   */
  constructor({ url, tell, commands, least = [] }) {
    this.#least = new Map(least);
    this.tell = tell;
    this.commands = commands;
    this.types = new Types("", soon);
    this.pictures = new Pictures();
    this.points = 20000;
    this.headset = new Headset(url, { silenceMs: SILENCE_MS, retryMs: RETRY_MS });
    this.poking = new Poke(this.headset);
    this.headset.addEventListener("link", ({ detail }) => this.tell({ op: "link", which: "pictures", ...detail }));
    this.headset.keepConnecting();
    setInterval(() => this.#report(), TOLD_MS);
  }

  poke() {
    return this.poking.ask();
  }

  /** What is wanted now: [{key, robot, topic, type, shown, guards, path}]; what is wanted no more is left. */
  watch(wishes) {
    const wanted = new Map(wishes.map((wish) => [wish.key, wish]));
    for (const [key, one] of this.#watched) {
      const wish = wanted.get(key);
      if (wish && wish.topic === one.topic && wish.robot === one.robot) {
        if (one.guards !== wish.guards) this.#guard(one, wish.guards);
        wanted.delete(key);
        continue;
      }
      this.#leave(one);
    }
    for (const wish of wanted.values()) this.#begin(new Watched(wish, this.#leastOf(wish.key)));
  }

  /** The scene has shown what it was given; of what it has shown before it gives back the room. */
  shown(key, buffers = []) {
    this.pictures.back(buffers);
    const one = this.#watched.get(key);
    if (!one) return;
    one.unshown = 0;
    if (one.waiting) this.#decode(one);
  }

  close() {
    this.headset.close();
  }

  async #begin(one) {
    this.#watched.set(one.key, one);
    this.#guard(one, one.guards);
    const wanted = () => this.#watched.get(one.key) === one;
    const type = await persisted(() => this.types.get(one.type, one.robot), wanted, (text) => (one.problem = text));
    if (!type || !wanted()) return;
    one.problem = "";
    one.reader = type;
    const options = { robots: [one.robot], bufferSize: one.shown === "frames" ? 10 : 1 };
    this.#nodes.set(one.topic, this.headset.subscribe(one.topic, one.type, options, (message) => this.#take(message)));
  }

  /** By this worker's clock, which began when it did; null where it was too long ago. */
  #leastOf(key) {
    const { ms, at } = this.#least.get(key) ?? { at: -Infinity };
    return Math.abs(performance.timeOrigin + performance.now() - at) < WINDOW_MS ? ms - performance.timeOrigin : null;
  }

  #noteLeast() {
    for (const { key, guards, freshness } of this.#watched.values()) {
      if (!guards || freshness.least === null) continue;
      this.#least.delete(key); // the newest is the last one
      this.#least.set(key, { ms: performance.timeOrigin + freshness.least, at: performance.timeOrigin + performance.now() });
    }
    for (const key of this.#least.keys()) if (this.#least.size > LEASTS) this.#least.delete(key);
  }

  #guard(one, guards) {
    one.guards = guards;
    this.commands.postMessage(guards ? { key: one.key, at: null, late: 0 } : { key: one.key });
  }

  #leave(one) {
    this.#watched.delete(one.key);
    this.commands.postMessage({ key: one.key });
    const node = this.#nodes.get(one.topic);
    const others = [...this.#watched.values()].filter(({ topic }) => topic === one.topic);
    if (!others.length) {
      node?.close();
      this.#nodes.delete(one.topic);
    } else if (!others.some(({ robot }) => robot === one.robot)) {
      node?.deregister({ robots: [one.robot] });
    }
  }

  #take(message) {
    const now = performance.now();
    for (const one of this.#watched.values()) {
      if (one.robot !== message.senderId || this.#nodes.get(one.topic)?.nodeName !== message.nodeName) continue;
      one.rate.note(message.data.length, now);
      if (one.waiting) one.replaced += 1;
      if (one.shown === "frames") this.#give(one, message, now);
      else one.waiting = { message, now };
      if (!one.busy && !one.unshown) this.#decode(one);
    }
  }

  async #decode(one) {
    one.busy = true;
    try {
      while (one.waiting && !one.unshown && this.#watched.get(one.key) === one) {
        const { message, now } = one.waiting;
        one.waiting = null;
        await this.#give(one, message, now);
      }
    } finally {
      one.busy = false;
    }
  }

  async #give(one, message, now) {
    try {
      if (one.shown === "picture") await this.#givePicture(one, message, now);
      else await this.#giveOther(one, message, now);
      one.problem = "";
    } catch (error) {
      one.problem = error.message;
    }
  }

  async #givePicture(one, message, now) {
    const picture = one.reader.read(message.data);
    const stamp = stampMs(picture);
    const fresh = one.freshness.note(stamp, now);
    const { bitmap, data, width, height } = await this.pictures.read(picture, one.type.endsWith("/CompressedImage"));
    if (this.#watched.get(one.key) !== one) return bitmap?.close();
    if (fresh && one.guards) this.#tellAge(one, now);
    one.unshown += 1;
    const decodedMs = performance.now() - now;
    const given = { bitmap, data, width, height };
    this.tell({ op: "picture", key: one.key, ...given, stamp, at: performance.timeOrigin + now, decodedMs }, [bitmap ?? data.buffer]);
  }

  #tellAge(one, now) {
    const at = performance.timeOrigin + now;
    this.commands.postMessage({ key: one.key, at, late: one.freshness.ageMs(now) });
  }

  async #giveOther(one, message, now) {
    if (one.shown !== "frames") {
      const pause = OTHERS_MS - (now - one.readAt);
      if (pause > 0) await new Promise((resolve) => setTimeout(resolve, pause));
      if (one.waiting) return; // a newer one has come
      one.readAt = performance.now();
    }
    const value = one.reader.read(message.data);
    const given = this.#value(one, value);
    if (given) this.tell({ op: "value", key: one.key, shown: one.shown, topic: one.topic, robot: one.robot, ...given });
  }

  #value(one, value) {
    const frames = this.#framesOf(one.robot);
    const frame = value.header?.frame_id ?? "";
    switch (one.shown) {
      case "pose":
        return { pose: poseOf(value), child: value.child_frame_id ?? "" };
      case "scan":
        return { ...scan(value), frame, place: frames.place(frame) };
      case "cloud":
        return { ...cloud(value, this.points), frame, place: frames.place(frame) };
      case "map":
        return { ...map(value), frame };
      case "frames":
        return this.#takeFrames(one, value, frames);
      case "joints":
        return { joints: joints(value) };
      case "battery":
        return { percentage: value.percentage, voltage: value.voltage, current: value.current };
      default:
        return { lines: lines(one.reader, value) };
    }
  }

  #takeFrames(one, value, frames) {
    frames.take(value);
    const now = performance.now();
    if (now - one.readAt < 2 * OTHERS_MS) return null;
    one.readAt = now;
    return { frames: frames.all() };
  }

  #framesOf(robot) {
    if (!this.#frames.has(robot)) this.#frames.set(robot, new Frames());
    return this.#frames.get(robot);
  }

  #report() {
    const now = performance.now();
    const topics = [...this.#watched.values()].map((one) => ({
      key: one.key,
      ...one.rate.now(now),
      pictureAgeMs: one.shown === "picture" ? one.freshness.ageMs(now) : null,
      replaced: one.replaced,
      problem: one.problem || (this.#nodes.get(one.topic)?.refusals.get(one.robot)?.reason ?? ""),
    }));
    const { connected, id, badMessages } = this.headset;
    this.#noteLeast();
    this.tell({ op: "rates", topics, connected, id, badMessages, least: [...this.#least] });
  }
}

/** The first numbers of a message as text: `voltage 24.1`. */
function lines(type, value) {
  const found = type.numbers().slice(0, VALUE_LINES + 4);
  const shown = found.filter((path) => !path.startsWith("header.stamp")).slice(0, VALUE_LINES);
  const texts = shown.map((path) => `${path} ${Number(numberAt(value, path)?.toFixed(3))}`);
  for (const { name, type: kind, isArray } of type.fields) {
    if (kind === "string" && !isArray && texts.length < VALUE_LINES) texts.unshift(`${name} ${String(value[name]).slice(0, 80)}`);
  }
  return texts;
}
