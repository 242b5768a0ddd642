/**
 * A headset for browsers, workers and node: robots of a MACS mesh, through the WebSocket of a gateway.
 *
 *     import { Headset } from "./macs.js";
 *
 *     const headset = new Headset("ws://127.0.0.1:7080/macs");
 *     await headset.connect();
 *     const { robots } = await headset.online();
 *     headset.subscribe("/camera/image/compressed", "sensor_msgs/CompressedImage", { robots }, (message) => {
 *       console.log(message.senderId, message.data.length);
 *     });
 *     const drive = headset.advertise("/cmd_vel", "geometry_msgs/Twist", { robots: [1] });
 *     drive.publish(cdr, { freshMs: 200 });
 *
 * Messages are CDR: `ros.js` turns them into objects and back. A lost connection is made again until `close`, and every
 * node registered anew. **Nothing is kept to be sent later**: what cannot go now does not go, and `publish` says so.
 *
 * Events (CustomEvent, what they bring is in `detail`):
 *
 * | `link`     | the connection is up or lost: {up, id, why, resumed} |
 * | `id`       | the gateway gave another id: {id} |
 * | `presence` | after `follow`, who is online, when that has changed: {robots, headsets} |
 * | `gone`     | who has just left: [{type, id}] |
 * | `refused`  | a robot, or the gateway in its place, refused a node or what was sent: {robot, node, kind, reason} |
 * | `access`   | what the token does not permit, or that it has other rights now: {kind, reason} |
 * | `message`  | a `Message` that belongs to no node and answers no question |
 */

import {
  BROADCAST,
  MessageDecoder,
  NodeType,
  ROS,
  UNITY,
  WireError,
  frame,
  json,
  metadata,
  nodeName,
  object,
} from "./macs-wire.js";
import { Session } from "./macs-session.js";
import { ActionClient, CallError, Publisher, Service, ServiceClient, Subscription } from "./macs-nodes.js";

export { BROADCAST, ROS, UNITY, NodeType, WireError, CallError, nodeName, json, object };

/** The version of the protocol's extensions that is understood here. */
export const EXTENSIONS = 1;

const DEFAULTS = {
  group: 0,
  /** What `macs token create` printed; null: none, or the cookie of a login. */
  token: null,
  /** Come back as the same headset when a connection was lost, where the gateway knows sessions. */
  resume: true,
  handshakeMs: 5000,
  /** So long without other output, a heartbeat is sent. */
  heartbeatMs: 5000,
  /** So long without a word of the gateway, the connection is given up; half as long, it is asked. 0: never. */
  silenceMs: 10000,
  /** Pauses between attempts to connect; the last one repeats. */
  retryMs: [100, 200, 500, 1000],
  maxMessageBytes: 32 << 20,
  /** The constructor of WebSockets, where there is another one. */
  WebSocket: globalThis.WebSocket,
};

const SUBPROTOCOL = "macs.v1";
/** What one WebSocket message may have. */
const PIECE_BYTES = 1 << 20;
/** A gateway that knows no sessions says nothing about one. */
const RETURN_MS = 3000;
/** For so long a session is waited for; a gateway keeps it for 30 s unless it is set otherwise. */
const ASLEEP_MS = 30000;
const LATER = 1000;
/** So often a gateway is told how much has come, while something does. */
const TOLD_MS = 1000;
/** Reasons for which it makes no sense to come again. */
const FINAL = new Set(["no_token", "ended"]);
const REQUEST_IDS = 2 ** 31;

export class Headset extends EventTarget {
  #options;
  #socket = null;
  #decoder = null;
  #closed = false;
  #joining = null;
  #attempt = 0;
  #timers = new Map();
  #nodes = new Map();
  #questions = new Map();
  #next = 1;
  #welcome = 0;
  #sentAt = 0;
  #heardAt = 0;
  #pulse = { askedAt: 0, open: false };
  #following = "";
  #followMs = 0;
  #refused = "";
  #session = null;
  #greeted = false;
  #connected = false;

