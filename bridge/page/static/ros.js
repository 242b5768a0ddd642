/**
 * ROS messages in a browser: CDR bytes to objects and back, by definitions that the gateway tells.
 *
 *     const types = new Types();
 *     const twist = await types.get("geometry_msgs/Twist", 1);   // as robot 1 has it
 *     drive.publish(twist.write({ linear: { x: 0.2 } }));
 *     twist.read(message.data).linear.x;
 *
 * Fields that are left out have their defaults. 64-bit integers are bigint.
 */

import { MessageReader, MessageWriter, parse } from "./vendor/libraries.js";

/** Longer texts and lists are cut when a message is shown. */
const SHOWN_ITEMS = 32;

/** One type of messages. */
export class Type {
  constructor(name, text) {
    this.name = name;
    this.text = text;
    this.definitions = parse(text, { ros2: true });
    this.byName = new Map(this.definitions.map((each) => [each.name ?? "", each.definitions]));
    this.fields = this.definitions[0].definitions.filter((field) => !field.isConstant);
    this.reader = new MessageReader(this.definitions);
    this.writer = null;
  }

  /** An object for CDR. Throws Error where it is none of this type. */
  read(cdr) {
    return this.reader.readMessage(cdr);
  }

  /** CDR for an object. Throws Error where a value does not fit. */
  write(value) {
    this.writer ??= new MessageWriter(this.definitions);
    return this.writer.writeMessage(value);
  }

  /** The fields of a message that is part of this one. */
  fieldsOf(name) {
    return (this.byName.get(name) ?? []).filter((field) => !field.isConstant);
  }

  /** Paths to single numbers, as `pose.position.x`. */
  numbers(fields = this.fields, prefix = "", depth = 0) {
    const found = [];
    for (const field of fields) {
      const path = prefix + field.name;
      if (field.isArray || depth > 6) continue;
      if (field.isComplex) found.push(...this.numbers(this.fieldsOf(field.type), `${path}.`, depth + 1));
      else if (/^(u?int\d+|float\d+|bool)$/.test(field.type)) found.push(path);
    }
    return found;
  }
}

/** The types that are known here, each asked for once per robot. */
export class Types {
  #known = new Map();

  /** `base` is the address of the gateway's page; `ask` gets JSON from there. */
  constructor(base = "", ask = askJson) {
    this.base = base;
    this.ask = ask;
  }

  /** A message type; rejects with Error where nobody knows it. */
  get(name, robot) {
    return this.#part(fullName(name, "msg"), robot);
  }

  /** The two halves of a service. */
  async service(name, robot) {
    const full = fullName(name, "srv");
    const [request, response] = await Promise.all([
      this.#part(`${full}_Request`, robot),
      this.#part(`${full}_Response`, robot),
    ]);
    return { request, response };
  }

  /** The three parts of an action. */
  async action(name, robot) {
    const full = fullName(name, "action");
    const parts = ["Goal", "Result", "Feedback"].map((part) => this.#part(`${full}_${part}`, robot));
    const [goal, result, feedback] = await Promise.all(parts);
    return { goal, result, feedback };
  }

  /** A robot that comes back may have other types. */
  forget(robot) {
    for (const key of this.#known.keys()) {
      if (key.startsWith(`${robot} `)) this.#known.delete(key);
    }
  }

  #part(full, robot) {
    const key = `${robot} ${full}`;
    let type = this.#known.get(key);
    if (type === undefined) {
      type = this.#fetch(full, robot);
      this.#known.set(key, type);
      type.catch(() => this.#known.delete(key)); // it may be known later
    }
    return type;
  }

  async #fetch(full, robot) {
    const { text, error } = await this.ask(`${this.base}/types/${robot}/${full}`);
    if (typeof text !== "string") throw new Error(error ?? `nobody knows the type ${full}`);
    return new Type(full, text);
  }
}

async function askJson(url) {
  return (await fetch(url)).json();
}

/** `pkg/msg/Name` for `pkg/Name`. */
export function fullName(name, kind) {
  const parts = name.split("/");
  return parts.length === 2 ? `${parts[0]}/${kind}/${parts[1]}` : name;
}

/** The value at a path as `pose.position.x`, as a number; null where there is none. */
export function numberAt(value, path) {
  let at = value;
  for (const part of path.split(".")) at = at?.[part];
  if (typeof at === "bigint" || typeof at === "boolean") return Number(at);
  return typeof at === "number" ? at : null;
}

/** A message as text for a person: long lists are cut. */
export function shown(value) {
  return JSON.stringify(value, cut, 2);
}

function cut(key, value) {
  if (typeof value === "bigint") return value.toString();
  if (typeof value === "number" && !Number.isFinite(value)) return String(value);
  if (typeof value === "string" && value.length > 2000) return `${value.slice(0, 2000)}… (${value.length} characters)`;
  if (ArrayBuffer.isView(value) || Array.isArray(value)) {
    if (value.length > SHOWN_ITEMS) {
      return [...Array.from(value.slice(0, SHOWN_ITEMS)), `… ${value.length} in all`];
    }
    return Array.from(value);
  }
  return value;
}
