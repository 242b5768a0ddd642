/**
 * Interface nodes of a headset: topics that it receives and publishes, services that it calls and serves, actions.
 *
 * A node remembers on which robots and groups it is registered; its headset registers it there again after every
 * reconnection. What waits for an answer then fails: nothing that was asked for is sent a second time.
 */

import { NodeType, ROS, UNITY, WireError, json, metadata, nodeName, object, typeName } from "./macs-wire.js";

const REQUEST_IDS = 2 ** 31;
const ID_BYTES = 16;
const OPEN_REQUESTS = 64;
const FAILURE = "InterfaceCallFailure";

/** Why something that was asked for did not come: `kind` is `refused`, `timeout`, `offline` or `absent`. */
export class CallError extends Error {
  constructor(kind, message) {
    super(message);
    this.name = "CallError";
    this.kind = kind;
  }
}

/** One interface node. `refusals` has what robots said last that do not take part: robot → {reason, kind, at}. */
export class Node {
  constructor(headset, nodeType, name, type, { bufferSize = 10, dropNew = false, latched = false } = {}) {
    this.headset = headset;
    this.nodeType = nodeType;
    this.name = name;
    this.nodeName = nodeName(name);
    this.type = typeName(type);
    this.options = { bufferSize, dropNew, isLatched: latched };
    this.robots = new Set();
    this.groups = new Set();
    this.refusals = new Map();
  }

  /** Register at these robots, and at the robots of these groups, where it is not registered yet. */
  register({ robots = [], groups = [] } = {}) {
    const newRobots = robots.filter((robot) => !this.robots.has(robot));
    const newGroups = groups.filter((group) => !this.groups.has(group));
    newRobots.forEach((robot) => this.robots.add(robot) && this.refusals.delete(robot));
    newGroups.forEach((group) => this.groups.add(group));
    if (newRobots.length || newGroups.length) this.headset.sendIfOnline(() => this.#registration(newRobots, newGroups));
    return this;
  }

  /** Leave these robots and groups. Groups go in a message of their own, as existing robots want it. */
  deregister({ robots = [], groups = [] } = {}) {
    robots.forEach((robot) => this.robots.delete(robot) && this.refusals.delete(robot));
    groups.forEach((group) => this.groups.delete(group));
    if (robots.length) this.headset.sendIfOnline(() => this.#removal([...robots], []));
    if (groups.length) this.headset.sendIfOnline(() => this.#removal([], [...groups]));
  }

  /** Leave everywhere: nothing comes of it any more. */
  close() {
    this.headset.forget(this);
    this.deregister({ robots: [...this.robots], groups: [...this.groups] });
    this.end("it was closed");
  }

  // -- for the headset ----------------------------------------------------------------------------------------------

  /** Registered anew on a connection that has just come up. */
  again() {
    if (this.robots.size || this.groups.size) {
      this.headset.sendIfOnline(() => this.#registration([...this.robots], [...this.groups]));
    }
  }

  refused(robot, reason, kind) {
    this.refusals.set(robot, { reason, kind, at: Date.now() });
  }

  receive() {}

  /** What waits for answers fails: the connection is gone, or the node. */
  end() {}

  metadata(extra) {
    return metadata(this.headset.id, { node: this, ...extra });
  }

  #registration(robots, groups) {
    const own = this.headset.id;
    const inner = {
      registrantAgentType: UNITY,
      registrantAgentId: own,
      nodeType: this.nodeType,
      nodeName: this.nodeName,
      tosName: this.name,
      dataExchangeType: this.type,
      ...this.options,
    };
    return this.#request(robots, groups, "InterfaceNodeAdder", inner);
  }

  #removal(robots, groups) {
    const own = this.headset.id;
    const inner = {
      registrantAgentType: UNITY,
      registrantAgentId: own,
      nodeType: this.nodeType,
      nodeName: this.nodeName,
    };
    return this.#request(robots, groups, "InterfaceNodeRemover", inner);
  }

  #request(robots, groups, manager, inner) {
    return {
      management: {
        messageManager: "RosAgentNodeRegistrationForwarder",
        registrantAgentId: this.headset.id,
        registrarAgentIds: robots,
        registrarGroupIds: groups,
        nodeType: this.nodeType,
        nodeName: this.nodeName,
        tosName: this.name,
        dataExchangeType: this.type,
      },
      meta: metadata(this.headset.id, { manager }),
      data: json(inner),
    };
  }
}

/** A robot topic that comes: `onMessage(message)` is called for each; `message.senderId` is the robot. */
export class Subscription extends Node {
  constructor(headset, name, type, options, onMessage) {
    super(headset, NodeType.SUBSCRIBER, name, type, options);
    this.onMessage = onMessage;
  }