  /** `url` is that of a gateway's WebSocket, as ws://127.0.0.1:7080/macs. Options: see docs/macs-js.md. */
  constructor(url, options = {}) {
    super();
    this.url = String(url);
    this.#options = { ...DEFAULTS, ...options };
    if (this.#options.resume) this.#session = new Session();
    /** The number that others know this headset by; 0 before the first connection. */
    this.id = 0;
    this.#connected = false;
    /** How long the gateway took to answer the last question, in ms. */
    this.roundTripMs = null;
    /** Messages that came and could not be read. */
    this.badMessages = 0;
    /** How many connections were begun: another number is another connection. */
    this.joins = 0;
    /** A `CommandClock`, where commands tell their time. */
    this.clock = null;
  }

  /** Whether there is a connection now that the gateway has greeted. */
  get connected() {
    return this.#connected;
  }

  get group() {
    return this.#options.group;
  }

  /** Bytes that wait here, as the network does not take them. */
  get waitingBytes() {
    return this.#socket?.bufferedAmount ?? 0;
  }

  /** Messages that were larger than `maxMessageBytes`. */
  get tooLarge() {
    return this.#decoder?.tooLarge ?? 0;
  }

  get nodes() {
    return [...this.#nodes.values()];
  }

  /**
   * Connect; resolves with the id. The first connection is tried once, and later ones until `close`. With a token it
   * resolves when that was taken. Rejects with CallError.
   */
  async connect() {
    this.#closed = false;
    try {
      await this.#join();
      if (this.#options.token !== null) await this.online();
    } catch (error) {
      this.close();
      throw this.#refused ? new CallError("refused", this.#refused) : error;
    }
    return this.id;
  }

  /** Connect, and go on trying until there is somebody or `close`: for pages that may come before their gateway. */
  keepConnecting() {
    this.#closed = false;
    this.#join().catch(() => {});
  }

  /** Say that it leaves, and end. */
  close() {
    this.#closed = true;
    if (this.#connected) {
      this.#send(frame({ management: { messageManager: "UnityAgentclientRemover", agentId: this.id } }));
    }
    this.#lost("closed here");
  }

  /** Cut the connection and live on, as when a network is lost: a new one is made. */
  drop() {
    this.#lost("it was cut here");
  }

  /** End without a word, as a headset that lost power. */
  abort() {
    this.#closed = true;
    this.#lost("aborted here");
  }

  // -- what a headset says -------------------------------------------------------------------------------------------

  /** Who is online: {robots, headsets}, lists of ids. Rejects with CallError. */
  async online({ timeoutMs = 5000 } = {}) {
    const began = performance.now();
    const management = { messageManager: "OnlineAgentsGetter", agentType: UNITY, agentId: this.id };
    const answer = object(await this.#ask(null, "who is online", timeoutMs, (meta) => ({ management, meta })));
    this.roundTripMs = performance.now() - began;
    return { robots: numbers(answer.rosAgentIds), headsets: numbers(answer.unityAgentIds) };
  }

  /** Ask who is online every so often, and tell changes as `presence`. 0: no more. */
  follow(everyMs = 1000) {
    this.#clear("follow");
    this.#followMs = everyMs;
    if (!everyMs || !this.#connected) return;
    const look = async () => {
      try {
        const seen = await this.online();
        if (JSON.stringify(seen) !== this.#following) {
          this.#following = JSON.stringify(seen);
          this.#tell("presence", seen);
        }
      } catch {
        // it is asked again
      }
      if (this.#connected && this.#followMs) this.#set("follow", everyMs, look);
    };
    look();
  }

  /** Receive a topic of these robots and groups. One that is received already gets the new robots, and this callback. */
  subscribe(topic, type, { robots = [], groups = [], ...options } = {}, onMessage = () => {}) {
    const node = this.#node(NodeType.SUBSCRIBER, topic, () => new Subscription(this, topic, type, options, onMessage));
    node.onMessage = onMessage;
    return node.register({ robots, groups });
  }

  /** Ask these robots for a publisher of this topic. */
  advertise(topic, type, { robots = [], groups = [], ...options } = {}) {
    const node = this.#node(NodeType.PUBLISHER, topic, () => new Publisher(this, topic, type, options));
    return node.register({ robots, groups });
  }

  /** Call a service that runs on a robot; resolves with the response's CDR. Rejects with CallError. */
  call(service, type, robot, request, options) {
    const node = this.#node(NodeType.CLIENT, service, () => new ServiceClient(this, service, type));
    return node.register({ robots: [robot] }).call(robot, request, options);
  }

  /** Serve ROS nodes of these robots: `handler(request, robot)` returns the response's CDR, or a promise of it. */
  serve(service, type, { robots = [], groups = [] } = {}, handler) {
    const node = this.#node(NodeType.SERVICE, service, () => new Service(this, service, type, handler));
    return node.register({ robots, groups });
  }

  /** Register to give goals to an action of these robots. */
  action(name, type, { robots = [], groups = [], ...options } = {}) {
    const node = this.#node(NodeType.ACTION, name, () => new ActionClient(this, name, type, options));
    return node.register({ robots, groups });
  }

  /** Ask a robot something that is no interface node, as RobotStatus; resolves with its JSON. Rejects with CallError. */
  async ask(robot, manager, data = new Uint8Array(0), { timeoutMs = 5000 } = {}) {
    const answer = await this.#ask(robot, `${manager} of robot ${robot}`, timeoutMs, (meta) => ({
      to: ROS,
      ids: [robot],
      meta: { ...meta, messageManager: manager },
      data: data instanceof Uint8Array ? data : json(data),
    }));
    return notRefused(object(answer));
  }

  /** Ask a manager that somebody added to the gateway (docs/managers.md). */
  async askGateway(manager, data = {}, { timeoutMs = 5000 } = {}) {
    const management = { ...data, messageManager: manager };
    return notRefused(object(await this.#ask(null, manager, timeoutMs, (meta) => ({ management, meta }))));
  }

  /** Send bytes to agents of type `to`, by id and by group; BROADCAST goes to everybody. Whether they were sent. */
  send(data, { to = BROADCAST, ids = [], groups = [], manager = "", requestId = 0 } = {}) {
    return this.sendNow(() => [{ to, ids, groups, meta: metadata(this.id, { manager, requestId }), data }]);
  }

  /** Be in another group. */
  setGroup(group) {
    this.#options.group = group;
    if (this.#connected) this.#configure();
  }

  // -- for nodes -----------------------------------------------------------------------------------------------------

  /** Send these frames if there is a connection; whether they were sent. */
  sendNow(frames) {
    if (!this.#connected) return false;
    for (const each of frames()) this.#send(frame(each));
    return true;
  }

  /**
   * Send only over a connection that is known to be fresh: nothing waits here, and the gateway has answered what it was
   * asked `freshMs` ago. So no more goes into a network that stands still than what was sent in that time.
   */
  sendFresh(frames, freshMs) {
    return this.waitingBytes === 0 && this.isFresh(freshMs) && this.sendNow(frames);
  }

  /**
   * Whether the gateway has answered what it was asked `freshMs` ago; it is asked. Who sends several messages at once asks
   * this: `waitingBytes` counts those that have just been sent, however quick the network is.
   */
  isFresh(freshMs) {
    if (!this.#connected) return false;
    const now = performance.now();
    if (this.#pulse.open && now - this.#pulse.askedAt > freshMs) return false;
    if (!this.#pulse.open) {
      const pulse = (this.#pulse = { askedAt: now, open: true });
      const answered = () => (pulse.open = false);
      // behind what is sent now, and not before it
      queueMicrotask(() => this.online({ timeoutMs: 60000 }).then(answered, answered));
    }
    return true;
  }

  /** Send what a reconnection would repeat anyway; of a session that is asleep, when it goes on. */
  sendIfOnline(one) {
    if (this.sendNow(() => [one()]) || !this.#session?.secret) return;
    this.#session.later.push(one);
    if (this.#session.later.length > LATER) this.#session.end(); // all is registered anew
  }

  forget(node) {
    this.#nodes.delete(key(node));
  }

  // -- the connection ------------------------------------------------------------------------------------------------

  #join() {
    const { WebSocket: Socket, handshakeMs, maxMessageBytes } = this.#options;
    this.joins += 1;
    const socket = new Socket(this.url, [SUBPROTOCOL]);
    socket.binaryType = "arraybuffer";
    this.#socket = socket;
    this.#greeted = false;
    this.#decoder = new MessageDecoder(maxMessageBytes);
    socket.onmessage = ({ data }) => this.#read(new Uint8Array(data));
    socket.onclose = ({ reason }) => this.#lost(reason || "the connection was closed");
    socket.onerror = () => {}; // onclose follows
    this.#set("handshake", handshakeMs, () => this.#lost("the gateway gave no id in time"));
    return new Promise((resolve, reject) => (this.#joining = { resolve, reject }));
  }

  #read(bytes) {
    this.#heardAt = performance.now();
    const tooLarge = this.tooLarge;
    let messages;
    try {
      messages = this.#decoder.feed(bytes);
    } catch (error) {
      if (!(error instanceof WireError)) throw error;
      this.#lost(`what came makes no sense: ${error.message}`);
      return;
    }
    this.#count(this.tooLarge - tooLarge);
    for (const message of messages) {
      if (this.#socket === null) return; // one of them ended it
      try {
        if (!Session.isAbout(message) && this.#greeted) this.#count(1);
        if (message instanceof WireError) throw message;
        this.#take(message);
      } catch (error) {
        this.badMessages += 1;
        if (!(error instanceof WireError)) report(error);
      }
    }
  }

  #take(message) {
    if (message.nodeName) {
      this.#takeForNode(message); // the node's name counts first: topic data also names a manager
    } else if (message.manager === "AgentConfigurer") {
      this.#takeId(message);
    } else if (Session.isAbout(message)) {
      this.#takeSession(message.manager, object(message.data));
    } else if (!message.manager && this.#questions.has(message.requestId)) {
      this.#answered(message);
    } else if (message.manager === "PrunedUnityAgentsInterfaceNodesCleaner" && message.senderType === null) {
      const { agents } = object(message.data);
      if (!Array.isArray(agents)) throw new WireError("who has left is no list");
      this.#following = ""; // who is back before the next answer is told anew
      this.#tell("gone", agents.map((each) => ({ type: each.agent_type, id: each.agent_id })));
    } else if (message.manager === "AccessRefused" && message.senderType === null) {
      this.#takeAccess(object(message.data));
    } else if (message.manager === "InterfaceNodeRefused" || message.manager === "InterfaceDataRefused") {
      this.#takeRefusal(message);
    } else {
      this.#tell("message", message);
    }
  }

  #takeForNode(message) {
    const node = this.#nodes.get(key(message));
    if (node === undefined) this.#tell("message", message);
    else if (message.senderType !== ROS) throw new WireError(`data of ${node.name} that is from no robot`);
    else node.receive(message);
  }

  #takeId(message) {
    const { agentId } = object(message.data);
    if (!Number.isInteger(agentId) || agentId < 0 || agentId > 0xffff) throw new WireError(`${agentId} is no id`);
    const before = this.id;
    this.#welcome = message.requestId;
    this.id = agentId;
    if (this.#connected) {
      this.#configure();
      if (agentId !== before) this.#tell("id", { id: agentId }); // a question to a headset is the same message
      return;
    }
    this.#clear("handshake");
    this.#configure(this.#greeted ? null : this.#session);
    this.#greeted = true;
    if (this.#session?.secret) this.#set("return", RETURN_MS, () => this.#enter({}));
    else this.#enter({});
  }

  /** What became of the session: it goes on, or another one has begun. */
  #takeSession(manager, { session, agentId, received }) {
    if (this.#session === null) return;
    if (manager === "SessionResumed") {
      if (!Number.isInteger(agentId) || !Number.isInteger(received)) throw new WireError("a session without numbers");
      if (this.#connected) {
        this.#session.end();
        this.#lost("a session that comes too late");
        return;
      }
      this.id = agentId;
      this.#enter({ resumed: true, lost: this.#session.goOn(received) });
    } else {
      if (typeof session !== "string") throw new WireError("a session without a secret");
      if (!this.#connected) this.#enter({}); // it had shown another one
      this.#session.begin(session);
    }
  }

  /** It is online now. */
  #enter({ resumed = false, lost = 0 }) {
    this.#clear("return", "asleep");
    this.#attempt = 0;
    this.#pulse.open = false;
    this.#connected = true;
    const later = this.#session?.later.splice(0) ?? [];
    if (!resumed) {
      this.#failOpen("the connection was lost");
      this.#session?.end();
    }
    this.#watch();
    if (resumed) for (const one of later) this.sendIfOnline(one);
    if (!resumed || lost) for (const node of this.nodes) node.again();
    this.#joining?.resolve(this.id);
    this.#joining = null;
    if (this.#followMs) this.follow(this.#followMs); // a question from before may never be answered
    this.#tell("link", { up: true, id: this.id, why: "", resumed });
  }

  /** The first configuration of a connection says what is known of the session, and is not counted. */
  #configure(session = null) {
    const { group, token } = this.#options;
    const management = {
      agentType: UNITY,
      agentId: this.id,
      groupId: group,
      requestId: this.#welcome,
      messageManager: "AgentclientConfigurer",
      extensions: EXTENSIONS,
    };
    if (token !== null) management.token = token;
    this.#send(frame({ management: { ...management, ...session?.said } }));
    if (session !== null) session.sent -= 1;
  }

  #takeAccess({ kind, reason, requestId }) {
    if (FINAL.has(kind)) {
      this.#refused = reason;
      this.#closed = true; // coming again would change nothing
    }
    if (kind === "not_permitted") this.#fail(requestId, new CallError("refused", String(reason)));
    this.#tell("access", { kind, reason });
  }

  #takeRefusal(message) {
    const said = object(message.data);
    const robot = message.senderType === ROS ? message.senderId : said.robotId;
    const node = this.#nodes.get(key(said));
    const whom = robot ? [robot] : [...(node?.robots ?? [])];
    const kind = said.kind ?? "refused";
    for (const each of whom) node?.refused(each, said.reason, kind);
    this.#tell("refused", { robot, node: node ?? null, name: node?.name ?? (said.tosName || said.nodeName), kind, reason: said.reason });
  }

  /** The connection is gone, however it went: tell, and make another one. */
  #lost(why) {
    const socket = this.#socket;
    if (socket === null) return;
    this.#socket = null;
    socket.onmessage = socket.onclose = null;
    socket.close();
    this.#clear("handshake", "beat", "silence", "return", "follow");
    const was = this.#connected;
    this.#connected = false;
    this.#following = "";
    // what is open may still be answered where the session goes on; it has times of its own
    const asleep = !this.#closed && Boolean(this.#session?.secret);
    if (!asleep) this.#failOpen(why);
    else if (was) this.#set("asleep", ASLEEP_MS, () => this.#failOpen(why));
    this.#joining?.reject(new CallError("offline", why));
    this.#joining = null;
    if (was || this.#refused) this.#tell("link", { up: false, id: this.id, why: this.#refused || why });
    if (this.#closed) {
      this.#clear("retry", "asleep");
      this.#session?.end();
    } else {
      const { retryMs } = this.#options;
      const pause = retryMs[Math.min(this.#attempt++, retryMs.length - 1)];
      this.#set("retry", pause, () => this.#join().catch(() => {}));
    }
  }

  #failOpen(why) {
    for (const requestId of [...this.#questions.keys()]) this.#fail(requestId, new CallError("offline", why));
    for (const node of this.nodes) node.end(why);
  }

  #count(messages) {
    if (this.#session?.open) this.#session.received += messages;
  }

  /** Say something when nothing else was said for a while, and notice when nobody says anything any more. */
  #watch() {
    const { heartbeatMs, silenceMs } = this.#options;
    const beat = () => {
      const due = this.#sentAt + heartbeatMs - performance.now();
      const untold = this.#session?.open && this.#session.received > this.#session.told;
      if (due <= 0 || untold) this.#beat();
      this.#set("beat", Math.min(due <= 0 ? heartbeatMs : due, this.#session?.open ? TOLD_MS : heartbeatMs), beat);
    };
    this.#set("beat", TOLD_MS, beat);
    if (!silenceMs) return;
    const listen = () => {
      const silent = performance.now() - this.#heardAt;
      if (silent >= silenceMs) return this.#lost(`the gateway said nothing for ${Math.round(silent)} ms`);
      if (silent >= silenceMs / 2) this.online({ timeoutMs: silenceMs }).catch(() => {});
      this.#set("silence", silenceMs / 4, listen);
    };
    this.#set("silence", silenceMs / 4, listen);
  }

  /** So many messages have come: the gateway keeps those behind them, for a session that goes on. */
  #beat() {
    const management = { messageManager: "HeartbeatHandler" };
    if (this.#session?.open) this.#session.told = management.received = this.#session.received;
    this.#send(frame({ management }));
  }

  #send(bytes) {
    if (this.#session) this.#session.sent += 1;
    for (let at = 0; at < bytes.length; at += PIECE_BYTES) this.#socket.send(bytes.subarray(at, at + PIECE_BYTES));
    this.#sentAt = performance.now();
  }

  // -- questions -----------------------------------------------------------------------------------------------------

  #ask(robot, what, timeoutMs, question) {
    const requestId = this.#next;
    this.#next = (requestId + 1) % REQUEST_IDS;
    return new Promise((resolve, reject) => {
      const late = () => this.#fail(requestId, new CallError("timeout", `no answer within ${timeoutMs} ms: ${what}`));
      this.#questions.set(requestId, { robot, resolve, reject, timer: setTimeout(late, timeoutMs) });
      if (!this.sendNow(() => [question(metadata(this.id, { requestId }))])) {
        this.#fail(requestId, new CallError("offline", "there is no connection"));
      }
    });
  }

  #answered(message) {
    const { robot, resolve, timer } = this.#questions.get(message.requestId);
    const bySomebodyElse = robot === null ? message.senderType !== null : message.senderType === UNITY;
    if (bySomebodyElse || (robot !== null && message.senderId !== null && message.senderId !== robot)) {
      this.#tell("message", message);
      return;
    }
    this.#questions.delete(message.requestId);
    clearTimeout(timer);
    resolve(message.data.slice());
  }

  #fail(requestId, error) {
    const question = this.#questions.get(requestId);
    if (question === undefined) return;
    this.#questions.delete(requestId);
    clearTimeout(question.timer);
    question.reject(error);
  }

  // -- small things --------------------------------------------------------------------------------------------------

  #node(nodeType, name, make) {
    const found = this.#nodes.get(key({ nodeType, nodeName: nodeName(name) }));
    if (found !== undefined) {
      if (found.name !== name) throw new RangeError(`${name} and ${found.name} have one node name`);
      return found;
    }
    const node = make();
    this.#nodes.set(key(node), node);
    return node;
  }

  #tell(type, detail) {
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }

  #set(name, ms, callback) {
    this.#clear(name);
    this.#timers.set(name, setTimeout(callback, ms));
  }

  #clear(...names) {
    for (const name of names) {
      clearTimeout(this.#timers.get(name));
      this.#timers.delete(name);
    }
  }
}

function key({ nodeType, nodeName: name }) {
  return `${nodeType} ${name}`;
}

function numbers(list) {
  return Array.isArray(list) ? list.filter(Number.isInteger) : [];
}

function notRefused(answer) {
  if (typeof answer.refused === "string") throw new CallError("refused", answer.refused);
  return answer;
}

/** A callback of our user's failed: it costs its message, never the connection. */
function report(error) {
  if (typeof reportError === "function") reportError(error);
  else console.error(error);
}
