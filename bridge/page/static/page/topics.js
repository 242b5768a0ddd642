/**
 * The topics that come, each received once however many panels show it, with how much of it comes.
 *
 * One interface node serves a topic of all robots; a robot is left when its last taker goes.
 */

const BUCKET_MS = 250;
const BUCKETS = 8;
/** Who has just begun is not taken for quick. */
const LEAST_MS = 1000;

/** How much comes, over the last two seconds, in a fixed amount of memory. */
export class Rate {
  #counts = new Float64Array(BUCKETS);
  #sizes = new Float64Array(BUCKETS);
  #bucket = -1;

  constructor() {
    this.lastAt = null;
    this.count = 0;
    this.since = null;
  }

  note(bytes, now) {
    this.#turn(now);
    this.#counts[this.#bucket % BUCKETS] += 1;
    this.#sizes[this.#bucket % BUCKETS] += bytes;
    this.count += 1;
    this.lastAt = now;
    this.since ??= now;
  }

  /** {hz, bytesPerS, ageMs} now. */
  now(now) {
    if (this.lastAt === null) return { hz: 0, bytesPerS: 0, ageMs: null };
    this.#turn(now);
    const overS = Math.max(LEAST_MS, Math.min(BUCKETS * BUCKET_MS, now - this.since)) / 1000;
    const sum = (list) => list.reduce((all, each) => all + each, 0);
    return { hz: sum(this.#counts) / overS, bytesPerS: sum(this.#sizes) / overS, ageMs: now - this.lastAt };
  }

  #turn(now) {
    const bucket = Math.floor(now / BUCKET_MS);
    if (this.#bucket < 0 || bucket - this.#bucket >= BUCKETS) {
      this.#counts.fill(0);
      this.#sizes.fill(0);
    } else {
      for (let each = this.#bucket + 1; each <= bucket; each++) {
        this.#counts[each % BUCKETS] = 0;
        this.#sizes[each % BUCKETS] = 0;
      }
    }
    this.#bucket = Math.max(this.#bucket, bucket);
  }
}

export class Topics {
  #topics = new Map();

  constructor(headset) {
    this.headset = headset;
  }

  /** Receive a topic of a robot: `taker(message)` is called for each message. What is returned ends that. */
  watch(robot, topic, type, taker, { bufferSize = 10 } = {}) {
    let each = this.#topics.get(topic);
    if (each === undefined) {
      each = { takers: new Map(), rates: new Map(), node: null };
      each.node = this.headset.subscribe(topic, type, { bufferSize }, (message) => this.#take(each, message));
      this.#topics.set(topic, each);
    }
    const takers = each.takers.get(robot) ?? new Set();
    each.takers.set(robot, takers.add(taker));
    each.node.register({ robots: [robot] });
    return () => this.#leave(topic, each, robot, taker);
  }

  /** How much of it comes of a robot; null where nobody receives it. */
  rate(robot, topic, now) {
    const each = this.#topics.get(topic);
    if (!each?.takers.has(robot)) return null;
    return each.rates.get(robot)?.now(now) ?? { hz: 0, bytesPerS: 0, ageMs: null };
  }

  /** Why a robot does not send a topic that is received; empty where there is no reason. */
  refusal(robot, topic) {
    return this.#topics.get(topic)?.node.refusals.get(robot)?.reason ?? "";
  }

  #take(each, message) {
    const robot = message.senderId;
    const takers = each.takers.get(robot);
    if (takers === undefined) return;
    let rate = each.rates.get(robot);
    if (rate === undefined) each.rates.set(robot, (rate = new Rate()));
    rate.note(message.data.length, performance.now());
    for (const taker of takers) taker(message);
  }

  #leave(topic, each, robot, taker) {
    const takers = each.takers.get(robot);
    if (!takers?.delete(taker) || takers.size) return;
    each.takers.delete(robot);
    each.rates.delete(robot);
    if (each.takers.size) {
      each.node.deregister({ robots: [robot] });
    } else {
      this.#topics.delete(topic);
      each.node.close();
    }
  }
}
