/**
 * The bytes of the MACS protocol: frames to a gateway, messages from it. Pure: values in, bytes out, and back.
 *
 * All integers are little-endian. A frame is a header of 39 bytes, management data, and a message; a message is the size
 * of its metadata, those, the size of its data, and those (docs/protocol.md).
 */

/** Types of agents. */
export const BROADCAST = 0;
export const ROS = 1;
export const UNITY = 2;

/** Types of interface nodes. */
export const NodeType = Object.freeze({ SUBSCRIBER: 1, PUBLISHER: 2, CLIENT: 3, SERVICE: 4, ACTION: 5 });

const SLOTS = 10;
const HEADER_BYTES = 39;
const METADATA_BYTES = 64 << 10;
/** Existing programs take such a size for a negative number, so nobody sends it: behind it nothing can be found. */
const NO_SIZE = 0x80000000;

const encoder = new TextEncoder();
const strict = new TextDecoder("utf-8", { fatal: true });

/** What went wrong with bytes that came. After `final` nothing more can be read from this connection. */
export class WireError extends Error {
  constructor(message, { final = false } = {}) {
    super(message);
    this.name = "WireError";
    this.final = final;
  }
}

/** `nd__cmd_vel` for `/cmd_vel`: how messages name the interface node of a topic, service or action. */
export function nodeName(name) {
  return `nd_${name.replace(/[/~]/g, "_")}`;
}

