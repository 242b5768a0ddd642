// The headset of headset.js in a worker: {url} begins it, {end} ends it.
import * as macs from "/macs.js";
import { begin } from "/headset.js";

let end = null;
self.onmessage = ({ data }) => {
  if (data.url) end = begin(macs, data.url);
  else end();
};
