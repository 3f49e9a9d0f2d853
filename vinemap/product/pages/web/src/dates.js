// The rows of the page's parcel over all dates on which it was flown.
import { at, choice, day, element, number } from "./page.js";
import { DOUBTS, MEASURES, cell, dayShort, growthOf, plotOf, reachOf, spanOf, valueOf } from "./seasons.js";
import { table } from "./table.js";

/** Which line of the seasons a row is. */
export function placeIn(seasons) {
  const places = new Map(seasons.labels.map((dates, place) => [dates.at(-1), place]));
  return (row) => places.get(row.label);
}

export function showDates(rows, seasons, selected) {
  at("seasons").hidden = false;
  const [span, placed] = [spanOf([seasons]), placeIn(seasons)];
  const boxes = Object.values(MEASURES).map((measure) => {
    const plot = element("div", {});
    at("season-plots").append(element("figure", {}, element("figcaption", {}, `${measure.title}, ${measure.unit}`), plot));
    return { measure, plot, reach: reachOf([seasons], measure) };
  });
  at("measure").append(...Object.entries(MEASURES).map(([name, { title }]) => element("option", { value: name }, title)));
  const last = seasons.dates.length - 1;
  const years = Date.parse(seasons.dates[last].flown) - Date.parse(seasons.dates[0].flown) > 400 * 864e5;
  let lines = [];

  function tabulate() {
    const measure = MEASURES[at("measure").value];
    const places = seasons.labels.map((_, place) => place);
    const signed = (value) => number(value, measure.digits, { signed: true });
    const made = table([
      { title: "Row", text: true, values: places.map((place) => seasons.labels[place][last] ?? `was ${seasons.labels[place].findLast(Boolean)}`), show: (label) => label },
      ...seasons.dates.map(({ flown, survey }, date) => ({
        title: dayShort(flown, years), unit: measure.unit, help: [survey, day(flown)].filter(Boolean).join(", "),
        values: places.map((place) => valueOf(seasons, measure, place, date)), show: (_, place) => cell(seasons, measure, place, date),
      })),
      { title: "Δ last", unit: measure.unit, help: "Since the flight before", values: places.map((place) => growthOf(seasons, measure, place, last - 1, last)), show: signed },
      { title: "Δ all", unit: measure.unit, help: "Since the first flight", values: places.map((place) => growthOf(seasons, measure, place, 0, last)), show: signed },
    ], { caption: `${measure.title} of the rows by date`, onselect: (place) => rows.forEach((row) => placed(row) === place && selected.set(row)) });
    lines = made.lines;
    at("dates").replaceChildren(made.element, element("p", { class: "hint" }, `Rows are matched by where they stand, not by number; shifts between the flights were allowed for. ${DOUBTS}`));
    mark();
  }

  function mark() {
    const place = selected.get() && placed(selected.get());
    lines.forEach((line, k) => (k === place ? line.setAttribute("aria-current", "true") : line.removeAttribute("aria-current")));
    for (const { measure, plot, reach } of boxes) plot.replaceChildren(plotOf(seasons, measure, { span, reach, title: selected.get()?.label ?? "", chosen: place ?? null }));
  }

  at("measure").addEventListener("change", tabulate);
  selected.subscribe(mark);
  tabulate();
}

/** The two flights between which growth is shown on the map: the last two, if nobody says otherwise. */
export function chooseDates(seasons) {
  const pair = choice();
  ["from", "to"].forEach((id, k) => {
    at(id).append(...seasons.dates.map(({ flown }, date) => element("option", { value: date }, day(flown))));
    at(id).value = String(seasons.dates.length - 2 + k);
    at(id).addEventListener("change", () => pair.set({ from: Number(at("from").value), to: Number(at("to").value) }));
  });
  pair.set({ from: seasons.dates.length - 2, to: seasons.dates.length - 1 });
  return pair;
}
