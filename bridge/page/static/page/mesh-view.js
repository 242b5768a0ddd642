/** The mesh as a picture: headsets behind gateways, routers, robots; and what happens, beside it. */

import { Keyed, digits, h, panel, say, svg } from "./dom.js";

const EVERY_MS = 1000;
const HEADSETS_SHOWN = 24;
const WIDTH = 960;
const COLUMNS = { headsets: 110, gateways: 330, routers: 560, robots: 800 };
const ROW = 44;

export class MeshView {
  constructor(page) {
    this.page = page;
    this.known = "";
    this.picture = svg("svg", { class: "mesh", role: "img", viewBox: `0 0 ${WIDTH} 200` });
    this.summary = h("p", { class: "facts", role: "status" });
    this.lines = h("ol", { class: "events" });
    this.robots = h("tbody");
    this.keyed = new Keyed(this.robots, (robot) => this.#row(robot));
    const heads = ["Robot", "State", "Control", "Round trip", "Lost"];
    const table = h(
      "table",
      {},
      h("thead", {}, h("tr", {}, ...heads.map((text) => h("th", { scope: "col" }, text)))),
      this.robots,
    );
    const scroll = h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Robots" }, table);
    const events = h("div", { class: "scroll", tabindex: "0", role: "log", "aria-label": "Events" }, this.lines);
    const drawing = { tabindex: "0", role: "region", "aria-label": "Picture of the mesh" };
    const left = h(
      "div",
      { class: "area" },
      panel("Mesh", { id: "mesh" }, h("div", { class: "scroll-x", ...drawing }, this.picture)),
      panel("Robots", { id: "mesh-robots" }, scroll),
    );
    const heading = h("h1", { class: "visually-hidden" }, "Mesh");
    this.element = h(
      "div",
      { class: "view mesh-view" },
      heading,
      this.summary,
      h("div", { class: "panels" }, left, h("div", { class: "area" }, panel("Events", { id: "events" }, events))),
    );
    this.#follow();
  }

  /** An event, the newest first; the last 200 are kept. */
  add(kind, text, at) {
    const time = at.toLocaleTimeString([], { hour12: false });
    this.lines.prepend(h("li", { "data-kind": kind }, h("time", {}, time), h("span", {}, text)));
    while (this.lines.children.length > 200) this.lines.lastChild.remove();
  }

  tick() {}

  draw() {}

  restyle() {}

  async #follow() {
    for (;;) {
      const seen = !this.element.hidden && !document.hidden && this.page.headset.connected;
      const picture = seen ? await this.page.get("/view/mesh") : null;
      if (picture !== null && !picture.error) this.#show(picture);
      await new Promise((resolve) => setTimeout(resolve, EVERY_MS));
    }
  }

