// node xr_pure.mjs FOLDER-OF-MACS.JS < name of a part: runs the checks of that part; fails with the first that does not hold.
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { mock } from "node:test";
import { pathToFileURL } from "node:url";

const load = (name) => import(pathToFileURL(`${process.argv[2]}/${name}`));
const near = (one, other, by = 1e-6) => assert.ok(Math.abs(one - other) <= by, `${one} is not ${other}`);
const half = Math.SQRT1_2;

/** What begins a stop, whose robots say things, and are asked by `ask` or give their `status`. */
async function halts() {
  const { Halt } = await load("shared/halt.js");
  const me = { may: ["stop"], robots: "any", groups: "any" };
  return (ask = null) => {
    const headset = new EventTarget();
    const node = { robots: new Set(), register() {}, deregister() {} };
    const sent = [];
    let take;
    headset.connected = true;
    headset.subscribe = (_topic, _type, _options, listener) => ((take = listener), node);
    headset.advertise = () => ({ ...node, publish: (data, { robots }) => sent.push([data[4], ...robots]) });
    const status = new Map();
    const halt = new Halt(headset, me, null, ask ?? (async (robot) => status.get(robot)));
    const says = (senderId, stopped) => take({ senderId, data: new Uint8Array([0, 1, 0, 0, Number(stopped)]) });
    const link = (up) => {
      headset.connected = up;
      headset.dispatchEvent(new CustomEvent("link", { detail: { up } }));
    };
    const words = () => halt.words(headset.connected);
    const check = () => halt.check(performance.now() + 2000);
    return { halt, says, link, words, sent, status, check };
  };
}

