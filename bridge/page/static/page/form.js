/** A form made from the type of a message. */

import { h } from "./dom.js";

const DEPTH = 4;

/** {element, value()}: `value` throws Error with the field's name where what was written does not fit. */
export function form(type) {
  return fields(type, type.fields, "", 0);
}

function fields(type, list, path, depth) {
  const parts = list.map((each) => [each.name, field(type, each, path ? `${path}.${each.name}` : each.name, depth)]);
  const element = h("div", { class: "fields" }, ...parts.map(([, part]) => part.element));
  if (!parts.length) element.append(h("p", { class: "muted" }, "It has no fields."));
  return { element, value: () => Object.fromEntries(parts.map(([name, part]) => [name, part.value()])) };
}

function field(type, each, path, depth) {
  const id = `field-${path.replace(/\W+/g, "-")}-${Math.random().toString(36).slice(2, 8)}`;
  if (each.isArray) return asJson(each, path, id, "[]");
  if (each.isComplex && depth >= DEPTH) return asJson(each, path, id, "{}");
  if (each.isComplex) {
    const inner = fields(type, type.fieldsOf(each.type), path, depth + 1);
    return { element: h("fieldset", {}, h("legend", {}, each.name), inner.element), value: inner.value };
  }
  if (each.type === "time" || each.type === "duration") {
    return asJson(each, path, id, '{"sec": 0, "nanosec": 0}');
  }
  if (each.type === "bool") {
    const input = h("input", { type: "checkbox", id, name: path });
    input.checked = each.defaultValue === true;
    return { element: h("div", { class: "field check" }, input, label(each, id)), value: () => input.checked };
  }
  if (each.type === "string" || each.type === "wstring") {
    const input = h("input", { type: "text", id, name: path, value: each.defaultValue ?? "", autocomplete: "off" });
    return { element: h("div", { class: "field" }, label(each, id), input), value: () => input.value };
  }
  return number(each, path, id);
}

function number(each, path, id) {
  const whole = !each.type.startsWith("float");
  const input = h("input", {
    type: "number",
    id,
    name: path,
    step: whole ? 1 : "any",
    value: String(each.defaultValue ?? 0),
  });
  const value = () => {
    if (input.value.trim() === "" || input.validity.badInput) throw new Error(`${path} is no number`);
    if (/int64$/.test(each.type)) return BigInt(input.value);
    const read = Number(input.value);
    if (whole && !Number.isInteger(read)) throw new Error(`${path} is no whole number`);
    return read;
  };
  return { element: h("div", { class: "field" }, label(each, id), input), value };
}

function asJson(each, path, id, usual) {
  const input = h("textarea", { id, name: path, rows: 2, spellcheck: "false" });
  input.value = usual;
  const value = () => {
    try {
      return JSON.parse(input.value);
    } catch {
      throw new Error(`${path} is no JSON`);
    }
  };
  return { element: h("div", { class: "field" }, label(each, id), input), value };
}

function label(each, id) {
  const type = `${each.type}${each.isArray ? "[]" : ""}`;
  return h("label", { for: id }, each.name, h("small", {}, ` ${type}`));
}
