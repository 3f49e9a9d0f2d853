// The page of a survey.
import { data, unpackJSON } from "./data.js";
import { at, choice, day, element, facts, number, plural } from "./page.js";
import { showParcels } from "./parcels.js";
import { showSeasons } from "./multiples.js";
import { DOUBTS, MEASURES, cell, growthOf, isDoubtful, valueOf } from "./seasons.js";
import { table } from "./table.js";

const { parcels, survey, flown, vinemap } = data;
const mapped = parcels.filter((parcel) => parcel.outline);
const selected = choice();
const percent = (share) => (share === null ? null : 100 * share);
const sum = (name) => mapped.reduce((total, parcel) => total + (parcel[name] ?? 0), 0);
const href = (parcel, kind) => [parcel.folder, parcel.files[kind]].map(encodeURIComponent).join("/");
const changed = (digits, options) => (value) => change(value, digits, options);
const FELL = { good: -1, least: 0.5 }; // better where it is less

head();
start();

async function start() {
  const lines = parcelTable();
  const details = await unpackJSON("details");
  for (const parcel of mapped) place(parcel, details[parcel.parcel]);
  const pair = choosePair();
  const map = mapped.length ? showParcels(mapped, pair, data.bounds, selected) : null;
  showSeasons(mapped, selected);
  if (!map) at("map").parentElement.hidden = true;
  at("parcel").append(...mapped.map((parcel, k) => element("option", { value: k }, parcel.parcel)));
  at("parcel").addEventListener("change", () => selected.set(mapped[Number(at("parcel").value)]));
  selected.subscribe((parcel) => {
    lines.forEach((line, k) => {
      if (parcels[k] === parcel) line.setAttribute("aria-current", "true");
      else line.removeAttribute("aria-current");
    });
    at("parcel").value = String(mapped.indexOf(parcel));
    map.select(parcel);
    showChanges(parcel, pair.of(parcel));
  });
  pair.subscribe(() => { map.paint(); showChanges(selected.get(), pair.of(selected.get())); });
  if (mapped.length) selected.set(mapped.find((parcel) => parcel.summary) ?? mapped[0]);
  else at("changes").hidden = true;
  requestAnimationFrame(() => setTimeout(() => performance.mark("drawn")));
}

/** Give a parcel what was told of its rows, in the coordinates of the whole map. */
function place(parcel, { zero, lines, changes, history }) {
  const by = [0, 1].map((k) => zero[k] - data.zero[k]);
  const moved = (line) => line.map(([x, y]) => [x + by[0], y + by[1]]);
  parcel.lines = lines.map(moved);
  parcel.changes = changes && { ...changes, gone: changes.gone.map(moved) };
  parcel.seasons = history;
}

/** The two flights between which changes are shown: the one before and this one, if nobody says otherwise. */
function choosePair() {
  const flights = new Map();
  for (const { seasons } of mapped) for (const one of seasons?.dates ?? []) flights.set(one.survey, one.flown);
  const known = [...flights].sort(([, one], [, other]) => Date.parse(one) - Date.parse(other));
  const name = ([of, flown]) => element("option", { value: of }, `${of}, ${day(flown)}`);
  at("from").append(element("option", { value: "" }, "the flight before"), ...known.slice(0, -1).map(name));
  at("to").append(element("option", { value: "" }, "this flight"), ...known.slice(0, -1).map(name));
  document.querySelectorAll(".between").forEach((label) => { label.hidden = known.length < 2; });
  const find = ({ dates }, id, otherwise) => (at(id).value === "" ? otherwise : dates.findIndex(({ survey: of }) => of === at(id).value));
  return {
    /** Positions of the two among a parcel's dates, null where it wasn't flown. */
    of({ seasons }) {
      if (!seasons) return null;
      const to = find(seasons, "to", seasons.dates.length - 1);
      const from = find(seasons, "from", to - 1);
      return from < 0 || to < 0 ? null : { from, to, usual: from === seasons.dates.length - 2 && to === from + 1 };
    },
    subscribe: (tell) => ["from", "to"].forEach((id) => at(id).addEventListener("change", tell)),
  };
}

