/** Whom somebody may look at and drive: robots that are online, and their groups. Pure. */

/**
 * [{id, label, robots, groups, seen}]: `robots` and `groups` name those that commands are for, `seen` is the one whose pictures
 * are shown. `members` tells the group of each robot: {robot: group}; `me` what the token may.
 */
export function targets(online, members, me) {
  const mine = me.robots === "any" ? online : online.filter((robot) => me.robots.includes(robot));
  const found = mine.map((robot) => ({ id: `robot/${robot}`, label: `Robot ${robot}`, robots: [robot], groups: [], seen: robot }));
  const groups = new Map();
  for (const robot of online) {
    const group = members[robot] ?? 0;
    if (group) groups.set(group, [...(groups.get(group) ?? []), robot]);
  }
  for (const [group, robots] of [...groups].sort(([one], [other]) => one - other)) {
    const named = robots.every((robot) => mine.includes(robot));
    const byGroup = me.groups === "any" || me.groups.includes(group);
    if (!named && !byGroup) continue;
    const label = `Group ${group} · ${robots.length} ${robots.length === 1 ? "robot" : "robots"}`;
    found.push({ id: `group/${group}`, label, robots: named ? robots : [], groups: named ? [] : [group], seen: robots[0] });
  }
  return found;
}

/** What is received of a robot: [{key, robot, topic, type, shown, guards, eye, panel}], by what it offers and the settings. */
export function wishes(robot, publishers, settings, shownAs) {
  const offered = Object.entries(publishers);
  const found = [];
  const typed = (shown) => offered.filter(([, type]) => shownAs[type] === shown);
  const add = (topic, type, shown, more = {}) => found.push({ key: `${robot} ${topic} ${shown}`, robot, topic, type, shown, ...more });
  // compressed pictures first: raw ones cost a link ten times as much
  const pictures = typed("picture").sort(([, one], [, other]) => one.localeCompare(other));
  const chosen = settings.cameras ?? pictures.slice(0, 2).map(([topic]) => topic);
  const cameras = chosen.filter((topic) => shownAs[publishers[topic]] === "picture" && topic !== settings.rightEye);
  cameras.forEach((topic, at) => add(topic, publishers[topic], "picture", { guards: at === 0, panel: topic, eye: "left" }));
  const right = settings.rightEye;
  if (right && cameras.length && shownAs[publishers[right]] === "picture") {
    add(right, publishers[right], "picture", { guards: false, panel: cameras[0], eye: "right" });
  }
  const [pose] = typed("pose").sort(([one], [other]) => one.length - other.length);
  if (pose) add(...pose, "pose");
  for (const layer of ["scan", "cloud", "map", "joints"]) {
    const [first] = typed(layer);
    if (first && settings.layers.includes(layer)) add(...first, layer);
  }
  if (typed("scan").length || typed("cloud").length || settings.layers.includes("frames")) {
    for (const frames of typed("frames")) add(...frames, "frames");
  }
  const [battery] = typed("battery");
  if (battery) add(...battery, "battery");
  for (const topic of settings.values) if (publishers[topic]) add(topic, publishers[topic], "text");
  return found;
}

/** The topic that commands go to, of what a robot takes: the chosen one, or the first; null: none. */
export function driveTopic(subscribers, chosen, types) {
  const drives = Object.entries(subscribers).filter(([, type]) => type in types);
  return drives.find(([topic]) => topic === chosen) ?? (chosen ? null : (drives[0] ?? null));
}
