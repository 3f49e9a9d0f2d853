// What the pages share: elements made of text alone, numbers as people read them, choices, colours.

/** An element with attributes, listeners ("onclick") and children; text stays text. */
export function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value !== null && value !== undefined && value !== false) made.setAttribute(name, value === true ? "" : value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

export const at = (id) => document.getElementById(id);

/** A number with its decimals, "–" for none; signed where it is a change. */
export function number(value, digits = 0, { signed = false } = {}) {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  const rounded = Number(value.toFixed(digits)) || 0;
  const text = Math.abs(rounded).toLocaleString("en-GB", { minimumFractionDigits: digits, maximumFractionDigits: digits });
  return (rounded < 0 ? "−" : signed && rounded > 0 ? "+" : "") + text;
}

export function day(iso) {
  return new Date(iso).toLocaleDateString("en-GB", { day: "numeric", month: "long", year: "numeric", timeZone: "UTC" });
}

export const plural = (n, word) => `${number(n)} ${word}${n === 1 ? "" : "s"}`;

/** Terms and what they say, as children of a <dl>. */
export function facts(list, pairs) {
  for (const [term, value, unit, note] of pairs) {
    const number = element("dd", {}, value, unit ? element("span", { class: "unit" }, ` ${unit}`) : null);
    if (note) number.append(element("span", { class: "note" }, note));
    list.append(element("div", {}, element("dt", {}, term), number));
  }
}

/** Something that one is told of when it changes. */
export function choice(value = null) {
  const told = [];
  return {
    get: () => value,
    set(next) {
      if (next === value) return;
      value = next;
      for (const tell of told) tell(next);
    },
    subscribe: (tell) => told.push(tell),
  };
}

const dark = matchMedia("(prefers-color-scheme: dark)");
const printed = matchMedia("print");

/** Call on every change of the colour scheme, also for printing, which is always light. */
export function onScheme(act) {
  dark.addEventListener("change", act);
  printed.addEventListener("change", act);
}

export const isDark = () => dark.matches && !printed.matches;
export const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