function head() {
  const days = [...new Set(flown.map(day))];
  at("over").textContent = ["Survey", days.length && `flown ${days.join(" to ")}`].filter(Boolean).join(" · ");
  at("title").textContent = survey;
  const [length, seen] = ["length_m", "seen_m"].map(sum);
  const ha = sum("area_m2") / 1e4;
  facts(at("figures"), [
    ["Parcels", number(mapped.length), mapped.length < parcels.length ? `of ${number(parcels.length)}` : ""],
    ["Rows", number(sum("rows"))],
    ["Total length", number(length / 1000, 2), "km"],
    ["Area", number(ha, 2), "ha"],
    ["Canopy volume", number(sum("volume_m3")), "m³", ha ? `${number(sum("volume_m3") / ha)} m³/ha` : ""],
    ["Missing vines", number(sum("n_missing"))],
    ["Gaps", number(sum("gap_m")), "m", seen ? `${number((100 * sum("gap_m")) / seen, 1)}% of the length` : ""],
  ]);
  const failed = parcels.filter((parcel) => parcel.state === "failed");
  const warned = parcels.filter((parcel) => parcel.warnings?.length);
  const said = [
    ...failed.slice(0, 12).map((parcel) => `${parcel.parcel} failed: ${parcel.reason}`),
    failed.length > 12 ? `${failed.length - 12} more parcels failed, see the table` : "",
    ...warned.slice(0, 12).map((parcel) => `${parcel.parcel}: ${parcel.warnings.join("; ")}`),
    warned.length > 12 ? `${warned.length - 12} more parcels have warnings, see the table` : "",
  ].filter(Boolean);
  if (said.length) {
    at("notices").append(element("div", { class: "warning", role: "note" },
      element("strong", {}, said.length > 1 ? "Warnings" : "Warning"), element("ul", {}, ...said.map((one) => element("li", {}, one)))));
  }
  at("footer").textContent = `Made by vinemap ${vinemap}. This file asks no network for anything; its links lead to the parcels’ folders beside it.`;
}

/** A change; in colour where it is one for the better or worse, and more than what can be measured. */
function change(value, digits, { least = 0, good = 1 } = {}) {
  const turn = Math.abs(value ?? 0) > least ? Math.sign(value) * good : 0;
  return element("span", { class: turn > 0 ? "up" : turn < 0 ? "down" : null }, number(value, digits, { signed: true }));
}

function parcelTable() {
  const since = (name) => parcels.map((parcel) => parcel.summary?.[name] ?? null);
  const compared = parcels.some((parcel) => parcel.summary);
  const column = (title, unit, name, digits, help) => ({ title, unit, help, values: parcels.map((parcel) => parcel[name] ?? null), show: (value) => number(value, digits) });
  const columns = [
    { title: "Parcel", text: true, values: parcels.map((parcel) => parcel.parcel), show: (_, k) => parcels[k].parcel },
    { title: "State", text: true, values: parcels.map((parcel) => parcel.state), show: (state, k) => (state === "done" ? "done" : `${state}${parcels[k].reason ? `: ${parcels[k].reason}` : ""}`) },
    { title: "Open", text: true, values: parcels.map((parcel) => (parcel.files?.report ? 0 : 1)), show: (_, k) => links(parcels[k]) },
    column("Rows", "", "rows", 0),
    column("Length", "m", "length_m", 0),
    { title: "Area", unit: "ha", values: parcels.map((parcel) => (parcel.area_m2 === undefined ? null : parcel.area_m2 / 1e4)), show: (value) => number(value, 2) },
    column("Height", "m", "height_m", 2, "Mean, by length of the rows"),
    column("Volume", "m³", "volume_m3", 0),
    column("Missing", "vines", "n_missing", 0),
    column("Gaps", "m", "gap_m", 1),
    ...(compared ? [
      { title: "Δ height", unit: "m", help: "Since the survey before, of the rows that stand on both dates", values: since("d_height_m"), show: changed(2, { least: 0.02 }) },
      { title: "Δ width", unit: "m", help: "Since the survey before, of the rows that stand on both dates", values: since("d_width_m"), show: changed(2, { least: 0.03 }) },
      { title: "Δ volume", unit: "%", help: "Since the survey before, of the rows that stand on both dates", values: since("d_volume").map(percent), show: changed(1, { least: 5 }) },
      { title: "Δ gaps", unit: "m", help: "Since the survey before, of the rows that stand on both dates", values: since("d_gap_m"), show: changed(1, FELL) },
      { title: "Δ missing", unit: "vines", help: "Since the survey before, of the rows that stand on both dates", values: since("d_n_missing"), show: changed(0, FELL) },
      { title: "New", unit: "rows", values: since("new"), show: (value) => number(value) },
      { title: "Gone", unit: "rows", values: since("gone"), show: (value) => number(value) },
    ] : []),
    { title: "Warnings", text: true, values: parcels.map((parcel) => parcel.warnings?.length || null), show: (_, k) => (parcels[k].warnings ?? []).join("; ") },
  ];
  const made = table(columns, { caption: "Parcels in numbers", onselect: (k) => parcels[k].outline && selected.set(parcels[k]), sorted: 0 });
  made.element.classList.add("tall");
  at("table").append(made.element, element("p", { class: "hint" }, "A click on a heading sorts, on a parcel shows it on the map and its changes below."));
  return made.lines;
}

