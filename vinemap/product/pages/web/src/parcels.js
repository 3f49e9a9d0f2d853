// Parcels and their rows on the map.
import { Canvas, LayerGroup, Marker, Polygon, Polyline, divIcon } from "leaflet/dist/leaflet-src.esm.js";
import { at, colour, element, number, onScheme } from "./page.js";
import { boundsOf, keepInSight, place, plan } from "./plan.js";
import { range, shade, stops } from "./scale.js";
import { MEASURES, growthOf, isDoubtful, valueOf } from "./seasons.js";

const QUANTITIES = {
  rows: { title: "Rows alone" },
  density: { title: "Volume per metre", unit: "m³/m", digits: 2, of: ({ volume_m3: v, seen_m: l }) => (l ? v / l : null) },
  height: { title: "Height", unit: "m", digits: 2, of: (parcel) => parcel.height_m },
  gaps: { title: "Gaps, share of the rows", unit: "%", digits: 1, of: ({ gap_m: g, seen_m: l }) => (l ? (100 * g) / l : null), turned: true, zero: true },
  volume: { title: "Change of volume", unit: "%", digits: 1, of: ({ summary }) => (summary?.d_volume === undefined || summary.d_volume === null ? null : 100 * summary.d_volume), diverging: true, least: 2 },
  tall: { title: "Change of height", unit: "m", digits: 2, of: ({ summary }) => summary?.d_height_m, diverging: true, least: 0.05 },
  missing: { title: "Change of missing vines", unit: "vines", digits: 0, of: ({ summary }) => summary?.d_n_missing, diverging: true, least: 2, turned: true },
  ...Object.fromEntries(Object.entries(MEASURES).map(([name, measure]) => [`rows-${name}`, {
    title: `Rows: change of ${measure.title.toLowerCase()}`, unit: measure.unit, digits: measure.digits, least: measure.least, turned: measure.turned, diverging: true, measure,
  }])),
};