  receive(message) {
    this.onMessage(message);
  }
}

/** A robot topic that this headset publishes. */
export class Publisher extends Node {
  constructor(headset, name, type, options) {
    super(headset, NodeType.PUBLISHER, name, type, options);
    /** How many messages were not sent, as there was no connection or it was not fresh. */
    this.unsent = 0;
    /** The number of the last command that told its time. */
    this.lastTicks = 0;
    /** When the newest of what was sent was made, by the headset's clock. */
    this.lastMadeAt = -Infinity;
  }

  /**
   * Send CDR to these robots and groups, by default to all where it is registered. Whether it was sent: nothing is kept
   * for later. With `freshMs` it is not sent when the gateway has not answered for so long, or when bytes still wait
   * here: a command that cannot go at once does not go at all. `madeAt` is when it was made, by the clock of the headset's
   * `CommandClock`, for robots that want to know; now unless it is said. What was made before something that was sent is
   * not sent: its number would have to be a greater one, and say that it is younger than it is.
   */
  publish(cdr, { robots, groups = [], freshMs = 0, madeAt } = {}) {
    const to = robots ?? [...this.robots];
    const toGroups = robots ? groups : [...this.groups];
    const now = this.headset.clock?.now();
    if (madeAt < this.lastMadeAt) {
      this.unsent += 1;
      return false;
    }
    const frames = () => this.#frames(cdr, to, toGroups, madeAt);
    const sent = freshMs ? this.headset.sendFresh(frames, freshMs) : this.headset.sendNow(frames);
    if (!sent) this.unsent += 1;
    else if (now !== undefined) this.lastMadeAt = Math.max(this.lastMadeAt, Math.min(madeAt ?? now, now));
    return sent;
  }

  #frames(data, robots, groups, madeAt) {
    const { clock } = this.headset;
    const timed = clock ? robots.filter((robot) => clock.tells(robot)) : [];
    const timedGroups = clock ? groups.filter((group) => clock.tellsGroup(group)) : [];
    if (!timed.length && !timedGroups.length) return packed(robots, groups, this.metadata(), data);
    this.lastTicks = clock.ticks.next(this.lastTicks, madeAt ?? clock.now());
    const told = { ...this.metadata({ requestId: this.lastTicks }), clock: clock.ticks.name };
    clock.told(timed, timedGroups);
    const others = robots.filter((robot) => !timed.includes(robot));
    const otherGroups = groups.filter((group) => !timedGroups.includes(group));
    return [...packed(timed, timedGroups, told, data), ...packed(others, otherGroups, this.metadata(), data)];
  }
}

/** As many frames as it takes: ten robots and ten groups fit into one. */
function packed(robots, groups, meta, data) {
  const frames = [];
  for (let at = 0; at < Math.max(robots.length, groups.length); at += 10) {
    frames.push({ to: ROS, ids: robots.slice(at, at + 10), groups: groups.slice(at, at + 10), meta, data });
  }
  return frames;
}

/** A service of robots that this headset calls. */
export class ServiceClient extends Node {
  #next = 0; // 0 is a number as any other
  #open = new Map();

  constructor(headset, name, type) {
    super(headset, NodeType.CLIENT, name, type, { dropNew: true });
  }

  /** The response of a robot, as CDR. Rejects with CallError. */
  call(robot, request, { timeoutMs = 5000 } = {}) {
    const requestId = this.#next;
    this.#next = (requestId + 1) % REQUEST_IDS;
    const meta = this.metadata({ requestId, manager: FAILURE });
    return new Promise((resolve, reject) => {
      const late = () => this.#settle(robot, requestId, new CallError("timeout", `${this.name} did not answer`));
      const timer = setTimeout(late, timeoutMs);
      this.#open.set(`${robot} ${requestId}`, { resolve, reject, timer, robot });
      if (!this.headset.sendNow(() => [{ to: ROS, ids: [robot], meta, data: request }])) {
        this.#settle(robot, requestId, new CallError("offline", "there is no connection"));
      }
    });
  }

  receive(message) {
    // a robot that knows no failures may copy the manager of the request; CDR never begins with a brace
    if (message.manager === FAILURE && message.data[0] === 0x7b) {
      const { kind, reason } = object(message.data);
      this.#settle(message.senderId, message.requestId, new CallError(String(kind), String(reason)));
    } else {
      this.#settle(message.senderId, message.requestId, null, message.data.slice());
    }
  }

  refused(robot, reason, kind) {
    super.refused(robot, reason, kind);
    this.#fail((open) => open.robot === robot, new CallError("refused", reason));
  }

  end(why) {
    this.#fail(() => true, new CallError("offline", why));
  }

  #fail(which, error) {
    for (const [key, open] of this.#open) {
      if (which(open)) this.#settle(...key.split(" "), error);
    }
  }

  #settle(robot, requestId, error, data) {
    const key = `${robot} ${requestId}`;
    const open = this.#open.get(key);
    if (open === undefined) return; // it came too late
    this.#open.delete(key);
    clearTimeout(open.timer);
    if (error) open.reject(error);
    else open.resolve(data);
  }
}

/** A service that this headset serves: `handler(request, robot)` returns the response's CDR, or throws. */
export class Service extends Node {
  #open = 0;