function links(parcel) {
  const words = { report: "report", layers: "GeoPackage", project: "QGIS" };
  const made = Object.entries(words).filter(([kind]) => parcel.files?.[kind]).map(([kind, word]) => element("a", { href: href(parcel, kind) }, word));
  return element("span", {}, ...made.flatMap((link, k) => (k ? [" · ", link] : [link])));
}

function showChanges(parcel, pair) {
  at("rows").replaceChildren();
  const { since, shift, summary, remark, changes: rows, seasons } = parcel;
  if (!since) {
    at("facts").textContent = `No earlier survey of ${parcel.parcel} lies beside this one.`;
    return;
  }
  const before = `${since.survey ?? "an earlier survey"}, flown ${day(since.flown)}${since.parcel === parcel.parcel ? "" : `, where it is called ${since.parcel}`}`;
  if (seasons && !pair?.usual) {
    showBetween(parcel, pair);
    return;
  }
  if (!rows) {
    at("facts").textContent = `Compared with ${before}: ${remark}.`;
    return;
  }
  const far = Math.hypot(...shift);
  const off = far < 0.05 ? "The two flights lie on each other within 5 cm." :
    `The later flight lies ${number(far, 2)} m off the earlier one (${number(Math.abs(shift[0]), 2)} m ${shift[0] < 0 ? "west" : "east"}, ${number(Math.abs(shift[1]), 2)} m ${shift[1] < 0 ? "south" : "north"}), which was allowed for.`;
  at("facts").textContent = `Since ${before}: ${plural(summary.same, "row")} ${summary.same === 1 ? "stands" : "stand"} as before, ${number(summary.new)} new, ${number(summary.gone)} gone. ${off}`;
  const what = (k) => ({ same: "", new: rows.part_of[k] ? `split from ${rows.part_of[k]}` : "new", gone: rows.part_of[k] ? `joined to ${rows.part_of[k]}` : "gone" }[rows.state[k]]);
  const column = (title, unit, name, digits) => ({ title, unit, values: rows[name], show: (value) => number(value, digits) });
  const shown = (digits, options, measure) => (value, k) => (measure && doubtful(k, measure) ? doubt(value, digits) : change(value, digits, options));
  const doubtful = (k, measure) => k < parcel.lines.length && seasons && [1, 2].some((back) => isDoubtful(seasons, measure, k, seasons.dates.length - back));
  const doubt = (value, digits) => element("span", { class: "doubt" }, `${number(value, digits, { signed: true })} ?`);
  const delta = (title, unit, name, digits, options, measure) => ({ title, unit, values: rows[name], show: shown(digits, options, measure) });
  const made = table([
    { title: "Row", text: true, values: rows.label.map((label, k) => label ?? `was ${rows.earlier[k]}`), show: (label, k) => rowLink(parcel, rows, k, label) },
    { title: "Was", text: true, values: rows.earlier, show: (label) => label ?? "" },
    { title: "Change", text: true, values: rows.state.map((_, k) => what(k) || null), show: (word) => word ?? "" },
    column("Length", "m", "length_m", 1), delta("Δ", "m", "d_length_m", 1, { least: Infinity }),
    column("Height", "m", "height_m", 2), delta("Δ", "m", "d_height_m", 2, { least: 0.03 }, MEASURES.height),
    column("Width", "m", "width_m", 2), delta("Δ", "m", "d_width_m", 2, { least: 0.04 }, MEASURES.width),
    column("Volume", "m³", "volume_m3", 1), { title: "Δ", unit: "%", values: rows.d_volume.map(percent), show: shown(1, { least: 10 }, MEASURES.density) },
    column("Gaps", "m", "gap_m", 1), delta("Δ", "m", "d_gap_m", 1, FELL),
    column("Missing", "vines", "n_missing", 0), delta("Δ", "", "d_n_missing", 0, FELL),
  ], { caption: `Changes of the rows of ${parcel.parcel}` });
  made.lines.forEach((line, k) => line.classList.add(rows.state[k]));
  at("rows").append(made.element, element("p", { class: "hint" }, "Rows are matched by where they stand, not by number. Of rows that are gone the earlier numbers stand here. Differences below 3 cm in height, 4 cm in width and 10% in a row’s volume are within what can be measured, and are not coloured. Those with a question mark rest on a canopy that was seen too sparsely to be trusted (canopy confidence below 0.5)."));
}

