// The canopy along the selected row.
import uPlot from "uplot";
import { at, colour, element, number, onScheme } from "./page.js";

const PLOTS = [
  { name: "height", title: "Height", unit: "m" },
  { name: "bottom", title: "Foliage from", unit: "m" },
  { name: "width", title: "Width", unit: "m" },
  { name: "area", title: "Volume per metre", unit: "m³/m" },
];

/** A profile as uPlot wants it: metres, and nothing where sections are missing. */
function series(profile, step) {
  const names = ["position", ...PLOTS.map(({ name }) => name)];
  const columns = names.map(() => []);
  profile.position.forEach((position, k) => {
    if (k && position - profile.position[k - 1] > 100 * 3 * step) {
      columns.forEach((column, c) => column.push(c ? null : (position + profile.position[k - 1]) / 200));
    }
    names.forEach((name, c) => columns[c].push(profile[name][k] === null ? null : profile[name][k] / 100));
  });
  return columns;
}

export function showPlots(rows, profiles, step, mark) {
  const tops = Object.fromEntries(PLOTS.map(({ name }) => {
    const most = Object.values(profiles).flatMap((profile) => profile[name]).reduce((a, b) => Math.max(a, b ?? 0), 0);
    return [name, Math.max(0.5, Math.ceil(most / 25) / 4)];
  }));
  const boxes = PLOTS.map(({ title, unit }) => {
    const value = element("output", {});
    const box = element("div", { class: "plot" });
    at("plots").append(element("figure", {}, element("figcaption", {}, `${title}, ${unit}`, value), box));
    return { box, value };
  });
  let row = null;
  let plots = [];
  const width = () => at("plots").clientWidth;

  function draw() {
    plots.forEach((plot) => plot.destroy());
    plots = [];
    boxes.forEach(({ box, value }) => { box.replaceChildren(); value.textContent = ""; });
    const profile = profiles[row.row_id];
    if (!profile) {
      boxes[0].box.append(element("p", { class: "empty" }, "No canopy was modelled along this row."));
      return;
    }
    const n = Math.max(2, Math.round(step / 0.25));
    const values = series(profile, Math.max(step, (row.line.length / profile.position.length) * 1.01, n * 0.01));
    plots = PLOTS.map(({ name, title, unit }, k) => {
      const { box, value } = boxes[k];
      const known = values[k + 1].filter((one) => one !== null);
      const [low, high] = [known.reduce((a, b) => Math.min(a, b)), known.reduce((a, b) => Math.max(a, b))];
      box.setAttribute("role", "img");
      box.setAttribute("aria-label", `${title} along row ${row.label}: ${number(low, 2)} to ${number(high, 2)} ${unit}`);
      const last = k === PLOTS.length - 1;
      const grid = { stroke: colour("grid"), width: 1 };
      return new uPlot({
        width: width(), height: last ? 142 : 108, legend: { show: false }, padding: [6, 8, 0, 0],
        cursor: { sync: { key: "row" }, y: false, drag: { x: false, y: false }, points: { size: 7, fill: colour("selected"), stroke: colour("paper") } },
        scales: { x: { time: false, range: [0, row.line.length] }, y: { range: [0, tops[name]] } },
        axes: [
          { show: true, size: last ? 36 : 6, values: last ? (_, ticks) => ticks.map((tick) => number(tick)) : () => [], stroke: colour("soft"), grid, ticks: { show: last, stroke: colour("grid") }, font: "12px system-ui, sans-serif", label: last ? "metres from e1" : undefined, labelSize: 16, labelGap: 0, labelFont: "12px system-ui, sans-serif" },
          { size: 40, space: 26, stroke: colour("soft"), grid, ticks: { show: false }, font: "12px system-ui, sans-serif", values: (_, ticks) => ticks.map((tick) => number(tick, Number.isInteger(tick) ? 0 : tick * 4 === Math.round(tick * 4) && tick * 2 !== Math.round(tick * 2) ? 2 : 1)) },
        ],
        series: [{}, { stroke: colour("line"), width: 1.6, fill: colour("area"), points: { show: false }, spanGaps: false }],
        hooks: {
          drawClear: [(plot) => shadeGaps(plot, row)],
          setCursor: [(plot) => {
            const at = plot.cursor.idx;
            const there = at === null || at === undefined ? null : values[k + 1][at];
            value.textContent = there === null ? "" : `${number(there, 2)} at ${number(values[0][at], 1)} m`;
            if (plot === plots[0]) mark(row, at === null || at === undefined ? null : values[0][at]);
          }],
        },
      }, values.filter((_, c) => c === 0 || c === k + 1), box);
    });
  }

  new ResizeObserver(() => plots.forEach((plot) => plot.width !== width() && plot.setSize({ width: width(), height: plot.height }))).observe(at("plots"));
  onScheme(() => row && draw());
  return { select(next) { row = next; draw(); } };
}

function shadeGaps(plot, row) {
  const { ctx, bbox } = plot;
  ctx.save();
  for (const [stretches, name] of [[row.gaps, "gap-tint"], [row.unseen, "grid"]]) {
    ctx.fillStyle = colour(name);
    for (const { start, end } of stretches) {
      const [from, to] = [start, end].map((position) => plot.valToPos(position, "x", true));
      ctx.fillRect(from, bbox.top, to - from, bbox.height);
    }
  }
  ctx.restore();
}
