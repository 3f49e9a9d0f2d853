// A small plot a parcel, of its rows over the dates.
import { at, element, plural } from "./page.js";
import { DOUBTS, MEASURES, plotOf, reachOf, spanOf } from "./seasons.js";

export function showSeasons(parcels, selected) {
  const flown = parcels.filter((parcel) => parcel.seasons);
  if (!flown.length) return;
  at("seasons").hidden = false;
  const all = flown.map(({ seasons }) => seasons);
  const span = spanOf(all);
  at("measure").append(...Object.entries(MEASURES).map(([name, { title }]) => element("option", { value: name }, title)));
  const boxes = flown.map((parcel) => {
    const plot = element("div", {});
    const button = element("button", { type: "button", "aria-pressed": "false", onclick: () => selected.set(parcel) },
      element("figure", {}, element("figcaption", {}, element("strong", {}, parcel.parcel), plural(parcel.seasons.dates.length, "flight")), plot));
    return { parcel, plot, button };
  });
  at("plots").append(...boxes.map(({ button }) => button));
  function paint() {
    const measure = MEASURES[at("measure").value];
    const reach = reachOf(all, measure);
    for (const { parcel, plot } of boxes) plot.replaceChildren(plotOf(parcel.seasons, measure, { span, reach, title: parcel.parcel }));
    at("seasons-hint").textContent = `${measure.title}, ${measure.unit}: each row a thin line, their mean a thick one with its last value, all on one scale. ${DOUBTS}`;
  }
  at("measure").addEventListener("change", paint);
  selected.subscribe((chosen) => boxes.forEach(({ parcel, button }) => button.setAttribute("aria-pressed", String(parcel === chosen))));
  paint();
}
