// node xr_command.mjs FOLDER-OF-MACS.JS < name of a part: runs the checks of that part; fails with the first that does not hold.
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { begun, Gateway, later, linked, load, pause, until } from "./xr_wire.mjs";

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

  async late() {
    const { headset, link, told, aim, grip, free, drive } = await linked();
    headset.come(1);
    aim([1]);
    await drive();
    const now = performance.now();
    grip(now - 300);
    assert.equal(told.state.held, false, "what is told so late ends it");
    assert.match(told.state.why, /too late/);
    assert.deepEqual(headset.commands().map(({ x }) => x), [0]);
    free(now - 150);
    grip(now - 100);
    assert.equal(told.state.held, false, "what hands did before the zero does not come after it");
    assert.deepEqual(headset.commands(), []);
    await drive();
    const ends = performance.now() + 400;
    while (performance.now() < ends); // the worker stands still, and what was told meanwhile waits
    for (let at = ends - 390; at < ends - 210; at += 20) grip(at);
    free(ends - 100);
    grip(ends - 90);
    const said = headset.commands();
    assert.ok(said.every(({ x }) => x === 0), JSON.stringify(said));
    free();
    grip();
    assert.ok(link && headset.commands().some(({ x }) => x === 1), "taken hold of anew");
  },

  async stamped() {
    const { headset, link, aim, grip, free, drive } = await linked();
    headset.come(1);
    link.set({ forward: 1, turn: 1, hz: 30, lockoutS: 0, head: "/xr/head", poseHz: 90 });
    aim([1], { type: "geometry_msgs/msg/TwistStamped" });
    const real = Date.now;
    for (const step of [0, 36e5, -36e5]) {
      Date.now = () => real() + step; // somebody set the clock, or the machine slept
      await drive();
      const said = [];
      const take = () => said.push(...headset.commands());
      await until(() => {
        grip(performance.now(), { head: { pose: {} } });
        take();
        return said.some(({ x }) => x === 1) && said.some((each) => each.said.pose);
      });
      free();
      assert.ok(take() > 2 && said.at(-1).x === 0);
      const off = said.map((each) => Date.now() - each.said.header.stamp.sec * 1000);
      assert.ok(off.every((ms) => Math.abs(ms) < 6e4), `${step}: ${off}`);
    }
  },

  async owed() {
    const { headset, told, aim, drive, free } = await linked();
    headset.come(1, 2);
    aim([1, 2]);
    await drive();
    headset.come(1);
    free();
    await pause(120); // the zeros that are said in any case
    const zeros = () => headset.commands().flatMap(({ ids }) => ids);
    assert.ok(zeros().filter((id) => id === 1).length >= 4, "who is there is told once more, whoever else is not");
    await pause(600);
    assert.deepEqual(zeros(), [], "once");
    aim([3]);
    headset.come(1, 2);
    await until(() => zeros().includes(2));
    assert.equal(told.events.length, 0);
    const { DEBT_MS, Debts } = await load("shared/owed.js");
    const debts = new Debts([1, 2], 0);
    assert.deepEqual([debts.pay([2, 3]), debts.pay([2, 3]), debts.robots], [[2], null, [1]]);
    assert.ok(debts.isOpen(DEBT_MS - 1) && !debts.isOpen(DEBT_MS), "not for ever");
    assert.deepEqual(new Debts([], 0).pay([]), [], "a group whose robots nobody knows");
  },

  async owed_to_a_group() {
    const { headset, aim, drive, free } = await linked();
    headset.come(1);
    aim([], { groups: [5], members: [1, 2], seen: 1 });
    await drive();
    headset.come();
    free();
    await pause(120);
    headset.commands();
    await pause(600);
    assert.deepEqual(headset.commands(), [], "nobody of it is there");
    headset.come(2);
    await until(() => headset.commands().some(({ groups, ids }) => groups.includes(5) && !ids.length));
  },

  async no_router() {
    const { headset, told, aim, grip, drive } = await linked();
    headset.come(1); // for its gateway it is there until it is known again who is
    aim([1]);
    await drive();
    const lost = () => headset.tell("refused", { robot: 1, name: "/cmd_vel", kind: "no_route", reason: "no router" });
    lost();
    assert.equal(told.state.held, false);
    assert.match(told.state.why, /went nowhere/);
    const telling = setInterval(lost, 300);
    await pause(1000);
    clearInterval(telling);
    const said = headset.commands();
    const zeros = () => said.push(...headset.commands()) - before;
    const before = said.length;
    await until(() => {
      grip(); // held all the while
      return zeros() >= 3;
    });
    assert.ok(said.every(({ x }) => x === 0), "who holds on drives on with another hold");
    await pause(2200);
    zeros();
    const now = said.length;
    await pause(1500);
    assert.ok(said.length + headset.commands().length - now <= 1, "no more than to one that comes back late");
    await drive();
  },

  async stood() {
    const { headset, status, told, aim, grip, free, drive } = await linked();
    headset.come(1);
    const says = (trips) => (status[1] = { nodes: [{ name: "/cmd_vel", deadman: { silence_s: 0.5, trips } }], stopped: false });
    says(3);
    aim([1]);
    await drive();
    const hold = () => {
      if (!told.state.held && /stood still/.test(told.state.why)) free(); // so did this process: it is held anew
      grip();
    };
    const holding = setInterval(hold, 20);
    await pause(1200);
    await until(() => told.state.held); // it has acted before
    says(4);
    await until(() => !told.state.held && /dead-man has acted/.test(told.state.why));
    await pause(100);
    assert.equal(told.state.held, false, "held still");
    clearInterval(holding);
    says(5); // as it does after each hold
    await drive();
    const again = setInterval(hold, 20);
    await pause(1200);
    await until(() => told.state.held);
    clearInterval(again);
  },

  async grouped() {
    const { headset, link, status, told, aim, drive } = await linked();
    headset.come(1, 2, 3);
    status[1] = { nodes: [], stopped: false };
    status[2] = { nodes: [{ name: "/cmd_vel", control: { holder: "unity/9", seconds_left: 1 } }], stopped: false };
    aim([], { groups: [5], members: [1, 2], seen: 1 });
    await until(() => told.state.barred === "headset 9 has control");
    assert.ok(told.state.byGroup);
    await link.control({ action: "take" });
    assert.match(told.events.at(-1), /this token names groups only/);
    status[2] = { nodes: [], stopped: true };
    link.halt.said.clear();
    await until(() => told.state.barred === "the robot is stopped");
    status[2].stopped = false;
    link.halt.said.clear();
    await drive();
    headset.come(3);
    assert.equal(told.state.barred, "the robot is not online");
  },

  async too_many() {
    const { headset, told, aim, free, grip, drive } = await linked();
    const robots = Array.from({ length: 65 }, (_, at) => at + 1);
    headset.come(...robots);
    aim(robots);
    free();
    grip();
    assert.match(told.state.barred, /65 robots are too many: at most 64/);
    assert.deepEqual(headset.commands(), []);
    aim(robots.slice(1));
    await drive();
    free();
    assert.equal(new Set(headset.commands().flatMap(({ ids }) => ids)).size, 64, "all of them");
  },

  async standing() {
    const { Standing } = await load("xr/standing.js");
    const open = [];
    let most = 0;
    const ask = (path) => new Promise((resolve) => (most = Math.max(most, open.push({ path, resolve }))));
    let rounds = 0;
    const standing = new Standing({ ask, told() {}, done: () => (rounds += 1) });
    standing.mean([1, 2, 3, 4], "/cmd_vel");
    const running = standing.round();
    for (let more = 0; more < 10; more++) standing.round({ anew: false });
    const answer = async (value) => {
      open.shift().resolve(value);
      await pause(1);
    };
    const mine = { nodes: [{ name: "/cmd_vel", control: { holder: "unity/7", seconds_left: 1 } }] };
    for (let more = 0; more < 4; more++) await answer(mine);
    await running;
    assert.deepEqual([rounds, most, open.length], [1, 3, 0], "one round at a time");
    assert.equal(standing.said.get(4).holder, "unity/7");
    standing.round();
    standing.round();
    for (let more = 0; more < 4; more++) await answer(more ? mine : { error: "it does not answer" });
    assert.equal(standing.said.get(1), null, "what it said before is not shown on");
    assert.equal(open.length, 3, "what happened meanwhile is asked for");
    standing.mean([9], "/other");
    for (let more = 0; more < 4; more++) await answer(mine);
    assert.equal(standing.said.has(2), false, "of others");

    const { headset, status, told, aim } = await linked();
    headset.come(1);
    status[1] = mine;
    aim([1]);
    await until(() => told.state.holder === "you");
    delete status[1];
    await until(() => told.state.holder === null && told.state.unknown.join() === "1");
  },

  async compared() {
    const { headset, link, status, told, aim, drive } = await linked();
    headset.come(1, 2);
    status[1] = { nodes: [], max_timed_command_age_s: 0.2 };
    status[2] = { nodes: [] };
    aim([1]);
    await until(() => told.state.barred === "robot 1 has not compared clocks yet");
    headset.ask(1, link.clock.ticks.name, 5);
    headset.ask(1, link.clock.ticks.name, 0, true);
    await drive();
    link.clock.dispatchEvent(new Event("anew"));
    assert.deepEqual([told.state.held, told.state.why], [false, "another clock begins"]);
    aim([2]);
    await until(() => told.state.clockless?.join() === "2");
    assert.equal(told.state.barred, "", "a robot of before");
  },

  async types() {
    const { persisted } = await load("xr/asking.js");
    const said = [];
    let tries = 0;
    const attempt = async () => {
      if ((tries += 1) < 4) throw new Error("nobody knows it");
      return "a type";
    };
    assert.equal(await persisted(attempt, () => true, (text) => said.push(text), 1), "a type");
    assert.deepEqual(said, ["nobody knows it"]);
    tries = -1000;
    assert.equal(await persisted(attempt, () => tries < -990, () => {}, 1), null, "as long as it is wanted");
    let known = false;
    const write = (value) => new TextEncoder().encode(JSON.stringify(value));
    const get = async () => {
      if (!known) throw new Error("nobody knows it");
      return { write };
    };
    const { headset, told, aim, drive } = await linked({ types: { get, forget() {} } });
    headset.come(1);
    aim([1]);
    await until(() => told.events.includes("nobody knows it"));
    known = true;
    await until(() => told.state.barred === "");
    await drive();
  },

  async poke() {
    const { Poke } = await load("xr/poke.js");
    const headset = new Gateway();
    const poke = new Poke(headset, { answerMs: 30, joinMs: 30 });
    await Promise.all([poke.ask(), poke.ask()]);
    assert.equal(headset.drops, 0, "it answers");
    headset.answers = false;
    await Promise.all([poke.ask(), poke.ask(), poke.ask()]);
    assert.equal(headset.drops, 1, "one question at a time");
    const asked = poke.ask();
    headset.joins += 1; // it was lost meanwhile, and another one is there
    await asked;
    assert.equal(headset.drops, 1, "not the one that has just been made");
    headset.connected = false;
    await poke.ask();
    assert.equal(headset.drops, 2, "one that hangs as it is made");
    const hanging = poke.ask();
    headset.connected = true;
    await hanging;
    assert.equal(headset.drops, 2);
  },
};

const { part } = JSON.parse(readFileSync(0, "utf8"));
await parts[part]();
console.log(JSON.stringify({ held: part }));
process.exit(0); // what it began goes on