  constructor(headset, name, type, handler) {
    super(headset, NodeType.SERVICE, name, type, { dropNew: true });
    this.handler = handler;
    /** Requests that came while too many were open. */
    this.dropped = 0;
  }

  receive(message) {
    if (this.#open >= OPEN_REQUESTS) {
      this.dropped += 1;
      return;
    }
    this.#open += 1;
    this.#answer(message).finally(() => (this.#open -= 1));
  }

  async #answer({ senderId, requestId, manager, data }) {
    const answer = (extra, body) =>
      this.headset.sendNow(() => [
        { to: ROS, ids: [senderId], meta: this.metadata({ requestId, ...extra }), data: body },
      ]);
    try {
      answer({}, await this.handler(data, senderId));
    } catch (error) {
      if (manager === FAILURE) answer({ manager: FAILURE }, json({ kind: "failed", reason: String(error.message) }));
    }
  }
}

/** A goal that was given to a robot. `status` of its result is that of action_msgs/GoalStatus: 4 succeeded. */
export class Goal {
  #settle = {};

  constructor(robot, id, onFeedback) {
    this.robot = robot;
    this.id = id;
    this.onFeedback = onFeedback;
    for (const what of ["accepted", "result", "canceled"]) {
      this[what] = new Promise((resolve, reject) => (this.#settle[what] = { resolve, reject }));
      this[what].catch(() => {}); // nobody has to look
    }
  }

  /** What its robot says of it; whether that is the last word. */
  receive(verb, code, rest) {
    const reason = () => new CallError("refused", new TextDecoder().decode(rest) || "no reason given");
    if (verb === "ActionFeedback") this.onFeedback?.(rest);
    else if (verb === "ActionAccepted" && code) this.#settle.accepted.resolve();
    else if (verb === "ActionAccepted") this.end(reason());
    else if (verb === "ActionCancel" && code) this.#settle.canceled.resolve();
    else if (verb === "ActionCancel") this.#settle.canceled.reject(reason());
    else if (verb === "ActionResult" && code === 0) this.end(reason());
    else if (verb === "ActionResult") {
      this.#settle.accepted.resolve();
      this.#settle.result.resolve({ status: code, data: rest.slice() });
    }
    return verb === "ActionResult" || (verb === "ActionAccepted" && !code);
  }

  end(error) {
    for (const each of Object.values(this.#settle)) each.reject(error);
  }
}

/** An action of robots that this headset gives goals to (docs/actions.md). */
export class ActionClient extends Node {
  #goals = new Map();
  #next = 0;

  constructor(headset, name, type, options) {
    super(headset, NodeType.ACTION, name, type, options);
  }

  /** Give a goal (CDR); resolves when it is accepted. Rejects with CallError. */
  async sendGoal(robot, cdr, { onFeedback, timeoutMs = 5000 } = {}) {
    const id = crypto.getRandomValues(new Uint8Array(ID_BYTES));
    const goal = new Goal(robot, id, onFeedback);
    this.#goals.set(hex(id), goal);
    const late = setTimeout(() => goal.end(new CallError("timeout", `${this.name} did not answer`)), timeoutMs);
    try {
      if (!this.#tell(robot, "ActionGoal", id, cdr)) throw new CallError("offline", "there is no connection");
      await goal.accepted;
      return goal;
    } catch (error) {
      this.#goals.delete(hex(id));
      throw error;
    } finally {
      clearTimeout(late);
    }
  }

  /** Ask a goal to stop; resolves when the action does. */
  async cancel(goal) {
    if (!this.#tell(goal.robot, "ActionCancel", goal.id)) throw new CallError("offline", "there is no connection");
    await goal.canceled;
  }

  receive(message) {
    if (message.data.length <= ID_BYTES) throw new WireError(`${message.manager} of ${this.name} is too short`);
    const id = hex(message.data.subarray(0, ID_BYTES));
    const goal = this.#goals.get(id);
    if (goal?.receive(message.manager, message.data[ID_BYTES], message.data.subarray(ID_BYTES + 1))) {
      this.#goals.delete(id);
    }
  }

  /** A result outlives a connection: it is asked for again. */
  again() {
    super.again();
    for (const goal of this.#goals.values()) this.#tell(goal.robot, "ActionResult", goal.id);
  }

  close() {
    super.close();
    for (const goal of this.#goals.values()) goal.end(new CallError("offline", "the action was closed"));
    this.#goals.clear();
  }

  #tell(robot, manager, id, rest = new Uint8Array(0)) {
    const data = new Uint8Array(id.length + rest.length);
    data.set(id);
    data.set(rest, id.length);
    const requestId = this.#next;
    this.#next = (requestId + 1) % REQUEST_IDS;
    return this.headset.sendNow(() => [{ to: ROS, ids: [robot], meta: this.metadata({ requestId, manager }), data }]);
  }
}

function hex(bytes) {
  return Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
}
