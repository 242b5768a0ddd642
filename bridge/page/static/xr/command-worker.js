/** The worker of commands: what the scene posts, given to a `CommandLink`. */

import { CommandLink } from "./command-link.js";

let link = null;

/** The scene's clock and this one began at other times. */
const here = (at) => at - performance.timeOrigin;

const ops = {
  begin: ({ url, me, kept, sight }) => {
    link = new CommandLink({ url, me, kept, tell: (message) => self.postMessage(message) });
    sight.onmessage = ({ data: { key, at, late } }) => link.see(key, at === undefined ? null : { at: at && here(at), late });
    self.macsXr = link;
  },
  aim: ({ target }) => link.aim(target),
  guard: ({ keys }) => link.guard(keys),
  settings: ({ values }) => link.set(values),
  input: ({ at, sample, poses }) => link.input({ at: here(at), sample, poses }),
  away: ({ why }) => link.setAway(why),
  control: ({ request }) => link.control(request),
  stop: ({ press }) => {
    link.stop();
    self.postMessage({ op: "pressed", press });
  },
  release: () => link.release(),
  poke: () => link.poke(),
  drop: () => link.headset.drop(),
  close: () => link.close(),
};

self.onmessage = ({ data }) => ops[data.op](data);