/** `pkg/Name` for `pkg/msg/Name`, as the protocol writes types. */
export function typeName(type) {
  return type.replace(/^([^/]+)\/(?:msg|srv|action)\//, "$1/");
}

/** Metadata in the order in which headsets write it. */
export function metadata(sender, { manager = "", requestId = 0, node = null } = {}) {
  return {
    senderAgentType: UNITY,
    senderAgentId: sender,
    messageManager: manager,
    requestId,
    nodeType: node?.nodeType ?? 0,
    nodeName: node?.nodeName ?? "",
    dataExchangeType: node?.type ?? "",
  };
}

/**
 * One frame.
 *
 * `to` is the type of agents that it goes to, `ids` and `groups` which of them: at most ten of each. With `management`
 * it is for the gateway. Without `meta` its message is empty. Throws RangeError.
 */
export function frame({ to = BROADCAST, ids = [], groups = [], management = null, meta = null, data = null }) {
  if (ids.length > SLOTS || groups.length > SLOTS) {
    throw new RangeError(`at most ${SLOTS} agents and ${SLOTS} groups, not ${ids.length} and ${groups.length}`);
  }
  const managing = management === null ? new Uint8Array(0) : encoder.encode(JSON.stringify(management));
  const about = meta === null ? new Uint8Array(0) : encoder.encode(JSON.stringify(meta));
  const body = data ?? new Uint8Array(0);
  const bytes = new Uint8Array(HEADER_BYTES + managing.length + 8 + about.length + body.length);
  const view = new DataView(bytes.buffer);
  view.setUint8(0, to);
  ids.forEach((id, slot) => view.setUint16(1 + 2 * slot, numbered("an agent", id, 0xffff), true));
  groups.forEach((group, slot) => view.setUint8(21 + slot, numbered("a group", group, 0xff)));
  view.setUint32(31, managing.length, true);
  view.setUint32(35, 8 + about.length + body.length, true);
  bytes.set(managing, HEADER_BYTES);
  const message = HEADER_BYTES + managing.length;
  view.setUint32(message, about.length, true);
  bytes.set(about, message + 4);
  view.setUint32(message + 4 + about.length, body.length, true);
  bytes.set(body, message + 8 + about.length);
  return bytes;
}

function numbered(what, number, most) {
  if (!Number.isInteger(number) || number < 0 || number > most) {
    throw new RangeError(`${what} has a number from 0 to ${most}, not ${number}`);
  }
  return number;
}

/** JSON in the data of a message, as bytes. */
export function json(value) {
  return encoder.encode(JSON.stringify(value));
}

/** The JSON object in the data of a message, its keys in camelCase. Throws WireError. */
export function object(data) {
  let value;
  try {
    value = JSON.parse(strict.decode(data));
  } catch (error) {
    throw new WireError(`no JSON: ${error.message}`);
  }
  if (value === null || typeof value !== "object" || Array.isArray(value)) {
    throw new WireError("JSON that is no object");
  }
  return Object.fromEntries(Object.entries(value).map(([key, field]) => [camel(key), field]));
}

/** `agentId` for `agent_id` and `AgentId`: programs write keys in all three ways. */
function camel(key) {
  const joined = key.replace(/_+([a-zA-Z0-9])/g, (_, letter) => letter.toUpperCase());
  return joined.charAt(0).toLowerCase() + joined.slice(1);
}

const KEYS = {
  senderAgentType: ["number", null],
  senderAgentId: ["number", null],
  messageManager: ["string", ""],
  requestId: ["number", 0],
  nodeType: ["number", 0],
  nodeName: ["string", ""],
  dataExchangeType: ["string", ""],
};

/** Metadata that came, with a value for each key. Throws WireError. */
function readMetadata(bytes) {
  const said = object(bytes);
  const read = {};
  for (const [key, [type, missing]] of Object.entries(KEYS)) {
    const value = said[key] ?? missing;
    if (value !== null && typeof value !== type) {
      throw new WireError(`${key} of a message is ${typeof value}, not a ${type}`);
    }
    read[key] = value;
  }
  return read;
}

/**
 * A message that came. `senderType` is 1 for robots, 2 for headsets, null for the gateway itself. `data` is a view on
 * what the socket brought: copy what you keep for long.
 */
export class Message {
  constructor(meta, data) {
    this.senderType = meta.senderAgentType;
    this.senderId = meta.senderAgentId;
    this.manager = meta.messageManager;
    this.requestId = meta.requestId;
    this.nodeType = meta.nodeType;
    this.nodeName = meta.nodeName;
    this.type = meta.dataExchangeType;
    this.data = data;
  }
}

/** Cuts what a connection brings, in pieces of any size, into messages. */
export class MessageDecoder {
  #pieces = [];
  #length = 0;
  #wanted = 4;
  #skip = 0;

  constructor(maxMessageBytes) {
    this.maxMessageBytes = maxMessageBytes;
    /** How many messages were let go of because they were larger than that. */
    this.tooLarge = 0;
  }

  /**
   * Take the next bytes; each message that is now whole is a `Message`, or a WireError that cost only itself.
   * Throws a final WireError when nothing more can be found on this connection.
   */
  feed(bytes) {
    const left = bytes.subarray(Math.min(this.#skip, bytes.length));
    this.#skip -= bytes.length - left.length;
    if (left.length) {
      this.#pieces.push(left);
      this.#length += left.length;
    }
    const messages = [];
    while (this.#length >= this.#wanted) {
      const all = this.#joined();
      const whole = this.#size(all);
      if (whole === null) continue; // more is wanted
      const { about, size } = whole;
      if (size > this.maxMessageBytes) {
        this.tooLarge += 1;
        this.#skip = Math.max(0, size - all.length);
      } else if (all.length < size) {
        this.#wanted = size;
        continue;
      } else {
        messages.push(read(all.subarray(0, size), about));
      }
      this.#keep(all.subarray(Math.min(size, all.length)));
    }
    return messages;
  }

  /** Sizes of the message at the beginning; null when they are not there yet. */
  #size(all) {
    const view = new DataView(all.buffer, all.byteOffset, all.length);
    const about = view.getUint32(0, true);
    if (about > METADATA_BYTES) throw new WireError(`metadata of ${about} bytes`, { final: true });
    if (all.length < 8 + about) {
      this.#wanted = 8 + about;
      return null;
    }
    const data = view.getUint32(4 + about, true);
    if (data >= NO_SIZE) throw new WireError(`data of ${data} bytes`, { final: true });
    return { about, size: 8 + about + data };
  }

  #joined() {
    if (this.#pieces.length > 1) {
      const all = new Uint8Array(this.#length);
      let at = 0;
      for (const piece of this.#pieces) {
        all.set(piece, at);
        at += piece.length;
      }
      this.#pieces = [all];
    }
    return this.#pieces[0];
  }

  #keep(rest) {
    this.#pieces = rest.length ? [rest] : [];
    this.#length = rest.length;
    this.#wanted = 4;
  }
}

function read(message, about) {
  try {
    return new Message(readMetadata(message.subarray(4, 4 + about)), message.subarray(8 + about));
  } catch (error) {
    if (error instanceof WireError) return error;
    throw error;
  }
}
