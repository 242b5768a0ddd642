/** Small things for making and changing elements. */

/** An element: `h("button", {class: "x", onclick}, "text", child)`. */
export function h(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  set(element, attributes);
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

/** The same for SVG. */
export function svg(tag, attributes = {}, ...children) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  set(element, attributes);
  element.append(...children);
  return element;
}

function set(element, attributes) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else element.setAttribute(name, value === true ? "" : value);
  }
}

/** Change a text only where it is another one: screen readers say what changes. */
export function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Show or hide, keeping what is inside. */
export function show(element, shown) {
  if (element.hidden === shown) element.hidden = !shown;
}

/** A time that has passed, in few characters. */
export function age(ms) {
  if (ms === null || ms === undefined) return "–";
  if (ms < 1000) return `${Math.max(0, Math.round(ms))} ms`;
  if (ms < 60000) return `${(ms / 1000).toFixed(1)} s`;
  return ms < 3600000 ? `${Math.round(ms / 60000)} min` : `${Math.round(ms / 3600000)} h`;
}

/** A number with as many digits as it is worth. */
export function digits(value) {
  const size = Math.abs(value);
  return size >= 100 || size === 0 ? value.toFixed(0) : size >= 10 ? value.toFixed(1) : value.toFixed(2);
}

/** A panel with a heading, and room for what belongs to its heading. */
export function panel(title, { id, tools = [], wide = false } = {}, ...children) {
  const heading = h("h2", { id: `${id}-title` }, title);
  const head = h("header", {}, heading, h("div", { class: "tools" }, ...tools));
  const attributes = { class: `panel${wide ? " wide" : ""}`, id, "aria-labelledby": `${id}-title` };
  return h("section", attributes, head, ...children);
}

/** Keep a list of elements in step with keys: new ones are made, others go, and all are in this order. */
export class Keyed {
  #elements = new Map();

  constructor(parent, make) {
    this.parent = parent;
    this.make = make;
  }

  set(keys) {
    const wanted = new Set(keys);
    for (const [key, element] of this.#elements) {
      if (!wanted.has(key)) {
        element.remove();
        this.#elements.delete(key);
      }
    }
    let at = this.parent.firstChild;
    for (const key of keys) {
      let element = this.#elements.get(key);
      if (element === undefined) {
        element = this.make(key);
        this.#elements.set(key, element);
      }
      if (element === at) at = at.nextSibling;
      else this.parent.insertBefore(element, at);
    }
  }

  get(key) {
    return this.#elements.get(key);
  }

  get size() {
    return this.#elements.size;
  }
}
