// node xr_shown.mjs FOLDER-OF-MACS.JS < name of a part: runs the checks of that part; fails with the first that does not hold.
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const load = (name) => import(pathToFileURL(`${process.argv[2]}/${name}`));

/** What canvases of panels need of a browser. */
function drawn() {
  globalThis.navigator ??= {};
  const nothing = () => ({ width: 10 });
  const context = new Proxy({}, { get: () => nothing, set: () => true });
  globalThis.document = { createElement: () => ({ getContext: () => context }) };
}

/** A picture that knows whether it was closed. */
const picture = (width = 4, height = 3) => ({ width, height, closed: 0, close() { this.closed += 1; } });

/** How often each of these was given back. */
function disposals(things) {
  const found = Object.fromEntries(Object.keys(things).map((name) => [name, 0]));
  for (const [name, thing] of Object.entries(things)) thing.addEventListener("dispose", () => (found[name] += 1));
  return found;
}

const parts = {
  async sizes() {
    const { MOST_PIXELS, bounded, sizeOf } = await load("xr/sizes.js");
    const png = (width, height) => {
      const bytes = Buffer.alloc(33);
      Buffer.from("89504e470d0a1a0a0000000d49484452", "hex").copy(bytes);
      bytes.writeUInt32BE(width, 16);
      bytes.writeUInt32BE(height, 20);
      return new Uint8Array(bytes);
    };
    const jpeg = (width, height, marker = 0xc0) => {
      const app = [0xff, 0xe0, 0, 6, 0xff, 0xc0, 1, 2]; // what is inside a segment is none
      const size = [0xff, marker, 0, 17, 8, height >> 8, height & 255, width >> 8, width & 255, 3];
      return Uint8Array.from([0xff, 0xd8, ...app, 0xff, ...size, 0, 0, 0]);
    };
    assert.deepEqual(sizeOf(png(640, 480)), { width: 640, height: 480 });
    assert.deepEqual(sizeOf(jpeg(1280, 720)), { width: 1280, height: 720 });
    assert.deepEqual(sizeOf(jpeg(1280, 720, 0xc2)), { width: 1280, height: 720 }); // progressive
    const inside = new Uint8Array([...new Uint8Array(7), ...jpeg(8, 9)]).subarray(7);
    assert.deepEqual(sizeOf(inside), { width: 8, height: 9 });
    for (let length = 0; length < 33; length++) {
      sizeOf(png(1, 1).slice(0, length));
      sizeOf(jpeg(1, 1).slice(0, length));
    }
    assert.equal(sizeOf(new Uint8Array(100)), null);
    bounded(png(8000, 8000));
    bounded(new Uint8Array(100));
    for (const bytes of [png(8001, 8000), png(0xffffffff, 1), jpeg(65535, 65535)]) assert.throws(() => bounded(bytes), /too large/);
    assert.ok(8000 * 8000 <= MOST_PIXELS);
  },

  async aged() {
    const { Aged } = await load("xr/aged.js");
    const aged = new Aged();
    aged.note("/battery", "24 V", 1000);
    aged.note("/level", "0.6", 60_000);
    assert.deepEqual(aged.all(3000)[0], { topic: "/battery", value: "24 V", age: "" });
    assert.deepEqual(aged.all(61_000).map(({ age }) => age), ["60 s old", ""]);
    assert.equal(aged.all(301_000)[0].age, "5 min old");
    aged.keep(["/level"]);
    assert.deepEqual(aged.all(61_000).map(({ topic }) => topic), ["/level"], "its topic has ended");
  },

  async named() {
    const { firstOf, namedBy } = await load("xr/targets.js");
    const targets = [{ id: "robot/1" }, { id: "robot/7" }];
    assert.equal(firstOf(targets, ""), "robot/1");
    assert.equal(firstOf(targets, "robot/7"), "robot/7");
    assert.equal(firstOf(targets, "robot/8"), null, "another one is not driven instead");
    assert.equal(firstOf([], ""), null);
    assert.equal(namedBy("#robot/8", "robot/1"), "robot/8");
    assert.equal(namedBy("", "group/5"), "group/5");
    for (const bad of [null, "x", "robot/", "robot/1x", "robot/123456"]) assert.equal(namedBy("#elsewhere", bad), "", String(bad));
  },

  async eyes() {
    drawn();
    const { Screen } = await load("xr/screen.js");
    const screen = new Screen("/left", { topic: "/left" });
    const [first, second] = [picture(), picture()];
    screen.show(first);
    assert.equal(screen.rightMaterial.map, screen.material.map);
    screen.setOther(true);
    screen.show(second, "right");
    assert.notEqual(screen.rightMaterial.map, screen.material.map, "each eye has its own");
    assert.equal(screen.material.map.image, first, "what the left eye sees is not the right one's");
    assert.equal(first.closed, 0);
    const right = disposals({ texture: screen.rightMaterial.map });
    screen.setOther(true);
    assert.equal(right.texture, 0);
    screen.setOther(false);
    assert.deepEqual([right.texture, second.closed, first.closed], [1, 1, 0]);
    assert.equal(screen.rightMaterial.map, screen.material.map);
    const before = disposals({ texture: screen.material.map });
    const larger = picture(8, 6);
    screen.show(larger);
    assert.deepEqual([before.texture, first.closed], [1, 1], "one of another size");
    const last = disposals({ texture: screen.material.map });
    screen.dispose();
    assert.deepEqual([last.texture, larger.closed], [1, 1]);
  },

  async pixels() {
    const { decoded } = await load("page/pixels.js");
    const data = Uint8Array.from({ length: 24 }, (_, at) => 10 * at);
    const read = (encoding, step) => [...decoded({ width: 2, height: 2, step, encoding, data })];
    assert.deepEqual(read("rgb8", 8), [0, 10, 20, 255, 30, 40, 50, 255, 80, 90, 100, 255, 110, 120, 130, 255]);
    assert.deepEqual(read("bgr8", 8), [20, 10, 0, 255, 50, 40, 30, 255, 100, 90, 80, 255, 130, 120, 110, 255]);
    assert.deepEqual(read("rgba8", 10), [0, 10, 20, 30, 40, 50, 60, 70, 100, 110, 120, 130, 140, 150, 160, 170]);
    assert.deepEqual(read("bgra8", 10), [20, 10, 0, 30, 60, 50, 40, 70, 120, 110, 100, 130, 160, 150, 140, 170]);
    assert.deepEqual(read("mono8", 5), [0, 0, 0, 255, 10, 10, 10, 255, 50, 50, 50, 255, 60, 60, 60, 255]);
    assert.throws(() => read("rgb8", 5), /rows are shorter/);
    assert.throws(() => read("rgb8", 13), /shorter than it says/);
  },

  async room() {
    const { Pictures } = await load("xr/pictures.js");
    const pictures = new Pictures();
    const raw = (width, height) => ({ width, height, step: 3 * width, encoding: "rgb8", data: new Uint8Array(3 * width * height).fill(7) });
    const first = await pictures.read(raw(4, 3), false);
    assert.deepEqual([first.width, first.height, ...first.data.subarray(0, 4)], [4, 3, 7, 7, 7, 255]);
    const second = await pictures.read(raw(4, 3), false);
    assert.notEqual(second.data.buffer, first.data.buffer);
    pictures.back([first.data.buffer]);
    const larger = await pictures.read(raw(8, 3), false);
    assert.equal(larger.data.length, 96);
    assert.equal((await pictures.read(raw(4, 3), false)).data.buffer, first.data.buffer, "its room is used again");
    pictures.back(Array.from({ length: 9 }, () => new ArrayBuffer(48)));
    const rooms = new Set();
    for (let at = 0; at < 9; at++) rooms.add((await pictures.read(raw(4, 3), false)).data.buffer);
    assert.equal(rooms.size, 9, "each is used once");
    await assert.rejects(pictures.read(raw(0, 3), false), /no picture/);
  },

  async bytes() {
    drawn();
    const { Screen } = await load("xr/screen.js");
    const screen = new Screen("/left", { topic: "/left" });
    const bytes = () => ({ ...picture(), data: new Uint8Array(48) });
    const [first, second, bitmap] = [bytes(), bytes(), picture()];
    screen.show(first);
    const texture = screen.material.map;
    assert.ok(texture.isDataTexture);
    screen.show(second);
    assert.equal(screen.material.map, texture, "the same texture has the next one");
    assert.deepEqual([first.closed, second.closed], [1, 0]);
    screen.show(bitmap);
    assert.ok(!screen.material.map.isDataTexture);
    assert.deepEqual([second.closed, bitmap.closed], [1, 0]);
  },

  async joined() {
    globalThis.navigator ??= {};
    const { joined } = await load("xr/joined.js");
    const { BoxGeometry, Mesh, MeshBasicMaterial } = await load("vendor/three.js");
    const material = new MeshBasicMaterial();
    const [one, other] = [new Mesh(new BoxGeometry(1, 1, 1), material), new Mesh(new BoxGeometry(1, 1, 1), material)];
    other.position.set(10, 0, 0);
    const found = joined(one, other);
    assert.equal(found.material, material);
    const { position, normal } = found.geometry.attributes;
    assert.deepEqual([position.count, normal.count, found.geometry.index.count], [48, 48, 72]);
    const xs = (from) => Array.from({ length: 24 }, (_, at) => position.getX(from + at));
    assert.deepEqual([Math.min(...xs(0)), Math.max(...xs(0)), Math.min(...xs(24)), Math.max(...xs(24))], [-0.5, 0.5, 9.5, 10.5]);
    assert.equal(Math.min(...found.geometry.index.array.subarray(36)), 24);
  },

  async map() {
    globalThis.navigator ??= {};
    const { Model } = await load("xr/model.js");
    const model = new Model();
    const place = { position: { x: 0, y: 0, z: 0 }, orientation: { x: 0, y: 0, z: 0, w: 1 } };
    model.take("map", { pixels: new Uint8Array(16), width: 2, height: 2, size: [1, 1], origin: place });
    const { geometry, material } = model.map;
    const found = disposals({ geometry, material, texture: material.uniforms.map.value });
    model.clear();
    assert.deepEqual(found, { geometry: 1, material: 1, texture: 1 });
    assert.equal(model.map, null);
  },

  async told() {
    drawn();
    const { Telling } = await load("xr/telling.js");
    let menu = null;
    let status = null;
    const room = { menu: { set: (content) => (menu = content) }, status: { set: (content) => (status = content) }, tellPictures() {} };
    const links = Object.assign(new EventTarget(), { rates: new Map(), sightUp: { connected: true } });
    let written = 0;
    const overlay = { setState: () => (written += 1), setStop() {}, tell() {} };
    const wishes = [{ shown: "battery", topic: "/battery" }];
    const settings = { get: () => 0 };
    const scene = { room, links, overlay, wishes, settings, me: { may: [] }, immersion: {}, waiting: "Waiting for robot 7" };
    const telling = new Telling(scene);
    const rows = () => Object.fromEntries(status.rows.map(({ label, value }) => [label, value]));
    const say = (more) => {
      telling.state = { ...telling.state, connected: true, exclusive: true, ...more };
      telling.tell();
    };
    const buttons = () => menu.buttons.flat().map(({ id, label }) => `${id}: ${label}`);
    say({ holder: "you", candidates: [8, 9] });
    assert.ok(buttons().includes("give 8: Give to 8"), "whom a button names is in it");
    assert.equal(status.title, "Waiting for robot 7");
    assert.ok(!menu.buttons.flat().find(({ id }) => id === "back").off);
    const take = () => menu.buttons.flat().find(({ id }) => id === "take");
    say({ holder: null });
    assert.deepEqual([take().off, rows()[""]], [false, undefined]);
    say({ byGroup: true });
    assert.ok(take().off);
    assert.match(rows()[""], /this token names groups only/, "and why");
    say({ byGroup: false });
    say({ unknown: [3] });
    assert.equal(rows().Control, "robot 3 does not say");
    say({ clockless: [3] });
    assert.equal(rows()[""], "robot 3 does not compare clocks");
    telling.setBattery({ topic: "/battery", percentage: 0.5, voltage: 24 });
    telling.tell();
    assert.match(rows().Battery, /^50 % · 24/);
    scene.wishes = [];
    telling.tell();
    assert.equal(rows().Battery, undefined, "its topic has ended");
    for (const [immersive, times] of [[true, 2], [false, 8]]) {
      written = 0;
      scene.stage = { immersive };
      for (let tick = 0; tick < 8; tick++) telling.tick();
      assert.equal(written, times, "who wears the headset does not see the page");
    }
  },
};

const { part } = JSON.parse(readFileSync(0, "utf8"));
await parts[part]();
console.log(JSON.stringify({ held: part }));
