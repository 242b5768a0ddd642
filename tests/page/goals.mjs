// node goals.mjs FOLDER-OF-MACS.JS: what is asked for again after a reconnection, of a goal whose robot does not know it.
import { pathToFileURL } from "node:url";

const { ActionClient } = await import(pathToFileURL(`${process.argv[2]}/macs-nodes.js`));
const said = [];
const headset = { id: 1, forget() {}, sendIfOnline() {}, sendNow: (frames) => said.push(...frames()) };
const action = new ActionClient(headset, "/dock", "own/Dock", {});
const tell = (manager, id, ...rest) => action.receive({ manager, data: Uint8Array.from([...id, ...rest]) });
const given = action.sendGoal(1, new Uint8Array(4));
const id = said[0].data.subarray(0, 16);
tell("ActionAccepted", id, 1);
const goal = await given;
action.again();
const open = said.length;
tell("ActionResult", id, 0, ...new TextEncoder().encode("no such goal"));
action.again();
const why = await goal.result.catch((error) => error.message);
process.stdout.write(JSON.stringify({ asked: open - 1, askedAfter: said.length - open, why }));
