// Positions along lines in plan.

export function measured(points) {
  const at = [0];
  for (let k = 1; k < points.length; k += 1) {
    at.push(at[k - 1] + Math.hypot(points[k][0] - points[k - 1][0], points[k][1] - points[k - 1][1]));
  }
  return { points, at, length: at.at(-1) };
}

/** The point at a position, in metres from the start. */
export function pointAt({ points, at, length }, position) {
  const here = Math.min(Math.max(position, 0), length);
  const k = Math.max(1, at.findIndex((value) => value >= here));
  const span = at[k] - at[k - 1] || 1;
  return [0, 1].map((i) => points[k - 1][i] + ((points[k][i] - points[k - 1][i]) * (here - at[k - 1])) / span);
}

/** The piece between two positions. */
export function piece(line, start, stop) {
  const inner = line.points.filter((_, k) => line.at[k] > start && line.at[k] < stop);
  return [pointAt(line, start), ...inner, pointAt(line, stop)];
}
