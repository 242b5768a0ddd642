// What stands for a headset and its gateway in checks of commands that run in node, with robots that answer.
import { pathToFileURL } from "node:url";

export const load = (name) => import(pathToFileURL(`${process.argv[2]}/${name}`));
const text = (data) => JSON.parse(new TextDecoder().decode(data));

/** What a clock and a publisher need of a headset: frames that they send are in `sent`. */
class Wire extends EventTarget {
  id = 7;
  nodes = [];
  sent = [];

  sendNow(frames) {
    this.sent.push(...frames());
    return true;
  }

  sendIfOnline(one) {
    return this.sendNow(() => [one()]);
  }

  tell(type, detail) {
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }

  /** What was sent of clocks since the last time: [{to, ...what was said}]. */
  said() {
    const frames = this.sent.splice(0).filter(({ meta }) => meta?.messageManager === "CommandClock");
    return frames.map(({ ids = [], groups = [], data }) => ({ to: [...ids, ...groups.map((group) => `group ${group}`)], ...text(data) }));
  }

  /** A robot asks, or says that it knows. */
  ask(robot, clock, question, known = false) {
    const data = new TextEncoder().encode(JSON.stringify({ clock, question, known, maxAgeS: 0.2 }));
    this.tell("message", { manager: "CommandClock", senderType: 1, senderId: robot, data });
  }
}

export async function begun() {
  const { CommandClock, ...rest } = await load("macs-clock.js");
  const { Publisher } = await load("macs-nodes.js");
  const time = { now: 1000 };
  const wire = new Wire();
  const clock = new CommandClock(wire, { now: () => time.now });
  const node = new Publisher(wire, "/cmd_vel", "geometry_msgs/Twist", {});
  wire.nodes.push(node);
  /** The frames of one command: [{to, number, clock}]. */
  const command = (to) => {
    wire.sent.length = 0;
    const sent = node.publish(new Uint8Array(8), to);
    const frames = wire.sent.splice(0).map(({ ids, groups, meta }) => ({ ids, groups, number: meta.requestId, clock: meta.clock }));
    return { sent, frames };
  };
  return { ...rest, time, wire, clock, node, command };
}

/** Wait until the clock has said something by its own timer. */
export async function later(wire) {
  for (let tries = 0; tries < 60; tries++) {
    await new Promise((resolve) => setTimeout(resolve, 50));
    const said = wire.said();
    if (said.length) return said;
  }
  throw new Error("nothing was said");
}

/** What a `CommandLink` needs of a headset; robots that are `here` are online. */
export class Gateway extends Wire {
  connected = true;
  waitingBytes = 0;
  roundTripMs = 1;
  joins = 1;
  here = [];
  drops = 0;
  answers = true;

  forget(node) {
    this.nodes = this.nodes.filter((each) => each !== node);
  }

  async online({ timeoutMs = 50 } = {}) {
    if (this.answers) return { robots: this.here, headsets: [7] };
    await pause(timeoutMs);
    throw Object.assign(new Error("no answer"), { kind: "timeout" });
  }

  keepConnecting() {}
  follow() {}
  isFresh() {
    return true;
  }

  drop() {
    this.drops += 1;
  }

  close() {
    this.connected = false;
  }

  come(...robots) {
    this.here = robots;
    this.tell("presence", { robots });
  }

  /** Commands that were sent since the last time, and poses: [{ids, groups, x, said}]. */
  commands() {
    const found = this.sent.splice(0).filter(({ meta, data }) => meta?.nodeType === 2 && data.length > 5);
    const read = (said) => ({ x: (said.twist ?? said).linear?.x ?? 0, said });
    return found.map(({ ids, groups, data }) => ({ ids, groups, ...read(text(data)) }));
  }
}

export const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

export async function until(holds) {
  for (let tries = 0; tries < 400; tries++) {
    if (holds()) return;
    await pause(10);
  }
  throw new Error(`not within 4 s: ${holds}`);
}

/** A `CommandLink` that drives: its robots answer `status`, `events` is what it says. */
export async function linked(more = {}) {
  globalThis.WebSocket ??= class {};
  const { Publisher, Subscription } = await load("macs-nodes.js");
  const { CommandLink } = await load("xr/command-link.js");
  const headset = new Gateway();
  const add = (Kind, topic, type, { robots = [], groups = [] } = {}, ...rest) => {
    let node = headset.nodes.find((each) => each instanceof Kind && each.name === topic);
    if (!node) headset.nodes.push((node = new Kind(headset, topic, type, {}, ...rest)));
    return node.register({ robots, groups });
  };
  headset.advertise = (...rest) => add(Publisher, ...rest);
  headset.subscribe = (topic, type, options, then) => add(Subscription, topic, type, options, then);
  const write = (value) => new TextEncoder().encode(JSON.stringify(value));
  const types = { get: async () => ({ write }), forget() {} };
  const status = {};
  const told = { events: [], state: {} };
  const tell = (message) => (message.op === "event" ? told.events.push(message.text) : Object.assign(told[message.op] ?? {}, message));
  const ask = async (path) => status[path.split("/")[3]] ?? null;
  const me = { may: ["command", "stop", "view"], robots: "any", groups: "any" };
  const link = new CommandLink({ url: "", me, kept: null, tell, headset, types, ask, ...more });
  link.set({ forward: 1, turn: 1, hz: 30, lockoutS: 0 });
  const aim = (robots, others = {}) => link.aim({ robots, topic: "/cmd_vel", type: "geometry_msgs/msg/Twist", seen: robots[0], ...others });
  const sample = { source: "right", forward: 1, turn: 0 };
  const grip = (at = performance.now(), poses = null) => link.input({ at, sample, poses });
  const free = (at = performance.now()) => link.input({ at, sample: null });
  const drive = async () => {
    await until(() => {
      free();
      grip();
      return told.state.held;
    });
    headset.commands();
  };
  return { headset, link, status, told, aim, grip, free, drive };
}
