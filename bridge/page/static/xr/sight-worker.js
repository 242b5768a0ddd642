/** The worker of what is seen: what the scene posts, given to a `SightLink`. */

import { SightLink } from "./sight-link.js";

let link = null;

const ops = {
  begin: ({ url, commands, least }) => {
    link = new SightLink({ url, commands, least, tell: (message, transfer = []) => self.postMessage(message, transfer) });
  },
  watch: ({ wishes }) => link.watch(wishes),
  shown: ({ key, buffers }) => link.shown(key, buffers),
  points: ({ most }) => (link.points = most),
  poke: () => link.poke(),
  drop: () => link.headset.drop(),
  close: () => link.close(),
};

self.onmessage = ({ data }) => ops[data.op](data);
