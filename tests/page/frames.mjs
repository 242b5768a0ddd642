// node frames.mjs FOLDER-OF-MACS.JS < JSON of {frames, messages}: what macs-wire.js makes of them, as JSON.
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const { MessageDecoder, WireError, frame, object } = await import(pathToFileURL(`${process.argv[2]}/macs-wire.js`));
const { frames, messages } = JSON.parse(readFileSync(0, "utf8"));
const bytes = (hex) => Uint8Array.from(hex.match(/../g) ?? [], (two) => parseInt(two, 16));
const hex = (data) => Buffer.from(data).toString("hex");

const made = frames.map(({ type, ids, groups, management, metadata, data }) =>
  hex(frame({ to: type, ids, groups, management, meta: metadata, data: data === null ? null : bytes(data) })),
);

/** Messages in these pieces: metadata and data of each, or why there is none. */
function read(pieces) {
  const decoder = new MessageDecoder(1 << 20);
  const found = [];
  try {
    for (const piece of pieces) {
      for (const message of decoder.feed(piece)) {
        found.push(message instanceof WireError ? "bad" : [message.manager, message.nodeName, hex(message.data)]);
      }
    }
  } catch (error) {
    if (!(error instanceof WireError) || !error.final) throw error;
    found.push("lost");
  }
  return found;
}

/** Each way of cutting must give the same. */
function cut(data) {
  const whole = read([data]);
  const ways = [Array.from(data, (_, at) => data.subarray(at, at + 1))];
  for (let at = 1; at < data.length; at++) ways.push([data.subarray(0, at), data.subarray(at)]);
  for (const way of ways) {
    const found = read(way);
    if (JSON.stringify(found) !== JSON.stringify(whole)) throw new Error(`${JSON.stringify(found)}, whole ${JSON.stringify(whole)}`);
  }
  return whole;
}

const answers = messages.map((message) => cut(bytes(message)));
const keys = object(Buffer.from('{"agent_id": 1, "AgentId2": 2, "agentID": 3, "x": {"a_b": 1}}'));
process.stdout.write(JSON.stringify({ made, answers, keys }));
