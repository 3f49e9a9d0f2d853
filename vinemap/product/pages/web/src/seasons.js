// The rows of a parcel over the dates on which it was flown: numbers, growth between two of them, plots.
import { day, element, number } from "./page.js";

const CANOPY = { doubt: true };
export const MEASURES = {
  height: { title: "Height", unit: "m", digits: 2, least: 0.1, told: 0.03, ...CANOPY, of: (at) => at("height_m") },
  width: { title: "Width", unit: "m", digits: 2, least: 0.1, told: 0.04, ...CANOPY, of: (at) => at("width_m") },
  density: { title: "Volume per metre", unit: "m³/m", digits: 2, least: 0.05, told: 0.05, ...CANOPY, whole: true, of: (at) => ratio(at("volume_m3"), at("seen_m")) },
  gaps: { title: "Gaps, share of the row", unit: "%", digits: 1, least: 2, told: 1, turned: true, whole: true, of: (at) => ratio(100 * at("gap_m"), at("seen_m")) },
};

const ratio = (one, other) => (Number.isFinite(one) && other > 0 ? one / other : null);
const among = (seasons, row, date) => (name) => {
  const told = seasons[name][row]?.[date];
  return told === null || told === undefined ? NaN : told * seasons.units[name];
};

/** A row's number at a date, null where there is none. */
export function valueOf(seasons, measure, row, date) {
  const value = measure.of(among(seasons, row, date));
  return Number.isFinite(value) ? value : null;
}

/** Whether the canopy's numbers of a row at a date aren't to be trusted. */
export const isDoubtful = (seasons, measure, row, date) => Boolean(measure.doubt && seasons.doubtful[row]?.[date]);

const trusted = (seasons, measure, row, date) => (isDoubtful(seasons, measure, row, date) ? null : valueOf(seasons, measure, row, date));

/** Change of a row from one date to another; null where it isn't known at both, as of sums where a part wasn't seen. */
export function growthOf(seasons, measure, row, from, to) {
  const isWhole = (at) => !measure.whole || at("seen_m") >= at("length_m");
  const [before, after] = [from, to].map((date) => (isWhole(among(seasons, row, date)) ? trusted(seasons, measure, row, date) : null));
  return before === null || after === null ? null : after - before;
}

/** Means by date of the rows that stand then, by their length. */
export function meansOf(seasons, measure) {
  return seasons.dates.map((_, date) => {
    let [sum, length] = [0, 0];
    seasons.labels.forEach((_, row) => {
      const value = trusted(seasons, measure, row, date);
      const own = among(seasons, row, date)("length_m");
      if (value !== null && own > 0) [sum, length] = [sum + value * own, length + own];
    });
    return length ? sum / length : null;
  });
}

/** Lowest and highest of all values, for plots beside each other; gaps from none on. */
export function reachOf(all, measure) {
  let [low, high] = [Infinity, -Infinity];
  for (const seasons of all) {
    seasons.labels.forEach((dates, row) => dates.forEach((_, date) => {
      const value = trusted(seasons, measure, row, date);
      if (value !== null) [low, high] = [Math.min(low, value), Math.max(high, value)];
    }));
  }
  if (low > high) return [0, 1];
  const most = Math.max(high, low + 2 * measure.least);
  return [measure.turned ? 0 : Math.max(0, low - 0.1 * (most - low)), most];
}

export const dayShort = (iso, years) => new Date(iso).toLocaleDateString("en-GB", years ? { month: "short", year: "numeric", timeZone: "UTC" } : { day: "numeric", month: "short", timeZone: "UTC" });
const time = ({ flown }) => Date.parse(flown);

function drawn(tag, attributes, ...children) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

const [W, H, LEFT, RIGHT, TOP, FOOT] = [240, 124, 34, 34, 8, 20];

/**
 * A plot of all rows (thin), their mean, and a row that is chosen, over the dates. `span` are the first and the last
 * time, `reach` the lowest and the highest value, which plots beside each other share.
 */
export function plotOf(seasons, measure, { span, reach: [low, high], title, chosen = null }) {
  const [first, last] = span;
  const x = (date) => LEFT + ((time(seasons.dates[date]) - first) / Math.max(last - first, 1)) * (W - LEFT - RIGHT);
  const y = (value) => H - FOOT - ((value - low) / (high - low)) * (H - TOP - FOOT);
  const path = (values) => {
    let on = false;
    return values.map((value, date) => {
      const step = value === null ? "" : `${on ? "L" : "M"}${x(date).toFixed(1)} ${y(value).toFixed(1)}`;
      on = value !== null;
      return step;
    }).join("");
  };
  const dots = (values, name) => values.flatMap((value, date) => (value === null ? [] : [drawn("circle", { cx: x(date).toFixed(1), cy: y(value).toFixed(1), r: 2.4, class: name })]));
  const means = meansOf(seasons, measure);
  const rows = seasons.labels.map((dates, row) => dates.map((_, date) => trusted(seasons, measure, row, date)));
  const shown = chosen === null ? means : rows[chosen];
  const ends = shown.map((value, date) => (value === null ? -1 : date)).filter((date) => date >= 0);
  const years = last - first > 400 * 864e5;
  const at = (date, anchor) => drawn("text", { x: x(date).toFixed(1), y: H - 4, "text-anchor": anchor }, dayShort(seasons.dates[date].flown, years));
  const marks = [...new Set([0, seasons.dates.length - 1])].map((date, k) => at(date, k ? "end" : "start"));
  const value = (date) => drawn("text", { x: (x(date) + 5).toFixed(1), y: (y(shown[date]) + 4).toFixed(1), class: chosen === null ? "last" : "last chosen" }, number(shown[date], measure.digits));
  const words = seasons.dates.map(({ flown }, date) => `${day(flown)} ${number(shown[date], measure.digits)}`).join(", ");
  return drawn("svg", { viewBox: `0 0 ${W} ${H}`, class: "season", role: "img", "aria-label": `${title}, ${measure.title.toLowerCase()} (${measure.unit}): ${words}` },
    ...[low, high].flatMap((value) => [
      drawn("line", { x1: LEFT - 4, x2: W - RIGHT, y1: y(value), y2: y(value), class: "edge" }),
      drawn("text", { x: LEFT - 8, y: y(value) + 4, "text-anchor": "end" }, number(value, measure.digits)),
    ]),
    drawn("path", { d: rows.map(path).join(""), class: "rows" }),
    drawn("path", { d: path(means), class: "mean" }),
    ...dots(means, "mean"),
    ...(chosen === null ? [] : [drawn("path", { d: path(shown), class: "chosen" }), ...dots(shown, "chosen")]),
    ...(ends.length ? [value(ends.at(-1))] : []),
    ...marks);
}

/** First and last time of all dates. */
export function spanOf(all) {
  const times = all.flatMap(({ dates }) => dates.map(time));
  return [Math.min(...times), Math.max(...times)];
}

/** A number of a table, marked where it isn't to be trusted. */
export function cell(seasons, measure, row, date) {
  const value = valueOf(seasons, measure, row, date);
  const text = number(value, measure.digits);
  return value !== null && isDoubtful(seasons, measure, row, date) ? element("span", { class: "doubt", title: "Seen too sparsely or unevenly to be trusted" }, `${text} ?`) : text;
}

export const DOUBTS = "Numbers with a question mark were seen too sparsely to be trusted (canopy confidence below 0.5); plots, means and changes leave them out.";
