// node headset.mjs FOLDER-OF-MACS.JS ws://127.0.0.1:PORT/macs
import { pathToFileURL } from "node:url";
import { begin } from "./headset.js";

const [folder, url] = process.argv.slice(2);
const end = begin(await import(pathToFileURL(`${folder}/macs.js`)), url);
process.on("SIGTERM", () => {
  end();
  setTimeout(() => process.exit(0), 300);
});