  #show(picture) {
    const { robots, headsets, gateways, routers, linked } = picture;
    const counts = [
      [robots, "robot"],
      [headsets, "headset"],
      [gateways, "gateway"],
      [routers, "router"],
    ].map(([list, name]) => `${list.length} ${name}${list.length === 1 ? "" : "s"}`);
    say(this.summary, `${counts.join(" · ")}${linked ? "" : " · this gateway has lost its routers"}`);
    this.#table(picture);
    const drawn = JSON.stringify([robots, headsets, gateways, roundedTrips(routers), rounded(picture.sessions)]);
    if (drawn === this.known) return;
    this.known = drawn;
    this.#draw(picture);
  }

  #table({ robots, sessions }) {
    this.keyed.set(robots.map((robot) => robot.id));
    for (const robot of robots) {
      const cells = this.keyed.get(robot.id).children;
      const state = !robot.known ? "asked" : robot.stopped ? `stopped by ${robot.stoppedBy}` : "free";
      const control = Object.entries(robot.control ?? {}).map(([topic, holder]) => `${holder} on ${topic}`);
      const lost = Object.entries(robot.drops ?? {}).filter(([, count]) => count);
      const { roundTripMs } = sessions[robot.session] ?? {};
      const texts = [
        `Robot ${robot.id}${robot.group ? ` (group ${robot.group})` : ""}`,
        state,
        control.join(", ") || "–",
        roundTripMs === undefined ? "–" : `${digits(roundTripMs)} ms`,
        lost.map(([name, count]) => `${name} ${count}`).join(", ") || "–",
      ];
      texts.forEach((text, at) => say(cells[at], text));
      cells[1].className = robot.stopped ? "bad" : "";
      cells[4].className = lost.length ? "bad" : "";
    }
  }

  #row() {
    return h("tr", {}, ...Array.from({ length: 5 }, () => h("td")));
  }

  #draw(picture) {
    const { robots, headsets, gateways, routers, sessions, own } = picture;
    const behind = new Map(gateways.map((zid) => [zid, headsets.filter((each) => each.session === zid)]));
    const rows = Math.max(robots.length, ...[...behind.values()].map((list) => Math.ceil(list.length / 6)), gateways.length, 3);
    const columns = Math.max(1, Math.ceil(robots.length / 24));
    const height = Math.max(200, (Math.min(rows, 24) + 1) * ROW);
    const place = (at, count, x) => ({ x, y: (height * (at + 1)) / (count + 1) });
    const links = svg("g", { class: "links" });
    const marks = svg("g", { class: "marks" });
    const routerAt = new Map();
    const shownRouters = routers.length ? routers : [];
    shownRouters.forEach((router, at) => routerAt.set(router.zid, place(at, shownRouters.length, COLUMNS.routers)));
    const routersOf = (zid) => {
      const found = shownRouters.filter((router) => router.sessions.includes(zid) || (zid === own && router.linked));
      return found.length ? found : shownRouters.slice(0, 1);
    };
    for (const router of shownRouters) {
      const here = routerAt.get(router.zid);
      for (const other of router.routers) {
        if (other > router.zid) links.append(line(here, routerAt.get(other), "router", { trip: router.linksMs[other] ?? undefined }));
      }
      marks.append(mark(here, "router", "router", router.version ? `Zenoh ${router.version}` : router.zid.slice(0, 8)));
    }
    gateways.forEach((zid, at) => {
      const here = place(at, gateways.length, COLUMNS.gateways);
      const { address, drops } = sessions[zid] ?? {};
      for (const router of routersOf(zid)) {
        const carries = zid === own ? ofOwn(router, sessions[own]) : ofLink(router, sessions[zid]);
        links.append(line(here, routerAt.get(router.zid), "gateway", carries));
      }
      this.#headsets(links, marks, here, behind.get(zid) ?? []);
      marks.append(mark(here, "gateway", zid === own ? "this gateway" : "gateway", address ?? "", lostOf(drops)));
    });
    robots.forEach((robot, at) => {
      const column = Math.floor(at / 24);
      const inColumn = Math.min(24, robots.length - column * 24);
      const here = place(at % 24, inColumn, COLUMNS.robots - (columns - 1) * 40 + column * 70);
      const { drops } = sessions[robot.session] ?? {};
      for (const router of routersOf(robot.session)) {
        const from = robots.length > 24 ? "faint" : "robot";
        links.append(line(routerAt.get(router.zid), here, from, robots.length > 24 ? {} : ofLink(router, sessions[robot.session])));
      }
      const kind = robot.stopped ? "robot stopped" : "robot";
      marks.append(mark(here, kind, `Robot ${robot.id}`, robot.stopped ? "stopped" : "", lostOf(robot.drops, drops)));
    });
    this.picture.setAttribute("viewBox", `0 0 ${WIDTH} ${height}`);
    this.picture.setAttribute("aria-label", this.summary.textContent);
    this.picture.replaceChildren(links, marks);
  }

  #headsets(links, marks, gateway, headsets) {
    const shown = headsets.slice(0, HEADSETS_SHOWN);
    shown.forEach((headset, at) => {
      const across = at % 4;
      const down = Math.floor(at / 4);
      const here = {
        x: COLUMNS.headsets - across * 26,
        y: gateway.y + (down - (Math.ceil(shown.length / 4) - 1) / 2) * 26,
      };
      if (across === 0) links.append(line(here, gateway, "headset"));
      const own = headset.id === this.page.headset.id ? " own" : "";
      const dot = svg("circle", { class: `headset${own}`, cx: here.x, cy: here.y, r: 9 });
      dot.append(svg("title", {}, `Headset ${headset.id}${own ? " (this page)" : ""}`));
      marks.append(dot);
    });
    const left = headsets.length - shown.length;
    const text = `${headsets.length} headset${headsets.length === 1 ? "" : "s"}${left ? ` (${left} not drawn)` : ""}`;
    const below = gateway.y + (Math.ceil(shown.length / 4) / 2) * 26 + 16;
    marks.append(svg("text", { class: "note", x: COLUMNS.headsets - 40, y: below }, text));
  }
}

