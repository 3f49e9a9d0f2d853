// A map in metres, north up, which zooms with the wheel once it has been clicked.
import { Control, CRS, DomUtil, Map as LeafletMap, control } from "leaflet/dist/leaflet-src.esm.js";

export const place = ([x, y]) => [y, x];

export function plan(id) {
  const map = new LeafletMap(id, {
    crs: CRS.Simple, zoomSnap: 0.25, minZoom: -8, maxZoom: 7, attributionControl: false, scrollWheelZoom: false,
    zoomAnimation: !matchMedia("(prefers-reduced-motion: reduce)").matches, preferCanvas: true,
  });
  map.on("focus", () => map.scrollWheelZoom.enable()).on("blur", () => map.scrollWheelZoom.disable());
  control.scale({ imperial: false, maxWidth: 140 }).addTo(map);
  const north = new Control({ position: "topright" });
  north.onAdd = () => {
    const arrow = DomUtil.create("div", "north");
    arrow.textContent = "N";
    arrow.title = "North of the map's grid is up";
    return arrow;
  };
  north.addTo(map);
  return map;
}

/** Show some bounds, now and, until somebody has moved the map, whenever its size changes. */
export function keepInSight(map, bounds) {
  let moved = false;
  const fit = () => map.invalidateSize({ animate: false }).fitBounds(bounds, { animate: false, padding: [14, 14] });
  fit();
  map.getContainer().addEventListener("pointerdown", () => { moved = true; }, { passive: true });
  map.getContainer().addEventListener("wheel", () => { moved ||= map.scrollWheelZoom.enabled(); }, { passive: true });
  new ResizeObserver(() => (moved ? map.invalidateSize() : fit())).observe(map.getContainer());
  return fit;
}

/** Bounds of points [x, y] as a map wants them. */
export function boundsOf(points) {
  const [x, y] = [0, 1].map((k) => points.map((point) => point[k]));
  const least = (values) => values.reduce((a, b) => Math.min(a, b), Infinity);
  const most = (values) => values.reduce((a, b) => Math.max(a, b), -Infinity);
  return [[least(y), least(x)], [most(y), most(x)]];
}