export function showParcels(parcels, pair, [west, south, east, north], selected) {
  const map = plan("map");
  const all = [[south, west], [north, east]];
  keepInSight(map, all);
  const canvas = new Canvas({ padding: 0.3 });
  const drawn = new LayerGroup().addTo(map);
  const names = parcels.map((parcel) => {
    const [[y0, x0], [y1, x1]] = boundsOf(parcel.outline.flat());
    const icon = divIcon({ className: "parcel-name", html: element("span", {}, parcel.parcel), iconSize: null });
    return { size: x1 - x0, mark: new Marker([(y0 + y1) / 2, (x0 + x1) / 2], { icon, interactive: false, keyboard: false, alt: "" }) };
  });
  const frame = new Polygon([], { renderer: canvas, fill: false, weight: 3, interactive: false });
  const marks = new LayerGroup().addTo(map); // rows that are new or gone
  let show = () => {};
  const options = Object.entries(QUANTITIES).filter(([, { of, measure }]) => (measure ? parcels.some((parcel) => parcel.seasons) : !of || parcels.some((parcel) => Number.isFinite(of(parcel)))));
  const chosen = at("quantity");
  chosen.append(...options.map(([name, { title }]) => element("option", { value: name }, title)));

  function paint() {
    drawn.clearLayers();
    const quantity = QUANTITIES[chosen.value];
    const values = parcels.map((parcel) => (quantity.of ? quantity.of(parcel) : null));
    const grown = parcels.map((parcel) => (quantity.measure ? growth(parcel, quantity.measure) : []));
    const span = range(quantity.measure ? grown.flat() : values, quantity);
    const tint = (value) => shade(quantity.turned ? span[0] + span[1] - value : value, span, quantity.diverging);
    parcels.forEach((parcel, k) => {
      const value = values[k];
      const fill = Number.isFinite(value) ? tint(value) : colour("soft");
      const shape = new Polygon(parcel.outline.map((ring) => ring.map(place)), {
        renderer: canvas, color: colour("outline"), weight: 1.2, fillColor: fill, fillOpacity: Number.isFinite(value) ? 0.75 : 0.08,
      });
      shape.bindTooltip(() => hint(parcel, quantity, value), { sticky: true, className: "about", opacity: 1 });
      shape.on("click", () => selected.set(parcel)).addTo(drawn);
      if (quantity.measure) {
        parcel.lines.forEach((line, row) => {
          const one = grown[k][row] ?? null;
          new Polyline(line.map(place), { renderer: canvas, weight: 4, color: one === null ? colour("rule") : tint(one) })
            .bindTooltip(() => rowHint(parcel, row, quantity.measure, one), { sticky: true, className: "about", opacity: 1 })
            .on("click", () => selected.set(parcel)).addTo(drawn);
        });
        return;
      }
      const lines = parcel.lines.map((line) => line.map(place));
      new Polyline(lines, { renderer: canvas, interactive: false, weight: 1.3, color: Number.isFinite(value) ? colour("map") : colour("line"), opacity: 0.9 }).addTo(drawn);
    });
    frame.setStyle({ color: colour("selected") });
    if (frame.getLatLngs().flat(2).length) frame.remove().addTo(map);
    show();
    legend(quantity, span);
  }

  /** Changes of a parcel's rows between the two flights, null where one isn't known. */
  function growth(parcel, measure) {
    const between = pair.of(parcel);
    return parcel.lines.map((_, row) => (between ? growthOf(parcel.seasons, measure, row, between.from, between.to) : null));
  }

  function rowHint(parcel, row, measure, change) {
    const between = pair.of(parcel);
    const shown = (date) => {
      const doubt = isDoubtful(parcel.seasons, measure, row, date) ? " ?" : "";
      return `${number(valueOf(parcel.seasons, measure, row, date), measure.digits)}${doubt} ${measure.unit}`;
    };
    if (!between) return about(parcel.parcel, [["Not flown", "on both dates"]]);
    const dates = [between.from, between.to].map((date) => [parcel.seasons.dates[date].survey ?? "", shown(date)]);
    const label = parcel.seasons.labels[row].at(-1);
    return about(`Row ${label}`, [...dates, [measure.title, `${number(change, measure.digits, { signed: true })} ${measure.unit}`]]);
  }

  const marked = element("span", { id: "marks", class: "key", hidden: true },
    element("span", { class: "dash fresh" }), "new row", element("span", { class: "dash lost" }), "row that is gone");
  function legend(quantity, [low, high]) {
    const bar = element("span", { class: "ramp", "aria-hidden": "true" });
    const colours = quantity.turned ? [...stops(quantity.diverging)].reverse() : stops(quantity.diverging);
    bar.style.background = `linear-gradient(to right, ${colours.join(", ")})`;
    const signed = { signed: Boolean(quantity.diverging) };
    at("legend").replaceChildren(...(quantity.of || quantity.measure ? [
      element("span", {}, `${quantity.title}, ${quantity.unit}`),
      element("span", { class: "key" }, number(low, quantity.digits, signed), bar, number(high, quantity.digits, signed)),
      ...(quantity.measure ? [element("span", { class: "key" }, element("span", { class: "dash unknown" }), "not known on both dates, or not to be trusted")] : []),
    ] : [element("span", {}, "Outlines of the parcels, and their rows")]), marked);
  }

  /** Names of parcels that are wide enough on the screen. */
  function label() {
    const scale = map.getZoomScale(map.getZoom(), 0);
    const seen = map.getBounds().pad(0.1);
    names.forEach(({ size, mark }, k) => {
      if (size * scale > 10 + 7 * parcels[k].parcel.length && seen.contains(mark.getLatLng())) mark.addTo(map);
      else mark.remove();
    });
  }

  chosen.addEventListener("change", paint);
  onScheme(paint);
  map.on("zoomend moveend", label);
  paint();
  label();
  let first = true;
  return {
    paint,
    select(parcel) {
      const { changes } = parcel;
      show = () => {
        marks.clearLayers();
        if (QUANTITIES[chosen.value].measure) {
          at("marks").hidden = true;
          return;
        }
        const added = parcel.lines.filter((_, k) => changes?.state[k] === "new");
        const line = (points, options) => new Polyline(points.map(place), { renderer: canvas, interactive: false, weight: 3, ...options }).addTo(marks);
        for (const points of added) line(points, { color: colour("selected") });
        for (const points of changes?.gone ?? []) line(points, { color: colour("gap"), dashArray: "7 5" });
        at("marks").hidden = !added.length && !changes?.gone.length;
      };
      show();
      frame.setLatLngs(parcel.outline.map((ring) => ring.map(place))).addTo(map);
      if (!first) map.fitBounds(boundsOf(parcel.outline.flat()), { padding: [40, 40], maxZoom: map.getBoundsZoom(all) + 3 });
      first = false;
    },
  };
}

function hint(parcel, quantity, value) {
  const lines = [
    ["Rows", `${number(parcel.rows)}, ${number(parcel.length_m)} m`],
    ["Missing", `${number(parcel.n_missing)} vines`],
    ...(quantity.of ? [[quantity.title, `${number(value, quantity.digits, { signed: Boolean(quantity.diverging) })} ${quantity.unit}`]] : []),
  ];
  return about(parcel.parcel, lines);
}

function about(title, lines) {
  return element("div", {}, element("strong", {}, title),
    element("dl", {}, ...lines.flatMap(([term, shown]) => [element("dt", {}, term), element("dd", {}, shown)])));
}