/** What a link of the session behind a router takes there and back, and carries. */
function ofLink({ roundTripMs: toRouter }, { roundTripMs, bytesPerS } = {}) {
  if (roundTripMs === undefined) return { bytesPerS };
  // where nobody could ask the router, or both are too uncertain, it is known of the whole way only
  if (toRouter === null || toRouter > roundTripMs) return { most: roundTripMs, bytesPerS };
  return { trip: roundTripMs - toRouter, bytesPerS };
}

/** The same of this gateway's own. */
function ofOwn({ roundTripMs }, { bytesPerS } = {}) {
  return { trip: roundTripMs ?? undefined, bytesPerS };
}

function line(from, to, kind, { trip, most, bytesPerS } = {}) {
  const middle = (from.x + to.x) / 2;
  const path = svg("path", { class: kind, d: `M${from.x} ${from.y} C${middle} ${from.y} ${middle} ${to.y} ${to.x} ${to.y}` });
  const at = { class: "note", x: middle, y: (from.y + to.y) / 2 - 6 };
  const texts = [];
  if (trip !== undefined) texts.push(`${digits(trip)} ms`);
  else if (most !== undefined) texts.push(`≤ ${digits(most)} ms`);
  const group = svg("g", { class: "link" }, path);
  if (texts.length) group.append(svg("text", at, texts[0]));
  if (bytesPerS !== undefined) group.append(svg("text", { ...at, y: at.y + 18 }, rate(bytesPerS)));
  return group;
}

function rate(bytesPerS) {
  return bytesPerS < 1e6 ? `${digits(bytesPerS / 1e3)} kB/s` : `${digits(bytesPerS / 1e6)} MB/s`;
}

function mark({ x, y }, kind, title, note, lost) {
  const group = svg("g", { class: lost ? `${kind} losing` : kind });
  group.append(svg("rect", { x: x - 58, y: y - 17, width: 116, height: 34, rx: 9 }));
  group.append(svg("text", { x, y: note ? y - 1 : y + 4 }, title));
  if (note) group.append(svg("text", { class: "note", x, y: y + 12 }, note));
  if (lost) group.append(svg("text", { class: "note lost", x, y: y + 29 }, lost.length > 26 ? `${lost.slice(0, 25)}…` : lost));
  if (lost) group.append(svg("title", {}, `${title} lost: ${lost}`));
  return group;
}

/** What was lost, by name; empty when nothing was. */
function lostOf(...drops) {
  const found = drops.flatMap((each) => Object.entries(each ?? {})).filter(([, count]) => count);
  return found.map(([name, count]) => `${name} ${count}`).join(", ");
}

/** Round trips and rates as they are shown: what nobody sees is no reason to draw. */
function rounded(sessions) {
  return Object.entries(sessions).map(([zid, { roundTripMs, bytesPerS, drops }]) => {
    return [zid, roundTripMs === undefined ? "" : digits(roundTripMs), bytesPerS === undefined ? "" : rate(bytesPerS), drops];
  });
}

function roundedTrips(routers) {
  const shown = (ms) => (ms === null ? "" : digits(ms));
  return routers.map(({ zid, version, linked, sessions, roundTripMs, linksMs }) => {
    return [zid, version, linked, sessions, shown(roundTripMs), Object.entries(linksMs).map(([other, ms]) => [other, shown(ms)])];
  });
}
