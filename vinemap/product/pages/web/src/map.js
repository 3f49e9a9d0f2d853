// Rows over the heights of what grows there.
import { Canvas, CircleMarker, ImageOverlay, LayerGroup, Marker, Polygon, Polyline, SVG, divIcon } from "leaflet/dist/leaflet-src.esm.js";
import { data } from "./data.js";
import { at, colour, element, number, onScheme } from "./page.js";
import { piece, pointAt } from "./line.js";
import { boundsOf, keepInSight, place, plan } from "./plan.js";
import { range, shade, stops } from "./scale.js";
import { chooseDates, placeIn } from "./dates.js";
import { MEASURES, growthOf } from "./seasons.js";

const PIECE = 4; // metres of a row that have one colour
const QUANTITIES = {
  volume: { title: "Volume per metre", unit: "m³/m", digits: 2, of: (p, k) => p.area[k] / 100, row: (row) => row.volume_m },
  height: { title: "Height", unit: "m", digits: 2, of: (p, k) => p.height[k] / 100, row: (row) => row.height_m },
  width: { title: "Width", unit: "m", digits: 2, of: (p, k) => p.width[k] / 100, row: (row) => row.width_m },
  gaps: { title: "Gaps, share of the row", unit: "%", digits: 1, row: (row) => 100 * row.gap_share },
};

/** Pieces of a row between its gaps, each with the mean of what is known there. */
function pieces(row, profile, of) {
  const sums = new Map();
  profile.position.forEach((position, k) => {
    const slot = Math.floor(position / 100 / PIECE);
    const one = sums.get(slot) ?? { sum: 0, n: 0, first: position / 100, last: 0 };
    sums.set(slot, { ...one, sum: one.sum + of(profile, k), n: one.n + 1, last: position / 100 });
  });
  return [...sums].map(([slot, { sum, n, first, last }]) => {
    const start = sums.has(slot - 1) ? slot * PIECE : first;
    const stop = sums.has(slot + 1) ? (slot + 1) * PIECE : last;
    return { value: sum / n, line: piece(row.line, start, Math.max(stop, start + 0.2)) };
  });
}

/** Growth of rows between two flights, by the same names as what is measured. */
const GROWTH = Object.fromEntries(Object.entries(MEASURES).map(([name, { title, ...measure }]) => [`grown-${name}`, {
  ...measure, title: `Change of ${title.toLowerCase()}`, diverging: true, measure: MEASURES[name],
}]));

