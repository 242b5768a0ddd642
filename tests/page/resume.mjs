// node resume.mjs FOLDER-OF-MACS.JS ws://…/macs: a headset is cut off while others say something to it; JSON of what came.
import { pathToFileURL } from "node:url";

const [folder, url] = process.argv.slice(2);
const { Headset, ROS, UNITY } = await import(pathToFileURL(`${folder}/macs.js`));
const encoder = new TextEncoder();
const decoder = new TextDecoder();
const until = async (what) => {
  while (!what()) await new Promise((resolve) => setTimeout(resolve, 10));
};
const one = new Headset(url);
const two = new Headset(url);
const heard = [];
const links = [];
one.addEventListener("message", ({ detail }) => heard.push(decoder.decode(detail.data)));
one.addEventListener("link", ({ detail }) => links.push([detail.up, detail.id, detail.resumed ?? false]));
await one.connect();
await two.connect();
one.subscribe("/state", "std_msgs/String", { robots: [1] });
const say = async (text) => {
  two.send(encoder.encode(text), { to: UNITY, ids: [one.id] });
  await until(() => heard.includes(text));
};
for (let number = 0; number < 20; number++) await say(`before ${number}`);
const id = one.id;
one.drop();
const asked = one.online().then(
  () => "answered",
  (error) => error.kind,
);
one.subscribe("/later", "std_msgs/String", { robots: [1] });
for (let number = 0; number < 20; number++) two.send(encoder.encode(`asleep ${number}`), { to: UNITY, ids: [id] });
await two.online();
await until(() => one.connected);
for (let number = 0; number < 20; number++) await say(`after ${number}`);
const sent = one.send(encoder.encode("to the robot"), { to: ROS, ids: [1] });
const online = await one.online();
process.stdout.write(JSON.stringify({ id, back: one.id, heard, links, sent, asked: await asked, online, bad: one.badMessages }));
one.close();
two.close();