const parts = {
  async axes() {
    const { heading, orientation, position, pose, toScene } = await load("xr/axes.js");
    const { stamp, wallTime } = await load("shared/twist.js");
    assert.deepEqual(position({ x: 0, y: 0, z: -1 }), { x: 1, y: 0, z: 0 }); // ahead
    assert.deepEqual(position({ x: 1, y: 0, z: 0 }), { x: 0, y: -1, z: 0 }); // right
    assert.deepEqual(position({ x: 0, y: 1, z: 0 }), { x: 0, y: 0, z: 1 }); // up
    near(heading(orientation({ x: 0, y: half, z: 0, w: half })), Math.PI / 2); // to the left, about up
    assert.deepEqual(orientation({ x: half, y: 0, z: 0, w: half }), { x: 0, y: -half, z: 0, w: half }); // up: about -left
    assert.deepEqual(orientation({ x: 0, y: 0, z: half, w: half }), { x: -half, y: 0, z: 0, w: half });
    for (const at of [{ x: 1, y: 2, z: 3 }, { x: -4, y: 0.5, z: 9 }]) {
      const [x, y, z] = toScene(position(at));
      assert.deepEqual({ x, y, z }, at);
    }
    const made = pose({ position: { x: 1, y: 2, z: 3 }, orientation: { x: 0, y: 0, z: 0, w: 1 } });
    assert.deepEqual(made, { position: { x: -3, y: -1, z: 2 }, orientation: { x: 0, y: 0, z: 0, w: 1 } });
    assert.deepEqual(stamp(1500.25), { sec: 1, nanosec: 500250000 });
    assert.ok(stamp(1999.9999999).nanosec <= 999999999);
    assert.equal(wallTime(1000, 1250, 5e12, 0), 5e12 - 250, "made 250 ms ago");
    assert.equal(wallTime(1000, 1250.75, 5e12, 5e12 - 1250), 5e12 - 250, "within the millisecond that the clock says");
    assert.equal(wallTime(1000, 1250, 5e12, 6e12), 5e12 - 249, "the clock was set back");
  },

  async turns() {
    const { shownNow } = await load("xr/turns.js");
    const [quick, slow] = [0.014, 0.033];
    assert.deepEqual(shownNow([], quick), []);
    assert.deepEqual(shownNow([["a", "a"]], quick), ["a"], "one camera waits for nobody");
    assert.deepEqual(shownNow([["a", "a"], ["b", "b"]], quick), ["a"], "one frame uploads one of two");
    assert.deepEqual(shownNow([["b", "b"]], quick), ["b"], "and the next frame the other one");
    assert.deepEqual(shownNow([["a", "a"], ["b", "b"]], slow), ["a", "b"], "the next frame would be late");
    assert.deepEqual(shownNow([["left", "a"], ["b", "b"], ["right", "a"]], quick), ["left", "right"], "two eyes of one panel");
    const six = ["a", "b", "c", "d", "e", "f"].map((each) => [each, each]);
    assert.deepEqual(shownNow(six, quick), ["a", "b", "c"], "six cameras at 30 Hz need more than one a frame");
    assert.deepEqual(shownNow([["gone", undefined]], quick), ["gone"], "what nobody looks at is closed");
  },

  async due() {
    const { Driver } = await load("shared/driver.js");
    mock.timers.enable({ apis: ["setTimeout", "Date"], now: 1000 });
    performance.now = () => Date.now();
    const sent = [];
    const publish = (_message, { madeAt }) => sent.push({ at: Date.now(), age: Date.now() - madeAt });
    const node = { robots: new Set([1]), groups: new Set(), lastMadeAt: -Infinity, publish };
    const headset = Object.assign(new EventTarget(), { clock: new EventTarget(), waitingBytes: 0, isFresh: () => true });
    headset.advertise = () => node;
    const driver = new Driver({ headset, bars: () => "", changed() {}, say() {} });
    driver.limits = { forward: 1, turn: 1, hz: 30 };
    const to = { topic: "/cmd_vel", type: "geometry_msgs/msg/Twist", robots: [1], groups: [], members: [1] };
    driver.aim(to, async () => ({ write: () => new Uint8Array(1) }));
    await Promise.resolve();
    await Promise.resolve();
    driver.input(null, Date.now());
    const driven = (ms, everyMs) => {
      sent.length = 0;
      for (let at = 0; at < ms; at++) {
        mock.timers.tick(1);
        if (at % everyMs === 0) driver.input({ source: "right", forward: 1, turn: 0 }, Date.now());
      }
      return sent.map(({ age }) => age);
    };
    const quick = driven(1400, 14);
    assert.ok(quick.every((age) => age === 0), `what hands do goes out in the frame that read it: ${quick}`);
    assert.ok(quick.length >= 40 && quick.length <= 44, `at thirty a second, ${quick.length} in 1.4 s`);
    driven(400, 40);
    const same = driven(1400, 40);
    assert.ok(same.filter((age) => age === 0).length === 35 && same.length <= 42, `each of slower frames: ${same}`);
    const slow = driven(1400, 150);
    assert.ok(slow.length > 30, `who reads hands seldom says again what they did: ${slow}`);
    const first = slow.filter((age, at) => at === 0 || age < slow[at - 1]);
    assert.ok(first.length >= 9 && first.every((age) => age <= 34), `and what they do now when the next is due: ${slow}`);
    driver.limits = { ...driver.limits, hz: 5 };
    driven(500, 14);
    while (!driven(14, 14).length); // one has just been sent: the next is due in 0.2 s
    driver.limits = { ...driver.limits, hz: 90 };
    assert.ok(driven(28, 14).length, "who is set to send more often does so at once");
  },

  async hold() {
    const { Hold, STILL_MS } = await load("shared/hold.js");
    const sample = (source = "right", forward = 1) => ({ source, forward, turn: 0 });
    const free = () => {
      const hold = new Hold();
      hold.bar("");
      hold.input(null, 0);
      return hold;
    };
    const first = new Hold();
    first.bar("");
    assert.equal(first.input(sample(), 0), false, "held since before it counts");
    const hold = free();
    assert.equal(hold.input(sample(), 1), true);
    assert.deepEqual(hold.due(2), { forward: 1, turn: 0 });
    hold.input(sample("right", 7), 3);
    assert.equal(hold.forward, 1);
    hold.input(sample("right", NaN), 4);
    assert.equal(hold.forward, 0);
    hold.input(null, 5);
    assert.equal(hold.due(6), null);
    assert.equal(hold.zeros, 1);
    for (const end of [
      (each) => each.bar("the picture is old") ?? each.bar(""),
      (each) => each.release("a stop"),
      (each) => each.input(sample("left"), 20),
      (each) => each.due(10 + STILL_MS + 1),
    ]) {
      const one = free();
      assert.ok(one.input(sample(), 10));
      end(one);
      assert.equal(one.held, false);
      assert.equal(one.zeros, 1, "one zero for each end");
      for (const source of ["right", "left"]) assert.equal(one.input(sample(source), 21), false, "still held, and not taken anew");
      one.input(null, 22);
      assert.ok(one.input(sample(), 23), "taken anew");
    }
    const late = free();
    late.input(sample(), 10);
    assert.equal(late.input(sample(), 10 + STILL_MS + 1), false, "a scene that hung drives nothing when it goes on");
    assert.equal(late.held, false);
    const barred = free();
    barred.bar("somebody else has control");
    assert.equal(barred.input(sample(), 1), false);
    barred.bar("");
    assert.equal(barred.input(sample(), 2), false, "pressed while it was barred");
  },

  async freshness() {
    const { Freshness, lockout } = await load("xr/freshness.js");
    const seen = new Freshness();
    assert.equal(seen.ageMs(0), null);
    assert.equal(seen.note(5e9 - 100, -80), false, "the first one may be the last one of a camera that hangs");
    assert.equal(seen.ageMs(-80), null);
    for (let at = 0; at < 1000; at += 100) assert.ok(seen.note(5e9 + at, at + 20)); // whatever the clocks say
    assert.equal(seen.ageMs(920), 0);
    assert.equal(seen.ageMs(1250), 330);
    assert.equal(seen.note(5e9 + 900, 1300), false, "the same picture again");
    assert.equal(seen.ageMs(1300), 380);
    assert.ok(seen.note(5e9 + 1000, 1520)); // 0.5 s later after its stamp than the others
    assert.equal(seen.ageMs(1520), 500);
    assert.ok(seen.note(5e9 + 1600, 1620));
    assert.equal(seen.ageMs(1620), 0, "it comes back by itself");
    const bare = new Freshness();
    assert.ok(bare.note(0, 10) && bare.note(0, 20), "pictures without a time are told apart by nothing");
    assert.equal(bare.ageMs(25), 5);
    const after = new Freshness();
    after.note(1000, 1000);
    after.note(101000, 131500);
    after.note(131000, 162000);
    assert.equal(after.ageMs(162000), 500, "who was quickest a minute ago counts no more");
    const again = new Freshness(seen.least);
    again.note(5e9 + 2000, 2400);
    again.note(5e9 + 2100, 2500);
    assert.equal(again.ageMs(2500), 380, "as late as it is, also for who has just come");
    assert.equal(new Freshness().least, null);
    assert.equal(lockout([100, 299], 300), "");
    assert.match(lockout([100, 301], 300), /0\.3 s old/);
    assert.match(lockout([null], 300), /no picture/);
    assert.equal(lockout([5000], 0), "");
    assert.equal(lockout([], 300), "");
  },

  async kept() {
    const { KeptGuards } = await load("xr/kept-guards.js");
    const store = () => ({ getItem: (name) => store.kept?.[name] ?? null, setItem: (name, text) => (store.kept = { [name]: text }) });
    const kept = new KeptGuards(store());
    kept.note(1, { topic: "/camera", type: "sensor_msgs/msg/Image" });
    kept.note(2, null);
    kept.noteLeast([["1 /camera picture", { ms: 20, at: 1000 }]]);
    const after = new KeptGuards(store());
    assert.deepEqual([...after.guards], [[1, { topic: "/camera", type: "sensor_msgs/msg/Image" }]]);
    assert.deepEqual(after.least, kept.least);
    for (let robot = 10; robot < 1000; robot++) after.note(robot, { topic: "/camera", type: "" });
    assert.equal(new KeptGuards(store()).guards.size, 64, "bounded");
    for (const bad of ["{", "null", "[]", '{"guards": {}}', '{"guards": [[1, {"topic": 7}], null, 5], "least": [["x", {"ms": null}]]}']) {
      const one = new KeptGuards({ getItem: () => bad, setItem() {} });
      assert.deepEqual([one.guards.size, one.least], [0, []], bad);
    }
    assert.equal(new KeptGuards(null).guards.size, 0);
  },

  async gestures() {
    const all = await load("xr/gestures.js");
    const pad = (pressed, axes = [0, 0, 0, 0]) => ({
      axes,
      buttons: Array.from({ length: 6 }, (_, at) => ({ pressed: pressed.includes(at), value: pressed.includes(at) ? 1 : 0 })),
    });
    assert.equal(all.stickDrive(pad([], [0, 0, 0, -1])), null, "without its grip");
    assert.deepEqual(all.stickDrive(pad([1], [0, 0, 0, -1])), { forward: 1, turn: 0 });
    assert.deepEqual(all.stickDrive(pad([1], [0, 0, -1, 0])), { forward: 0, turn: 1 });
    assert.deepEqual(all.stickDrive(pad([1], [0, 0, 0.05, 0.05])), { forward: 0, turn: 0 });
    assert.equal(all.stickDrive(undefined), null);
    assert.ok(all.stopButtons(pad([4, 5])) && !all.stopButtons(pad([4])) && !all.stopButtons(undefined));
    const tip = (x) => ({ x, y: 0, z: 0 });
    const hand = (index, little) => ({ "thumb-tip": tip(0), "index-finger-tip": tip(index), "pinky-finger-tip": tip(little) });
    assert.ok(all.pinched(hand(0.01, 0.1)) && !all.pinched(hand(0.03, 0.1)) && all.pinched(hand(0.03, 0.1), true));
    assert.ok(all.stopHand(hand(0.08, 0.01)) && !all.stopHand(hand(0.01, 0.01)) && !all.stopHand({}));
    const from = { x: 0, y: 1, z: 0 };
    const moved = (x, z, facing) => all.handDrive(from, { x, y: 1, z }, facing);
    assert.deepEqual(moved(0.01, 0.01, 0), { forward: 0, turn: 0 });
    near(moved(0, -0.3, 0).forward, 1);
    near(moved(-0.3, 0, 0).turn, 1); // to the left
    near(moved(-0.3, 0, Math.PI / 2).forward, 1); // who looks to the left
    near(moved(0, 0.3, Math.PI / 2).turn, 1);
    const joy = all.joy(pad([0, 5], [0, 0, 0.5, -1]), undefined);
    assert.deepEqual(joy.axes, [-0.5, 1, 0, 0, 1, 0, 0, 0]);
    assert.deepEqual(joy.buttons, [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0]);
  },

  async settings() {
    const { SETTINGS, Settings } = await load("xr/settings.js");
    const store = (text) => ({ text, getItem: () => store.text ?? text, setItem: (_, value) => (store.text = value) });
    const defaults = new Settings(store(null)).values;
    assert.deepEqual(Object.keys(defaults), Object.keys(SETTINGS));
    for (const bad of ["{", "null", "[]", '{"forward": 1e9, "turn": "x", "cameras": {"a": 1}}', '{"layers": [1]}', "x".repeat(9000)]) {
      assert.deepEqual(new Settings(store(bad)).values, defaults, bad.slice(0, 40));
    }
    const kept = new Settings(store('{"forward": 1.5, "head": "/xr/head", "left": "no topic!"}'));
    assert.deepEqual([kept.get("forward"), kept.get("head"), kept.get("left")], [1.5, "/xr/head", ""]);
    assert.ok(kept.set("turn", 2) && !kept.set("turn", 100) && !kept.set("hand", "third"));
    assert.equal(JSON.parse(store.text).turn, 2);
  },

  async decode() {
    const { Frames, cloud, joints, map, scan } = await load("xr/decode.js");
    const round = (values) => Array.from(values, (value) => Math.round(value * 1000) / 1000 || 0);
    const ranges = Float32Array.of(1, 2, Infinity, NaN, 0.01, 3);
    const laser = { ranges, angle_min: 0, angle_increment: Math.PI / 2, range_min: 0.1, range_max: 10 };
    assert.deepEqual(round(scan(laser).points), [0, 0, -1, -2, 0, 0, -3, 0, 0]); // ahead, to the left, once more to the left
    assert.ok(scan({ ...laser, ranges: new Float32Array(1e6).fill(1) }).points.length <= 3 * 4000);
    const data = new Uint8Array(4 * 16);
    const view = new DataView(data.buffer);
    [[1, 2, 3], [4, 5, 6], [NaN, 0, 0], [7, 8, 9]].forEach((point, at) => {
      point.forEach((value, axis) => view.setFloat32(at * 16 + axis * 4, value, true));
      view.setUint32(at * 16 + 12, 0x102030, true);
    });
    const field = (name, offset, datatype = 7) => ({ name, offset, datatype, count: 1 });
    const fields = [field("x", 0), field("y", 4), field("z", 8), field("rgb", 12)];
    const points = { width: 2, height: 2, point_step: 16, row_step: 32, is_bigendian: false, data, fields };
    const read = cloud(points, 100);
    assert.deepEqual(Array.from(read.points), [-2, 3, -1, -5, 6, -4, -8, 9, -7]);
    assert.deepEqual(Array.from(read.colours.slice(0, 3)), [0x10, 0x20, 0x30]);
    assert.equal(cloud(points, 2).points.length, 3); // every second one, of which one is none
    assert.equal(cloud(points, 0).points.length, 0);
    for (const bad of [{ data: data.slice(0, 60) }, { point_step: 8 }, { fields: fields.slice(1) }, { row_step: 8 }, { width: 1e9 }]) {
      assert.throws(() => cloud({ ...points, ...bad }, 100), Error, JSON.stringify(bad).slice(0, 40));
    }
    const info = { width: 2, height: 1, resolution: 0.5, origin: {} };
    assert.deepEqual(map({ info, data: Int8Array.of(-1, 100) }).size, [1, 0.5]);
    assert.deepEqual([...map({ info, data: Int8Array.of(-1, 100) }).pixels].filter((_, at) => at % 4 === 3), [0, 255]);
    assert.throws(() => map({ info, data: Int8Array.of(1) }));
    const large = map({ info: { ...info, width: 5000, height: 3000 }, data: new Int8Array(15e6) });
    assert.ok(large.width <= 1024 && large.height <= 1024);
    assert.equal(joints({ name: Array(500).fill("x".repeat(1000)), position: [1] }).length, 64);

    const frames = new Frames();
    const move = (parent, child, x, turn = 0) => ({
      header: { frame_id: parent },
      child_frame_id: child,
      transform: { translation: { x, y: 0, z: 0 }, rotation: { x: 0, y: 0, z: Math.sin(turn / 2), w: Math.cos(turn / 2) } },
    });
    frames.take({ transforms: [move("map", "base", 1, Math.PI / 2), move("base", "laser", 2)] });
    const { position, root } = frames.place("laser");
    assert.deepEqual([root, ...round([position.x, position.y])], ["map", 1, 2]);
    assert.equal(frames.place("map").root, "map");
    assert.equal(frames.place("nobody"), null);
    frames.take({ transforms: [move("b", "a", 1), move("a", "b", 1)] });
    assert.equal(frames.place("a"), null, "a loop");
    frames.take({ transforms: Array.from({ length: 1000 }, (_, at) => move("map", `f${at}`, 0)) });
    assert.ok(frames.all().length <= 256);
  },

  async clock() {
    const { MOST_TICKS, Ticks, clockName } = await load("macs-clock.js");
    assert.match(clockName(), /^[0-9a-z]{16}$/);
    assert.notEqual(clockName(), clockName());
    const ticks = new Ticks("k3f9a2c1", 1000);
    assert.equal(ticks.at(1000), 1);
    assert.equal(ticks.at(0), 1, "never less than 1");
    assert.equal(ticks.at(1100), 1001);
    assert.equal(ticks.next(0, 1100), 1001);
    assert.equal(ticks.next(1001, 1100), 1002, "always a greater one");
    assert.equal(ticks.next(1002, 900), 1003);
    assert.deepEqual(ticks.answer({ clock: "k3f9a2c1", question: 7 }, 1100), { clock: "k3f9a2c1", question: 7, at: 1001 });
    for (const bad of [{ clock: "other", question: 7 }, { clock: "k3f9a2c1", question: 0 }, { clock: "k3f9a2c1", question: 1.5 }, {}]) {
      assert.equal(ticks.answer(bad, 1100), null, JSON.stringify(bad));
    }
    assert.ok(!ticks.isSpent(1100) && ticks.isSpent(1000 + MOST_TICKS / 10));
  },

  async targets() {
    const { driveTopic, guardOf, targets, wishes } = await load("xr/targets.js");
    const { SHOWN } = await load("xr/wire-types.js");
    const { TWIST } = await load("shared/twist.js");
    const any = { robots: "any", groups: "any" };
    const ids = (me) => targets([1, 2, 3], { 1: 0, 2: 5, 3: 5 }, me).map(({ id }) => id);
    assert.deepEqual(ids(any), ["robot/1", "robot/2", "robot/3", "group/5"]);
    assert.deepEqual(ids({ robots: [2], groups: [] }), ["robot/2"]);
    const [group] = targets([2, 3], { 2: 5, 3: 5 }, { robots: [], groups: [5] });
    assert.deepEqual([group.robots, group.groups, group.seen], [[], [5], 2]);
    const offers = {
      "/raw": "sensor_msgs/msg/Image",
      "/b/compressed": "sensor_msgs/msg/CompressedImage",
      "/pose": "geometry_msgs/msg/PoseStamped",
      "/scan": "sensor_msgs/msg/LaserScan",
      "/tf": "tf2_msgs/msg/TFMessage",
      "/x": "std_msgs/msg/String",
    };
    const settings = { cameras: null, rightEye: "", layers: ["scan"], values: ["/x", "/gone"] };
    const wished = (more) => {
      const meant = { ...settings, ...more };
      return wishes(1, offers, meant, SHOWN, guardOf(offers, meant, SHOWN, null));
    };
    const pictures = (more) => wished(more).filter(({ shown }) => shown === "picture");
    assert.deepEqual(pictures({}).map(({ topic, guards }) => [topic, guards]), [["/b/compressed", true], ["/raw", false]]);
    assert.deepEqual(pictures({ cameras: [] }), []);
    assert.deepEqual(pictures({ cameras: ["/raw", "/pose", "/gone"] }).map(({ topic }) => topic), ["/raw"]);
    assert.deepEqual(pictures({ rightEye: "/raw" }).map(({ eye, panel }) => [eye, panel]), [["left", "/b/compressed"], ["right", "/b/compressed"]]);
    assert.deepEqual(wished({}).map(({ shown }) => shown), ["picture", "picture", "pose", "scan", "frames", "text"]);
    assert.equal(new Set(wished({}).map(({ key }) => key)).size, 6);
    const takes = { "/a": "std_msgs/msg/Bool", "/cmd_vel": "geometry_msgs/msg/Twist", "/other": "geometry_msgs/msg/TwistStamped" };
    assert.deepEqual(driveTopic(takes, "", TWIST), ["/cmd_vel", "geometry_msgs/msg/Twist"]);
    assert.deepEqual(driveTopic(takes, "/other", TWIST)[0], "/other");
    assert.equal(driveTopic(takes, "/gone", TWIST), null, "what was chosen and is gone is not replaced");
  },

  async opened() {
    const { Opened } = await load("shared/opened.js");
    const drive = { forward: 1, turn: 0 };
    const opened = new Opened();
    const read = (held, source = "right", kind = "controller") => [{ source, kind, drive: held ? drive : null, open: !held }];
    const held = [{ source: "right", ...drive }];
    assert.deepEqual(opened.held(read(true)), [], "it came with its grip held");
    assert.deepEqual(opened.held(read(false)), []);
    assert.deepEqual(opened.held(read(true)), held);
    assert.deepEqual(opened.held([]), [], "it sleeps");
    assert.deepEqual(opened.held(read(true)), [], "and is held as it wakes up");
    opened.held(read(false));
    assert.deepEqual(opened.held(read(true)), held);
    assert.deepEqual(opened.held(read(true, "right", "hand")), [], "a hand is another one than its controller");
    opened.held(read(false));
    opened.clear();
    assert.deepEqual(opened.held(read(true)), [], "nobody was there meanwhile");
    const [pinch] = read(false, "right", "hand");
    assert.deepEqual(opened.held([{ ...pinch, open: false }]), []);
    assert.deepEqual(opened.held(read(true, "right", "hand")), [], "pinched on a panel, and never seen open");
  },

  async halt() {
    const started = await halts();
    const stopped = (one) => {
      assert.equal(one.words().state, "stopped");
      assert.match(one.words().text, /^robot 1, 2 stopped after \d+ ms$/);
    };
    const confirmed = () => {
      const one = started();
      one.halt.setOnline([1, 2]);
      one.halt.press();
      one.says(1, true);
      one.says(2, true);
      stopped(one);
      one.sent.length = 0;
      return one;
    };
    for (const latched of [true, false]) {
      const one = confirmed();
      one.halt.setOnline([2]);
      one.halt.setOnline([1, 2]); // its program has started anew, which ends its stop
      if (latched) one.says(1, false);
      assert.deepEqual(one.words(), { state: "waiting", text: "no confirmation yet of robot 1" });
      assert.match(one.halt.bars([1]), /stop/);
      if (!latched) assert.deepEqual(one.sent, [[1, 1]]);
      one.says(1, true);
      assert.equal(one.words().state, "stopped");
      one.halt.release();
    }
    const told = confirmed();
    told.halt.setOnline([1]);
    told.halt.setOnline([1, 2]);
    told.says(2, true);
    assert.equal(told.words().state, "stopped", "it says that it holds on");
    told.halt.release();

    const away = confirmed();
    away.link(false);
    assert.deepEqual(away.words(), { state: "waiting", text: "no connection: how robots are is not known" });
    away.link(true);
    assert.deepEqual(away.sent, [[1, 1, 2]], "the way to them was lost: told again");
    assert.equal(away.words().state, "waiting");
    away.status.set(1, true).set(2, true);
    await away.check(); // what they said on the topic was lost
    stopped(away);
    away.halt.release();

    const lost = started();
    lost.halt.setOnline([1, 2]);
    lost.says(2, false);
    lost.halt.press();
    lost.status.set(1, true).set(2, true);
    await lost.halt.check();
    assert.equal(lost.words().state, "waiting", "just pressed: nobody is asked yet");
    await lost.check();
    stopped(lost);
    lost.halt.release();
    lost.status.set(1, false).set(2, false);
    await lost.check();
    assert.equal(lost.words().state, "free", "that they go on was lost");

    const others = confirmed();
    others.halt.pressedAt = performance.now() - 5000;
    others.says(1, false);
    others.says(2, false);
    assert.equal(others.words().state, "free", "somebody has let all of them go on");
    others.halt.setOnline([1, 2, 3]);
    assert.equal(others.words().state, "free");
  },

  async halt_refused() {
    const one = (await halts())();
    const refuse = (robot, reason) =>
      one.halt.headset.dispatchEvent(new CustomEvent("refused", { detail: { robot, name: "/emergency_stop", reason } }));
    one.halt.setOnline([1, 2]);
    one.says(1, true);
    one.says(2, true);
    one.halt.release();
    assert.equal(one.words().text, "robot 1, 2 stopped");
    refuse(1, "unity/7 may not release what operator/0 stopped");
    assert.match(one.words().text, /robot 1 was not released \(unity\/7 may not release what operator\/0 stopped\)/);
    assert.doesNotMatch(one.words().text, /robot 2 was/);
    one.says(2, false);
    one.says(1, true); // it says again how it is
    assert.match(one.words().text, /robot 1 was not released/);
    one.says(1, false);
    assert.deepEqual(one.words(), { state: "free", text: "" });
    one.says(1, true);
    assert.equal(one.words().text, "robot 1 stopped", "that was about another stop");
    one.halt.release();
    refuse(0, "no right");
    assert.match(one.words().text, /robot 1 was not released \(no right\)/, "the gateway says it of all");
    one.halt.press();
    assert.doesNotMatch(one.words().text, /not released/);
    one.says(1, true);
    one.says(2, true);
    one.halt.release();
  },

  async halt_again() {
    mock.timers.enable({ apis: ["setInterval", "setTimeout"] });
    const started = await halts();
    const robots = Array.from({ length: 9 }, (_, at) => at + 1);
    const one = started();
    one.halt.setOnline(robots);
    one.halt.press();
    const others = robots.slice(1);
    const later = (ms) => {
      for (let at = 0; at < ms; at += 50) {
        mock.timers.tick(50);
        one.says(others[0], true);
        others.push(others.shift());
      }
    };
    for (const robot of others) one.says(robot, true);
    one.sent.length = 0;
    later(1000);
    assert.deepEqual(one.sent, Array(5).fill([1, 1]), "every 200 ms, however often others answer");
    one.halt.again();
    later(150);
    assert.equal(one.sent.length, 6, "said at once, and 200 ms after that");
    later(50);
    assert.equal(one.sent.length, 7);
    one.says(1, true);
    later(1000);
    assert.equal(one.sent.length, 7, "until it holds");
    one.halt.setOnline(others);
    one.halt.setOnline(robots); // it has started anew: a timer of before is none
    later(400);
    assert.deepEqual(one.sent.slice(7), Array(3).fill([1, 1]));
    one.halt.release();

    const open = [];
    const slow = started((robot) => new Promise((resolve) => open.push(() => resolve(robot > 1))));
    slow.halt.setOnline(robots);
    slow.halt.press();
    for (const round of [1, 2]) {
      const running = slow.check();
      for (const robot of robots) {
        slow.check();
        assert.equal(open.length, Math.min(3, robots.length - robot + 1), `one round at a time: ${round}, ${robot}`);
        open.shift()();
        await new Promise(setImmediate);
      }
      await running;
      assert.deepEqual([open.length, slow.halt.stopped().length], [0, 8]);
    }
  },

  async guards() {
    const { guardOf, wishes } = await load("xr/targets.js");
    const { SHOWN } = await load("xr/wire-types.js");
    const settings = (cameras, rightEye = "") => ({ cameras, rightEye, layers: [], values: [] });
    const [one, two] = ["/one/compressed", "/two/compressed"];
    const type = "sensor_msgs/msg/CompressedImage";
    const both = { [one]: type, [two]: type };
    const guard = (publishers, meant, before, anew) => guardOf(publishers, meant, SHOWN, before, anew);
    const auto = settings(null);
    assert.equal(guard({}, auto, null), null, "a robot without pictures");
    const first = guard(both, auto, null);
    assert.deepEqual(first, { topic: one, type });
    for (const left of [{ [two]: type }, {}, { [one]: "std_msgs/msg/String" }]) {
      assert.deepEqual(guard(left, auto, first), first, "a camera that died guards on");
      const [wish] = wishes(1, left, auto, SHOWN, first);
      assert.deepEqual([wish.topic, wish.guards, wish.type], [one, true, type], "and is asked for");
    }
    assert.deepEqual(guard({ [two]: type }, auto, first, true), { topic: two, type }, "until somebody changes what is shown");
    assert.deepEqual(guard({}, auto, first, true), first);
    assert.equal(guard(both, settings([]), first), null, "or wants none");
    assert.deepEqual(guard({ [two]: type }, settings([one, two]), null), { topic: one, type: "" }, "chosen, and not there");
    const shown = wishes(1, { [two]: type }, settings([one, two]), SHOWN, { topic: one, type: "" });
    assert.deepEqual(shown.map(({ topic, guards }) => [topic, guards]), [[two, false]]);
    assert.deepEqual(guard({}, settings([one]), first), first);
    assert.deepEqual(guard(both, auto, { topic: "/typo", type: "" }), first);
    assert.deepEqual(guard(both, settings([one, two], one), null), { topic: two, type }, "the right eye's is none");
    const eyes = wishes(1, both, settings(null, one), SHOWN, first);
    assert.equal(new Set(eyes.map(({ key }) => key)).size, eyes.length);
  },
};

const { part } = JSON.parse(readFileSync(0, "utf8"));
await parts[part]();
console.log(JSON.stringify({ held: part }));
