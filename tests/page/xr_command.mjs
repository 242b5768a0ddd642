// node xr_command.mjs FOLDER-OF-MACS.JS < name of a part: runs the checks of that part; fails with the first that does not hold.
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const load = (name) => import(pathToFileURL(`${process.argv[2]}/${name}`));
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

async function begun() {
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
async function later(wire) {
  for (let tries = 0; tries < 60; tries++) {
    await new Promise((resolve) => setTimeout(resolve, 50));
    const said = wire.said();
    if (said.length) return said;
  }
  throw new Error("nothing was said");
}

const parts = {
  async asked() {
    const { time, wire, clock, command } = await begun();
    clock.mean([1, 2]);
    const { name } = clock.ticks;
    assert.deepEqual(wire.said(), [{ to: [1], clock: name }, { to: [2], clock: name }]);
    assert.deepEqual(command({ robots: [1] }).frames[0].clock, undefined, "who has not asked knows nothing of it");
    wire.ask(3, name, 5);
    wire.ask(1, "another", 5);
    assert.deepEqual(wire.said(), [], "of a robot that is not meant, or another clock");
    time.now = 1100;
    let known = null;
    clock.addEventListener("known", ({ detail }) => (known = detail));
    wire.ask(1, name, 5);
    assert.deepEqual(wire.said(), [{ to: [1], clock: name, question: 5, at: 1001 }]);
    assert.deepEqual([clock.tells(1), clock.tells(2), clock.of(1).known], [true, false, false]);
    wire.ask(1, name, 0, true);
    assert.deepEqual([known.robot, known.known, known.maxAgeS], [1, true, 0.2]);
    assert.deepEqual(wire.said(), [], "that was no question");
    const { frames } = command({ robots: [1, 2], madeAt: 1050 });
    assert.deepEqual(frames.map(({ ids, clock: told }) => [ids, told]), [[[1], name], [[2], undefined]]);
    assert.equal(frames[0].number, 501);
    wire.tell("refused", { robot: 1, kind: "no_clock" });
    assert.equal(clock.of(1).known, false);
    time.now += 100;
    assert.deepEqual((await later(wire)).at(-1).clock, name, "hello is said anew");
    wire.ask(1, name, 0, true);
    wire.tell("link", { up: true, resumed: true });
    assert.equal(clock.of(1).known, true);
    wire.tell("link", { up: true, resumed: false });
    assert.equal(clock.of(1).known, false, "another headset's clock");
    clock.close();
  },

  async left() {
    const { KEPT_MS, time, wire, clock, command } = await begun();
    const { name } = clock.ticks;
    clock.mean([1]);
    wire.ask(1, name, 5);
    clock.mean([2]);
    wire.said();
    time.now += 30_000;
    wire.ask(1, name, 6);
    assert.deepEqual(wire.said().map(({ to, question }) => [to, question]), [[[1], 6]], "it is answered as long as it asks");
    assert.equal(command({ robots: [1] }).frames[0].clock, name, "a release after another robot was chosen");
    time.now += KEPT_MS - 1;
    clock.mean([2]);
    assert.ok(clock.tells(1));
    time.now += 2;
    clock.mean([2]);
    assert.ok(!clock.tells(1) && clock.of(1) === null, "and not for ever");
    for (let robot = 10; robot < 1000; robot++) clock.mean([robot]);
    assert.equal(clock.of(10), null, "nor for any number of them");
    clock.close();
  },

  async groups() {
    const { time, wire, clock, command } = await begun();
    const { name } = clock.ticks;
    clock.mean([], [5], [1, 2]);
    assert.deepEqual(wire.said(), [{ to: ["group 5"], clock: name }], "one hello for all of them");
    assert.equal(command({ robots: [], groups: [5] }).frames[0].clock, undefined);
    time.now += 100;
    wire.ask(1, name, 9);
    assert.deepEqual(wire.said(), [{ to: ["group 5"], clock: name, question: 9, at: 1001 }], "this token may name no robot");
    const { frames } = command({ robots: [], groups: [5] });
    assert.deepEqual(frames.map(({ groups, clock: told, number }) => [groups, told, number]), [[[5], name, 1001]]);
    wire.ask(4, name, 11); // a member that is not known to be one
    assert.equal(wire.said()[0].question, 11);
    clock.close();
  },

  async anew() {
    const { EARLY_TICKS, IDLE_MS, MOST_TICKS, time, wire, clock, node, command } = await begun();
    const { name } = clock.ticks;
    let began = 0;
    clock.addEventListener("anew", () => (began += 1));
    clock.mean([1]);
    wire.ask(1, name, 5);
    wire.ask(1, name, 0, true);
    time.now = 1000 + EARLY_TICKS / 10;
    command({ robots: [1] });
    time.now += IDLE_MS - 1;
    clock.mean([1]);
    assert.equal(clock.ticks.name, name, "somebody drives");
    wire.said();
    time.now += 2;
    clock.mean([1]);
    assert.notEqual(clock.ticks.name, name, "nobody does");
    assert.deepEqual([began, node.lastTicks, clock.of(1).known], [1, 0, false]);
    assert.deepEqual(wire.said(), [{ to: [1], clock: clock.ticks.name }]);
    assert.equal(command({ robots: [1] }).frames[0].number, 1);
    clock.mean([2]); // one that is meant no more hears of a new one, too
    const last = clock.ticks.name;
    for (time.now += 1000; time.now < 1e9 && clock.ticks.name === last; time.now += MOST_TICKS / 100) {
      command({ robots: [1] });
      wire.sent.length = 0;
      clock.mean([2]);
    }
    assert.equal(began, 2);
    assert.deepEqual(wire.said().map(({ to }) => to), [[1], [2]]);
    clock.close();
  },

  async never_younger() {
    const { time, wire, clock, node, command } = await begun();
    const { name } = clock.ticks;
    clock.mean([1]);
    wire.ask(1, name, 5);
    time.now = 1500;
    command({ robots: [1] }); // a zero that is said now
    time.now = 1510;
    assert.equal(command({ robots: [1], madeAt: 1400 }).sent, false, "made before it, and it would look 0 ms old");
    assert.deepEqual([node.unsent, wire.sent.length], [1, 0]);
    const numbers = [1505, 1505, 1505].map((madeAt) => command({ robots: [1], madeAt }).frames[0].number);
    assert.deepEqual(numbers, [5051, 5052, 5053], "what is still held is said again");
    command({ robots: [1], madeAt: 9999 });
    assert.ok(command({ robots: [1] }).sent, "a zero always goes, whatever was said of the time before");
    clock.close();
  },
};

const { part } = JSON.parse(readFileSync(0, "utf8"));
await parts[part]();
console.log(JSON.stringify({ held: part }));
