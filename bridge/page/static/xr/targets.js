/** Whom somebody may look at and drive: robots that are online, and their groups. Pure. */

/**
 * [{id, label, robots, groups, members, seen}]: `robots` and `groups` name those that commands are for, `members` are all robots
 * that are meant by that, `seen` is the one whose pictures are shown.
 * `members` tells the group of each robot: {robot: group}; `me` what the token may.
 */
export function targets(online, members, me) {
  const mine = me.robots === "any" ? online : online.filter((robot) => me.robots.includes(robot));
  const found = mine.map((robot) => {
    const alone = { robots: [robot], groups: [], members: [robot], seen: robot };
    return { id: `robot/${robot}`, label: `Robot ${robot}`, ...alone };
  });
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
    const whom = named ? { robots, groups: [] } : { robots: [], groups: [group] };
    found.push({ id: `group/${group}`, label, ...whom, members: robots, seen: robots[0] });
  }
  return found;
}

/** Which one is chosen by itself: who was named, once it is there; the first only where nobody was. null: none yet. */
export function firstOf(targets, named) {
  const found = named ? targets.find(({ id }) => id === named) : targets[0];
  return found?.id ?? null;
}

/** Who is named by an address that ends in `#robot/7`, or else was kept: `robot/7`, `group/5`; empty: nobody. */
export function namedBy(hash, kept) {
  const [, inHash] = /^#(robot\/\d{1,5})$/.exec(hash) ?? [];
  return inHash ?? (/^(robot|group)\/\d{1,5}$/.test(kept ?? "") ? kept : "");
}

/**
 * The picture that driving depends on: {topic, type}, or null where none is meant. `before` is what it was. Pictures that end
 * do not end that: it stays until somebody chooses another one, or none. `type` is "" while nobody has offered the chosen one; `anew`:
 * somebody has just changed what is shown.
 */
export function guardOf(publishers, settings, shownAs, before, anew = false) {
  const isPicture = (topic) => shownAs[publishers[topic]] === "picture";
  const [chosen] = (settings.cameras ?? []).filter((topic) => topic !== settings.rightEye);
  const [first] = pictures(publishers, settings, shownAs);
  const kept = before?.type ? before.topic : undefined;
  const topic = settings.cameras ? chosen : anew ? (first ?? kept) : (kept ?? first);
  if (!topic) return null;
  return { topic, type: isPicture(topic) ? publishers[topic] : before?.topic === topic ? before.type : "" };
}

/** What of the robot's pictures is shown, the one that guards first. */
function pictures(publishers, settings, shownAs) {
  const isPicture = (topic) => shownAs[publishers[topic]] === "picture";
  // compressed ones first: raw ones cost a link ten times as much
  const found = Object.keys(publishers).filter(isPicture).sort((one, other) => publishers[one].localeCompare(publishers[other]));
  return (settings.cameras ?? found.slice(0, 2)).filter((topic) => isPicture(topic) && topic !== settings.rightEye);
}

const keyOf = (robot, topic, shown) => `${robot} ${topic} ${shown}`;

/** By which name pictures of this topic are told of. */
export const pictureKey = (robot, topic) => keyOf(robot, topic, "picture");

/**
 * What is received of a robot: [{key, robot, topic, type, shown, guards, eye, panel}], by what it offers and the settings. The
 * picture of `guard` is asked for also while nobody offers it.
 */
export function wishes(robot, publishers, settings, shownAs, guard) {
  const offered = Object.entries(publishers);
  const found = [];
  const typed = (shown) => offered.filter(([, type]) => shownAs[type] === shown);
  const add = (topic, type, shown, more = {}) => found.push({ key: keyOf(robot, topic, shown), robot, topic, type, shown, ...more });
  const others = pictures(publishers, settings, shownAs).filter((topic) => topic !== guard?.topic);
  const cameras = guard?.type ? [guard.topic, ...others] : others;
  for (const topic of cameras) {
    const guards = topic === guard?.topic;
    add(topic, guards ? guard.type : publishers[topic], "picture", { guards, panel: topic, eye: "left" });
  }
  const right = settings.rightEye;
  if (right && cameras.length && right !== guard?.topic && shownAs[publishers[right]] === "picture") {
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
