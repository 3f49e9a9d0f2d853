// What the page says: whose parcel, its key numbers, how far to trust them, what they were made of.
import { at, day, element, facts, number, plural } from "./page.js";

export function showHead({ parcel, survey, flown, warnings, totals, vinemap }) {
  at("over").textContent = ["Vine rows", survey && `survey ${survey}`, flown && `flown ${day(flown)}`].filter(Boolean).join(" · ");
  at("title").textContent = parcel;
  const share = totals.length_m ? `${number((100 * totals.gap_m) / (totals.length_m - totals.unseen_m), 1)}% of the length` : "";
  const ha = totals.area_m2 / 1e4;
  facts(at("figures"), [
    ["Rows", number(totals.rows)],
    ["Total length", number(totals.length_m), "m"],
    ["Area", number(ha, 2), "ha"],
    ["Mean spacing", number(totals.spacing_m, 2), "m"],
    ["Canopy volume", number(totals.volume_m3), "m³", ha && totals.volume_m3 ? `${number(totals.volume_m3 / ha)} m³/ha` : ""],
    ["Mean height", number(totals.height_m, 2), "m", totals.width_m ? `${number(totals.width_m, 2)} m wide` : ""],
    ["Missing vines", number(totals.n_missing)],
    ["Gaps", number(totals.gap_m, 1), "m", share],
    ...(totals.unseen_m ? [["Not seen", number(totals.unseen_m, 1), "m", "of the rows"]] : []),
  ]);
  at("notices").append(
    warnings?.length
      ? element("div", { class: "warning", role: "note" },
          element("strong", {}, warnings.length > 1 ? "Warnings" : "Warning"),
          element("ul", {}, ...warnings.map((warning) => element("li", {}, warning))))
      : element("p", { class: "fine" }, "No warnings: the points cover the parcel densely, and no row is doubtful."),
  );
  at("footer").textContent = `Made by vinemap ${vinemap} from points alone. This file asks no network for anything: it can be mailed, printed and kept.`;
}

export function showQuality({ modelling, totals, counts }, rows) {
  const percent = (value, digits = 1) => number(value === null || value === undefined ? null : 100 * value, digits);
  const lowest = (name) => {
    const known = rows.map((row) => row[name]).filter((value) => value !== null);
    const doubtful = known.filter((value) => value < 0.5).length;
    return known.length ? (doubtful ? `${doubtful} below 0.5` : `lowest ${number(Math.min(...known), 2)}`) : "";
  };
  facts(at("quality"), [
    ["Confidence in rows", number(totals.confidence, 2), "", lowest("confidence")],
    ["Confidence in canopies", number(totals.canopy_confidence, 2), "", lowest("canopy_confidence")],
    ["Rows with canopy", percent(totals.support), "%", "of their length"],
    ["Well modelled", percent(modelling?.good), "%", "of the outline of the points"],
    ["Under-modelled", percent(modelling?.under), "%", "of that outline left out"],
    ["Over-modelled", percent(modelling?.over), "%", "added around that outline"],
    ["Complexity reduction", number(modelling?.reduction, 3), "", "after Table 3.1"],
    ["Quality score", number(modelling?.quality, 3), "", "1 is best"],
    ["Mesh error", number(100 * (totals.mesh_error_m ?? NaN), 1), "cm", "mean of the rows’ medians, by their points"],
    ["Points", number((counts?.points ?? NaN) / 1e6, 2), "million", `${plural(counts?.sections ?? 0, "canopy section")}`],
  ]);
}

/** What stands in no row, a line a reason. */
export function showUnmapped({ unmapped }) {
  const sums = new Map();
  unmapped.reason.forEach((reason, k) => {
    const { n, area, share } = sums.get(reason) ?? { n: 0, area: 0, share: 0 };
    sums.set(reason, { n: n + 1, area: area + unmapped.area_m2[k], share: share + unmapped.share[k] });
  });
  const lines = [...sums].sort(([, one], [, other]) => other.area - one.area);
  at("unmapped").hidden = !lines.length;
  at("unmapped").append("In no row: ", lines.map(([reason, { n, area, share }]) =>
    `${reason}, ${plural(n, "place")}, ${number(area)} m² (${number(100 * share, 1)}% of the parcel)`).join("; "), ".");
}

/** How far the flight lies off known rows, in the directions in which that is told. */
function offKnownRows({ east_m, north_m, east_sd_m, north_sd_m, axes: [best, worst] }) {
  const metres = (value, sd) => `${number(value, 2)} ± ${number(sd, 2)} m`;
  if (worst.sd_m === null)
    return `the flight lies ${metres(best.m, best.sd_m)} off them towards ${number(best.deg)}° (anticlockwise from east); along the rows nothing tells it`;
  return `the flight lies ${number(Math.hypot(east_m, north_m), 2)} m off them: ${metres(east_m, east_sd_m)} to the east, ${metres(north_m, north_sd_m)} to the north`;
}

export function showRecord({ inputs, settings, versions, vinemap, crs, vertical_datum, origin, flown, counts, shift }) {
  const line = (term, ...shown) => element("div", {}, element("dt", {}, term), element("dd", {}, ...shown));
  const code = (text) => element("code", {}, text);
  const files = (inputs ?? []).flatMap((input) => [
    line(input.file, `${number(input.bytes)} bytes, SHA-256 `, code(input.sha256)),
  ]);
  const stages = Object.entries(settings ?? {}).map(([stage, options]) =>
    line(stage, ...Object.entries(options).flatMap(([name, value], k) => [k ? ", " : "", code(`${name}: ${JSON.stringify(value)}`)])));
  at("record").append(
    element("h3", {}, "Place"),
    element("dl", {},
      line("Coordinate system", crs ?? "–"),
      line("Heights", vertical_datum ?? "the cloud’s own vertical datum, which it doesn’t name"),
      origin ? line("Origin of {Main}", `${number(origin.lat, 9)}° N, ${number(origin.lon, 9)}° E, ${number(origin.alt, 3)} m`) : null,
      shift ? line("Known rows", offKnownRows(shift), settings?.rows?.align ? ", and was moved onto them" : "") : null,
      line("Flown", flown ? day(flown) : "–")),
    element("h3", {}, "Inputs"), element("dl", {}, ...files),
    element("h3", {}, "Settings"), element("dl", {}, ...stages),
    element("h3", {}, "Counts"),
    element("dl", {}, ...Object.entries(counts ?? {}).map(([name, n]) => line(name.replaceAll("_", " "), number(n)))),
    element("h3", {}, "Versions"),
    element("dl", {}, line("vinemap", vinemap), ...Object.entries(versions ?? {}).map(([name, version]) => line(name, version))),
  );
}
