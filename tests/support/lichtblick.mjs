// node lichtblick.mjs FOLDER-OF-PACKAGES FILE: opens a recording with the packages that Foxglove and Lichtblick read files with, and prints
// what is in it: {profile, library, channels: {topic: {type, count, metadata, first, last}}}.
import { open } from "node:fs/promises";
import { createRequire } from "node:module";
import { resolve } from "node:path";

const [, , packages, path] = process.argv;
const require = createRequire(resolve(packages, "node_modules", "none.js"));
const { McapIndexedReader } = require("@mcap/core");
const { loadDecompressHandlers } = require("@mcap/support");
const { parse } = require("@foxglove/rosmsg");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");

const file = await open(path);
const readable = {
  size: async () => BigInt((await file.stat()).size),
  read: async (offset, size) => {
    const bytes = new Uint8Array(Number(size));
    const { bytesRead } = await file.read(bytes, 0, bytes.length, Number(offset));
    if (bytesRead !== bytes.length) throw new Error(`${bytesRead} of ${bytes.length} bytes at ${offset}`);
    return bytes;
  },
};
const decompressHandlers = await loadDecompressHandlers();
const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
const readers = new Map();
for (const { id, data, encoding } of reader.schemasById.values()) {
  if (encoding !== "ros2msg") throw new Error(`a schema of ${encoding}`);
  readers.set(id, new MessageReader(parse(new TextDecoder().decode(data), { ros2: true })));
}
const channels = {};
for await (const { channelId, data } of reader.readMessages()) {
  const { topic, schemaId, messageEncoding, metadata } = reader.channelsById.get(channelId);
  const value = messageEncoding === "json" ? JSON.parse(new TextDecoder().decode(data)) : readers.get(schemaId).readMessage(data);
  const type = reader.schemasById.get(schemaId)?.name ?? "";
  const found = (channels[topic] ??= { type, count: 0, metadata: Object.fromEntries(metadata), first: value });
  found.count += 1;
  found.last = value;
}
const { profile, library } = reader.header;
const text = (_name, value) => (typeof value === "bigint" ? Number(value) : ArrayBuffer.isView(value) ? [...value] : value);
console.log(JSON.stringify({ profile, library, statistics: reader.statistics, channels }, (name, value) => {
  return value instanceof Map ? Object.fromEntries(value) : text(name, value);
}));
