/** What somebody chose on this device, kept by the browser. Bounded: what makes no sense is as it was at first. */

const KEPT = "macs.xr";
const MOST_CHARACTERS = 8192;
export const TOPIC = /^\/?[A-Za-z_~][\w/]{0,126}$/;

const range = (least, most) => (value) => (Number.isFinite(value) && value >= least && value <= most ? value : undefined);
const flag = (value) => (typeof value === "boolean" ? value : undefined);
const topic = (value) => (value === "" || (typeof value === "string" && TOPIC.test(value)) ? value : undefined);
const text = (value) => (typeof value === "string" && value.length <= 128 ? value : undefined);
const oneOf = (...words) => (value) => (words.includes(value) ? value : undefined);
const listOf = (one, most) => (value) =>
  Array.isArray(value) && value.length <= most && value.every((each) => one(each) !== undefined) ? value : undefined;

/** name → [default, what is allowed]. */
export const SETTINGS = {
  /** Where commands go; empty: the first topic of a type that drives. */
  driveTopic: ["", topic],
  forward: [0.5, range(0.05, 5)],
  turn: [1, range(0.05, 6)],
  hz: [30, range(5, 90)],
  /** The hand that drives by pinching. */
  hand: ["right", oneOf("left", "right")],
  /** Pictures older than that turn driving off; 0: never. */
  lockoutS: [0.3, range(0, 10)],
  /** Which pictures are shown; null: the first two. */
  cameras: [null, (value) => (value === null ? value : listOf(topic, 6)(value))],
  stereo: ["auto", oneOf("auto", "off", "side-by-side")],
  /** A second topic for the right eye of the first panel. */
  rightEye: ["", topic],
  curve: [0.35, range(0, 1)],
  /** How large the world's model is: 1 is life-size. */
  scale: [0.1, range(0.01, 1)],
  points: [20000, range(0, 100000)],
  /** What is shown of a robot besides its pictures. */
  layers: [["trail", "scan", "cloud", "map", "frames", "joints"], listOf(text, 12)],
  /** Values shown as text: topics. */
  values: [[], listOf(topic, 6)],
  /** Topics of what hands and head do; empty: not sent. */
  head: ["", topic],
  left: ["", topic],
  right: ["", topic],
  leftHand: ["", topic],
  rightHand: ["", topic],
  joy: ["", topic],
  frame: ["xr", text],
  poseHz: [72, range(1, 90)],
};

export class Settings extends EventTarget {
  constructor(store = globalThis.localStorage) {
    super();
    this.store = store;
    this.values = Object.fromEntries(Object.entries(SETTINGS).map(([name, [first]]) => [name, first]));
    Object.assign(this.values, sensible(this.#read()));
  }

  get(name) {
    return this.values[name];
  }

  /** Whether it was taken. */
  set(name, value) {
    const [, allowed] = SETTINGS[name];
    const taken = allowed(value);
    if (taken === undefined) return false;
    this.values[name] = taken;
    try {
      this.store.setItem(KEPT, JSON.stringify(this.values));
    } catch {
      // a browser that keeps nothing
    }
    this.dispatchEvent(new CustomEvent("change", { detail: { name, value: taken } }));
    return true;
  }

  #read() {
    try {
      const kept = this.store.getItem(KEPT);
      return kept && kept.length <= MOST_CHARACTERS ? JSON.parse(kept) : {};
    } catch {
      return {};
    }
  }
}

/** Of an object those settings that are allowed. */
export function sensible(kept) {
  if (kept === null || typeof kept !== "object") return {};
  const known = Object.entries(SETTINGS).map(([name, [, allowed]]) => [name, allowed(kept[name])]);
  return Object.fromEntries(known.filter(([name, value]) => name in kept && value !== undefined));
}
