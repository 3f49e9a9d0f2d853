// Table 2.1 of the rows, and what lies beyond it.
import { at, element, number } from "./page.js";
import { table } from "./table.js";

const ENDS = ["e1", "en"];
const COLUMNS = [
  ["length_m", "Length", "m", 2, "In 3D, along the row"],
  ["orientation_deg", "Orientation", "°", 2, "Mean, anticlockwise from true east"],
  ["elevation_m", "Elevation", "m", 2, "Mean along the row"],
  ["elevation_diff_m", "Difference", "m", 2, "Elevation of the end en less that of e1"],
  ["spacing_m", "Spacing", "m", 2, "To the rows beside it"],
  ["height_m", "Height", "m", 2, "Of the canopy above ground"],
  ["bottom_m", "Foliage from", "m", 2, "Height above ground at which foliage begins"],
  ["width_m", "Width", "m", 2, "Of the canopy"],
  ["volume_m3", "Volume", "m³", 1, "Of the foliage"],
  ["volume_m", "Volume a metre", "m³/m", 3, "Volume over length, gaps included, but for what was not seen"],
  ["trv_m3_ha", "TRV", "m³/ha", 0, "Tree-row volume"],
  ["lwa_m2_ha", "LWA", "m²/ha", 0, "Leaf-wall area"],
  ["gap_m", "Gaps", "m", 2, "Length of its gaps, as far as it was seen"],
  ["n_missing", "Missing", "vines", 0, "Vines missing in it, as far as it was seen"],
  ["unseen_m", "Not seen", "m", 2, "Length of which the points show nothing, neither vines nor gaps"],
  ["support", "Support", "", 2, "Share of the length that was seen with canopy"],
  ["confidence", "Confidence", "", 2, "That it is a whole row, no more and no less: 0 to 1"],
  ["canopy_confidence", "Canopy confidence", "", 2, "In height, width and volume: 0 to 1"],
  ["mesh_error_m", "Mesh error", "m", 3, "How far the foliage's surface lies from the mesh, by its points: half of it is nearer"],
  ["flags", "Flags", "", null, "What is odd beside the neighbours"],
  ["block", "Block", "", 0, "Rows of one direction and spacing"],
  ["n_key_points", "Key points", "", 0, "Enhanced key points along the row"],
  ...ENDS.flatMap((end) => [..."xyz"].map((axis) => [`${end}_${axis}`, `${end} ${axis}`, "m", 2, "In {Main}"])),
  ...ENDS.flatMap((end) => [["lat", "°", 8], ["lon", "°", 8], ["alt", "m", 2]].map(([axis, unit, digits]) => [`${end}_${axis}`, `${end} ${axis}`, unit, digits, "In WGS 84"])),
];

export function rowTable(rows, selected) {
  const columns = COLUMNS.map(([name, title, unit, digits, help]) => ({
    title, unit, help,
    values: rows.map((row) => row[name]),
    text: digits === null,
    show: digits === null ? (value) => value || "" : (value) => number(value, digits),
  }));
  const label = { title: "Row", help: "Number of the row", values: rows.map((row) => row.row_id), text: true, show: (_, k) => rows[k].label };
  const made = table([label, ...columns], { caption: "Rows in numbers", onselect: (k) => selected.set(rows[k]), sorted: 0 });
  made.element.classList.add("tall");
  at("table").append(made.element, element("p", { class: "hint" }, "A click on a heading sorts, on a row selects it. e1 is the western end of a row, or a known row’s first, en the other; x, y, z are metres to the east, north and up of the origin of {Main}, lat, lon, alt are WGS 84."));
  return {
    select(row) {
      made.lines.forEach((line, k) => {
        if (rows[k] === row) {
          line.setAttribute("aria-current", "true");
          show(made.element, line);
        } else line.removeAttribute("aria-current");
      });
    },
  };
}

// Scrolls a box so far that a line in it is seen below the headings; the page itself stays where it is.
function show(box, line) {
  const within = box.getBoundingClientRect(), at = line.getBoundingClientRect();
  const head = box.querySelector("thead").offsetHeight;
  const above = within.top + head - at.top, below = at.bottom - within.bottom;
  if (above > 0) box.scrollTop -= above;
  else if (below > 0) box.scrollTop += below;
}
