// A table that a click on a heading sorts, by numbers where there are numbers.
import { element } from "./page.js";

const word = new Intl.Collator("en", { numeric: true });

/** Values in order, those that are none last, whichever way. */
function order(values, down) {
  const none = (value) => value === null || value === undefined || value === "";
  const compare = (a, b) => (typeof a === "number" && typeof b === "number" ? a - b : word.compare(a, b));
  return values.map((_, k) => k).sort((i, j) => {
    if (none(values[i]) || none(values[j])) return none(values[i]) - none(values[j]) || i - j;
    return (down ? -1 : 1) * compare(values[i], values[j]) || i - j;
  });
}

/**
 * Columns are {title, unit, help, values, show(value, k), text}: values sort, show makes the cell, text is true
 * for words. The first column names the lines and stays in sight. Gives the element and the lines (<tr>) by position.
 */
export function table(columns, { caption, onselect = null, sorted = null } = {}) {
  const n = columns[0].values.length;
  const lines = Array.from({ length: n }, (_, k) => {
    const cells = columns.map((column, c) => {
      const shown = column.show(column.values[k], k);
      const kind = column.text ? (shown.length > 30 ? "word long" : "word") : null;
      if (c > 0) return element("td", { class: kind }, shown);
      const inner = onselect ? element("button", { type: "button", onclick: () => onselect(k) }, shown) : shown;
      return element("th", { scope: "row" }, inner);
    });
    const line = element("tr", {}, ...cells);
    if (onselect) line.addEventListener("click", (event) => event.target.closest("a, button") || onselect(k));
    return line;
  });
  const body = element("tbody", {}, ...lines);

  const heads = columns.map((column, c) => {
    const title = [column.title, column.unit ? element("span", { class: "unit" }, ` ${column.unit}`) : null];
    const button = element("button", { type: "button", title: column.help, onclick: () => sort(c) }, ...title.filter(Boolean));
    return element("th", { scope: "col", class: column.text ? "word" : null, "aria-sort": "none" }, button);
  });
  function sort(c, down = heads[c].getAttribute("aria-sort") === "ascending") {
    heads.forEach((head) => head.setAttribute("aria-sort", "none"));
    heads[c].setAttribute("aria-sort", down ? "descending" : "ascending");
    body.append(...order(columns[c].values, down).map((k) => lines[k]));
  }

  const head = element("thead", {}, element("tr", {}, ...heads));
  const whole = element("table", {}, element("caption", { class: "unseen" }, caption), head, body);
  if (sorted !== null) sort(sorted, false);
  return { element: element("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": caption }, whole), lines };
}
