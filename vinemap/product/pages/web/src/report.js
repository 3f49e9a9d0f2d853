// The page of a parcel.
import { data, unpack, unpackJSON } from "./data.js";
import { at, choice, element, number, plural } from "./page.js";
import { showHead, showQuality, showRecord, showUnmapped } from "./words.js";
import { showDates } from "./dates.js";
import { measured } from "./line.js";
import { showMap } from "./map.js";
import { showPlots } from "./plots.js";
import { rowTable } from "./rows.js";

/** Rows as objects: their numbers, line, gaps, and once they are unpacked, their canopies. */
const rows = data.rows.row_id.map((id, k) => {
  const row = Object.fromEntries(Object.entries(data.rows).map(([name, values]) => [name, values[k]]));
  const own = data.gaps.row_id.map((of, g) => (of === id ? g : -1)).filter((g) => g >= 0);
  const gaps = own.map((g) => ({ start: data.gaps.start_m[g], end: data.gaps.end_m[g], unseen: data.gaps.state[g] === "unseen" }));
  row.gaps = gaps.filter(({ unseen }) => !unseen);
  row.unseen = gaps.filter(({ unseen }) => unseen);
  row.line = measured(row.line);
  row.volume_m = row.volume_m3 / (row.length_m - row.unseen_m);
  row.gap_share = row.gap_m / (row.length_m - row.unseen_m);
  return row;
});
const selected = choice();
const done = (name) => performance.mark(name);

showHead(data);
showQuality(data, rows);
showUnmapped(data);
showRecord(data);
if (rows.length) start();
else at("table").append(element("p", { class: "empty" }, `No vine row was found in ${data.parcel}. The map shows what stands there, the warnings above tell why.`));
if (!rows.length) {
  at("views").hidden = false;
  at("views").classList.add("alone");
  showMap(rows, {}, selected);
  done("drawn");
}

async function start() {
  at("views").hidden = false;
  const { profiles, terrain } = await unpackJSON("details");
  const step = data.settings?.sections?.step ?? 0.25;
  const seasons = await unpackJSON("history");
  const table = rowTable(rows, selected);
  const map = showMap(rows, profiles, selected, seasons);
  const plots = showPlots(rows, profiles, step, (row, position) => map.mark(row, position));
  showSteps();

  selected.subscribe((row) => {
    table.select(row);
    map.select(row);
    plots.select(row);
    at("row").value = String(rows.indexOf(row));
    at("facts").textContent = [
      `${number(row.length_m, 1)} m long`, `${number(row.volume_m, 2)} m³ of canopy a metre`,
      row.gaps.length ? `${plural(row.gaps.length, "gap")} of ${number(row.gap_m, 1)} m` : "no gap",
      row.gaps.length || row.n_missing ? `${plural(row.n_missing, "vine")} missing` : "",
      row.unseen_m ? `${number(row.unseen_m, 1)} m not seen` : "",
      row.flags ? `odd: ${row.flags}` : "",
    ].filter(Boolean).join(" · ");
  });
  if (seasons) showDates(rows, seasons, selected);
  const asked = decodeURIComponent(location.hash).match(/^#row-(\d+)$/);
  selected.set(rows.find((row) => row.row_id === Number(asked?.[1])) ?? rows[0]);
  requestAnimationFrame(() => setTimeout(() => done("drawn")));
  startCanopies(terrain);
}

function showSteps() {
  at("row").append(...rows.map((row, k) => element("option", { value: k }, row.label)));
  at("row").addEventListener("change", () => selected.set(rows[Number(at("row").value)]));
  const move = (by) => selected.set(rows[(rows.indexOf(selected.get()) + by + rows.length) % rows.length]);
  at("before").addEventListener("click", () => move(-1));
  at("after").addEventListener("click", () => move(1));
}

/** Start the view in 3D, whose script is a page in itself, when it comes near. */
function startCanopies(terrain) {
  at("space").hidden = false;
  const view = at("canopies-view");
  const watch = new IntersectionObserver(async (entries) => {
    if (!entries.some((entry) => entry.isIntersecting)) return;
    watch.disconnect();
    try {
      document.head.append(element("script", {}, at("canopies-js").textContent));
      const show = globalThis.vinemapCanopies;
      await show(view, await unpack("canopies"), { terrain, rows, selected, whole: at("whole"), near: at("near") });
      done("canopies");
    } catch (error) {
      const reason = `The canopies can't be drawn here (${error.message}). Their file is ${data.parcel}_canopy.glb.`;
      view.replaceChildren(element("p", { class: "wait" }, reason));
    }
  }, { rootMargin: "400px" });
  watch.observe(view);
}