/** Changes of the rows between any two of a parcel's flights. */
function showBetween({ parcel, seasons }, pair) {
  if (!pair || pair.from === pair.to) {
    at("facts").textContent = pair ? "Choose two flights, not one." : `${parcel} wasn’t flown on both of these dates.`;
    return;
  }
  const { from, to } = pair;
  const here = seasons.labels.map((dates) => [from, to].map((date) => dates[date] !== null));
  const kept = here.map((_, row) => row).filter((row) => here[row][0] || here[row][1]);
  const count = (test) => kept.filter((row) => test(...here[row])).length;
  const named = (date) => `${seasons.dates[date].survey ?? "the survey"}, flown ${day(seasons.dates[date].flown)}`;
  at("facts").textContent = `From ${named(from)}, to ${named(to)}: ${plural(count((then, now) => then && now), "row")} on both, ${number(count((then, now) => now && !then))} new, ${number(count((then, now) => then && !now))} gone. Shifts between the flights were allowed for.`;
  const columns = Object.values(MEASURES).flatMap((measure) => [
    { title: measure.title, unit: measure.unit, values: kept.map((row) => valueOf(seasons, measure, row, to)), show: (_, k) => cell(seasons, measure, kept[k], to) },
    { title: "Δ", unit: measure.unit, values: kept.map((row) => growthOf(seasons, measure, row, from, to)), show: changed(measure.digits, { least: measure.told, good: measure.turned ? -1 : 1 }) },
  ]);
  const made = table([
    { title: "Row", text: true, values: kept.map((row) => seasons.labels[row][to] ?? `was ${seasons.labels[row][from]}`), show: (label) => label },
    { title: "Was", text: true, values: kept.map((row) => seasons.labels[row][from]), show: (label) => label ?? "" },
    { title: "Change", text: true, values: kept.map((row) => (here[row][0] ? (here[row][1] ? null : "gone") : "new")), show: (word) => word ?? "" },
    ...columns,
  ], { caption: `Changes of the rows of ${parcel}` });
  at("rows").append(made.element, element("p", { class: "hint" }, `Rows are matched by where they stand, not by number. ${DOUBTS}`));
}

function rowLink(parcel, rows, k, label) {
  const number = parseInt(rows.label[k], 10);
  return rows.label[k] && parcel.files.report && number ? element("a", { href: `${href(parcel, "report")}#row-${number}` }, label) : label;
}
