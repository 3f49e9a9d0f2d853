// Colours for numbers.
import { isDark } from "./page.js";

const SEQUENCE = {
  light: ["#d9a21b", "#a3ad35", "#4f9a5b", "#1c7470", "#17425f"],
  dark: ["#c98a1b", "#b3b544", "#6cc287", "#63d3d0", "#c4ebff"],
};
const DIVERGING = {
  light: ["#b0233f", "#e08a8f", "#b9b6ab", "#6aab88", "#17694a"],
  dark: ["#ff6b81", "#c98088", "#77786f", "#6fb897", "#4fe0a3"],
};

export const stops = (diverging) => (diverging ? DIVERGING : SEQUENCE)[isDark() ? "dark" : "light"];

function mix(one, other, share) {
  const parts = [1, 3, 5].map((k) => {
    const [a, b] = [one, other].map((hex) => parseInt(hex.slice(k, k + 2), 16));
    return Math.round(a + (b - a) * share).toString(16).padStart(2, "0");
  });
  return `#${parts.join("")}`;
}

/** Colour of a value between low and high. */
export function shade(value, [low, high], diverging) {
  const colours = stops(diverging);
  const share = high > low ? Math.min(1, Math.max(0, (value - low) / (high - low))) : 0.5;
  const k = Math.min(colours.length - 2, Math.floor(share * (colours.length - 1)));
  return mix(colours[k], colours[k + 1], share * (colours.length - 1) - k);
}

/** Range that holds the middle of some values, so that odd ones don't take all the colours. */
export function range(values, { zero = false, diverging = false, least = 0.1 } = {}) {
  const known = values.filter((value) => Number.isFinite(value)).sort((a, b) => a - b);
  if (!known.length) return [0, 1];
  const quantile = (q) => known[Math.round(q * (known.length - 1))];
  let [low, high] = [quantile(0.03), quantile(0.97)];
  if (diverging) {
    const most = Math.max(Math.abs(low), Math.abs(high), least);
    return [-most, most];
  }
  if (zero) low = 0;
  return high - low < least ? [low, low + least] : [low, high];
}
