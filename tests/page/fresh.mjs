// node fresh.mjs FOLDER-OF-MACS.JS: in which order a command, and the question whether the connection is fresh, go out.
import { pathToFileURL } from "node:url";

const { Headset } = await import(pathToFileURL(`${process.argv[2]}/macs.js`));
const sent = [];
let socket = null;
class Socket {
  bufferedAmount = 0;
  constructor() {
    socket = this;
  }
  send(bytes) {
    sent.push(new TextDecoder().decode(bytes));
  }
  close() {}
}

/** A message of the gateway's. */
function message(meta, data) {
  const [about, body] = [meta, data].map((each) => new TextEncoder().encode(JSON.stringify(each)));
  const size = (part) => new Uint8Array(new Uint32Array([part.length]).buffer);
  return new Uint8Array([...size(about), ...about, ...size(body), ...body]).buffer;
}

const headset = new Headset("ws://nowhere/macs", { WebSocket: Socket, resume: false });
const joined = headset.connect();
socket.onmessage({ data: message({ messageManager: "AgentConfigurer", requestId: 1 }, { agentId: 7 }) });
await joined;
const drive = headset.advertise("/cmd_vel", "geometry_msgs/Twist", { robots: [1] });
sent.length = 0;
drive.publish(new Uint8Array(8), { freshMs: 200 });
drive.publish(new Uint8Array(8), { freshMs: 200 });
await null;
process.stdout.write(JSON.stringify(sent.map((each) => (each.includes("OnlineAgentsGetter") ? "question" : "command"))));
headset.abort();