export function showMap(rows, profiles, selected, seasons = null) {
  const map = plan("map");
  for (const [name, above] of [["picture", 200], ["unmapped", 402], ["pieces", 410], ["halo", 405], ["hits", 450], ["numbers", 460]]) {
    map.createPane(name).style.zIndex = above;
  }
  map.getPane("numbers").style.pointerEvents = "none";
  const { bounds: [west, south, east, north], png, tallest } = data.picture;
  new ImageOverlay(`data:image/png;base64,${png}`, [[south, west], [north, east]], { pane: "picture", className: "heights" }).addTo(map);
  const rings = data.outlines.flat();
  const under = new SVG({ pane: "halo", padding: 0.5 });
  const outline = new Polygon(rings.map((ring) => ring.map(place)), {
    renderer: under, fill: false, weight: 1.5, dashArray: "5 4", interactive: false,
  }).addTo(map);
  const points = [...rings.flat(), ...rows.flatMap((row) => row.line.points)];
  keepInSight(map, points.length ? boundsOf(points) : [[south, west], [north, east]]);

  const beside = new SVG({ pane: "unmapped", padding: 0.5 });
  const unmapped = data.unmapped.outline.map((outline, k) => new Polygon(outline.map((ring) => ring.map(place)), {
    renderer: beside, weight: 1.5, fillOpacity: 0.25, className: "unmapped",
  }).bindTooltip(() => hintUnmapped(k), { sticky: true, className: "about", opacity: 1 }).addTo(map));
  const canvas = new Canvas({ pane: "pieces", padding: 0.5 });
  const svg = new SVG({ pane: "hits", padding: 0.5 });
  const drawn = new LayerGroup().addTo(map);
  const stretches = (name) => rows.flatMap((row) => row[name].map(({ start, end }) => new Polyline(piece(row.line, start, end).map(place), {
    renderer: canvas, interactive: false, lineCap: "butt",
  })));
  const gaps = stretches("gaps");
  const unseen = stretches("unseen");
  const halo = new Polyline([], { renderer: under, interactive: false, opacity: 0.9 }).addTo(map);
  const here = new CircleMarker([0, 0], { renderer: svg, radius: 5, weight: 2, fillOpacity: 1, interactive: false });

  for (const row of rows) {
    const hit = new Polyline(row.line.points.map(place), { renderer: svg, weight: 14, opacity: 0, className: "hit", bubblingMouseEvents: false });
    hit.bindTooltip(() => hint(row), { sticky: true, className: "about", opacity: 1 });
    hit.on("click", () => selected.set(row)).addTo(map);
    hit.getElement().dataset.row = row.row_id;
    hit.getElement().setAttribute("tabindex", "-1"); // keys choose rows in the list and the table
  }
  const numbers = rows.map((row) => new Marker(place(row.line.points[0]), {
    pane: "numbers", interactive: false, keyboard: false, alt: "",
    icon: divIcon({ className: "row-number", html: element("span", {}, String(row.row_id)), iconSize: null }),
  }).addTo(map));

  /** As many numbers as fit beside each other. */
  function thin() {
    const scale = map.getZoomScale(map.getZoom(), 0);
    const spacing = (data.totals.spacing_m || 10) * scale;
    const every = [1, 2, 5, 10, 20, 50, 100].find((k) => k * spacing > 13) ?? 200;
    numbers.forEach((mark, k) => {
      mark.getElement().hidden = !(rows[k].row_id % every === 0 || rows.length === 1 || (every > 1 && k === 0));
    });
    const weight = Math.min(8, Math.max(2.5, 0.4 * scale));
    drawn.eachLayer((layer) => layer.setStyle({ weight }));
    [...gaps, ...unseen].forEach((layer) => layer.setStyle({ weight }));
    halo.setStyle({ weight: weight + 5 });
  }

  const chosen = at("quantity");
  const quantities = { ...QUANTITIES, ...(seasons ? GROWTH : {}) };
  const [dates, placed] = seasons ? [chooseDates(seasons), placeIn(seasons)] : [];
  const grown = (row, measure) => growthOf(seasons, measure, placed(row), dates.get().from, dates.get().to);
  function paint() {
    const quantity = quantities[chosen.value];
    document.querySelectorAll(".between").forEach((label) => { label.hidden = !quantity.measure; });
    drawn.clearLayers();
    outline.setStyle({ color: colour("outline") });
    unmapped.forEach((one) => one.setStyle({ color: colour("unmapped") }));
    halo.setStyle({ color: colour("selected") });
    here.setStyle({ color: colour("paper"), fillColor: colour("selected") });
    if (!rows.length) return legend(null);
    const parts = rows.flatMap((row) => {
      const profile = profiles[row.row_id];
      if (quantity.measure) return [{ value: grown(row, quantity.measure), line: row.line.points }];
      if (quantity.of && profile) return pieces(row, profile, quantity.of);
      return quantity.of ? [] : [{ value: quantity.row(row), line: row.line.points }];
    });
    const turned = chosen.value === "gaps" || quantity.turned;
    const span = range(parts.map((part) => part.value), {
      zero: chosen.value === "gaps", least: quantity.least ?? (chosen.value === "gaps" ? 5 : 0.1), diverging: quantity.diverging,
    });
    for (const { value, line } of parts) {
      const tint = value === null ? colour("rule") : shade(turned ? span[0] + span[1] - value : value, span, quantity.diverging);
      new Polyline(line.map(place), { renderer: canvas, interactive: false, lineCap: "butt", color: tint }).addTo(drawn);
    }
    for (const [lines, name] of [[gaps, "gap"], [unseen, "soft"]]) {
      lines.forEach((line) => { line.remove(); line.setStyle({ color: colour(name) }).addTo(map); });
    }
    legend(quantity, span);
    thin();
  }

  function legend(quantity, [low, high] = []) {
    const bar = element("span", { class: "ramp", "aria-hidden": "true" });
    const [known, signed] = [stops(quantity?.diverging), { signed: Boolean(quantity?.diverging) }];
    const colours = chosen.value === "gaps" || quantity?.turned ? [...known].reverse() : known;
    bar.style.background = `linear-gradient(to right, ${colours.join(", ")})`;
    const ink = element("span", { class: "ramp ink", "aria-hidden": "true" });
    at("legend").replaceChildren(...[
      quantity && element("span", {}, `${quantity.title}, ${quantity.unit}`),
      quantity && element("span", { class: "key" }, number(low, quantity.digits, signed), bar, number(high, quantity.digits, signed)),
      quantity?.measure && element("span", { class: "key" }, element("span", { class: "dash unknown" }), "not known on both dates, or not to be trusted"),
      quantity && element("span", { class: "key" }, element("span", { class: "dash" }), "gap"),
      unseen.length ? element("span", { class: "key" }, element("span", { class: "dash dark" }), "not seen") : null,
      unmapped.length ? element("span", { class: "key" }, element("span", { class: "patch" }), "in no row") : null,
      element("span", { class: "key" }, "heights 0", ink, `${number(tallest)} m`),
    ].filter(Boolean));
  }

  chosen.append(...Object.entries(quantities).map(([name, { title }]) => element("option", { value: name }, title)));
  chosen.addEventListener("change", paint);
  dates?.subscribe(paint);
  if (!rows.length) chosen.parentElement.hidden = true;
  onScheme(paint);
  map.on("zoomend", thin);
  paint();
  return {
    select(row) {
      halo.setLatLngs(row.line.points.map(place));
      here.remove();
    },
    /** Show a place along a row, or none. */
    mark(row, position) {
      if (position === null) here.remove();
      else here.setLatLng(place(pointAt(row.line, position))).addTo(map);
    },
  };
}

function hintUnmapped(k) {
  const { reason, area_m2, height_m, width_m } = data.unmapped;
  return about(`In no row: ${reason[k]}`, [
    ["Area", `${number(area_m2[k], 1)} m²`], ["Height", `${number(height_m[k], 1)} m`], ["Closed over", `${number(width_m[k], 1)} m`],
  ]);
}

function hint(row) {
  return about(row.label, [
    ["Length", `${number(row.length_m, 1)} m`], ["Height", `${number(row.height_m, 2)} m`], ["Width", `${number(row.width_m, 2)} m`],
    ["Volume", `${number(row.volume_m3, 1)} m³, ${number(row.volume_m, 2)} a metre`],
    ["Gaps", `${number(row.gap_m, 1)} m, ${number(row.n_missing)} missing`],
    ...(row.unseen_m ? [["Not seen", `${number(row.unseen_m, 1)} m`]] : []),
  ]);
}

function about(title, lines) {
  return element("div", {}, element("strong", {}, title),
    element("dl", {}, ...lines.flatMap(([term, shown]) => [element("dt", {}, term), element("dd", {}, shown)])));
}
