// Colours, and numbers for people.

const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));
function colourTable(colours, n) {
  const stops = colours.map(rgb);
  return Array.from({ length: n }, (_, i) => {
    const at = (i / (n - 1)) * (stops.length - 1), k = Math.min(Math.floor(at), stops.length - 2);
    return stops[k].map((v, j) => Math.round(v + (stops[k + 1][j] - v) * (at - k)));
  });
}
const HEIGHT = colourTable(DATA.colours.height, 255);
const SPEED = colourTable(DATA.colours.speed, 32);
const HEIGHT_BINS = colourTable(DATA.colours.height, 33);
const css = ([r, g, b]) => `rgb(${r},${g},${b})`;
let theme = {};
function readTheme() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ["paper", "ink", "soft", "line", "field", "accent", "x", "y", "bad"])
    theme[name] = style.getPropertyValue("--" + name).trim();
}
const LINES = () => [theme.ink, theme.x, theme.y, "#009e73", "#cc79a7", "#56b4e9", "#b8860b"];

/** A number with so many decimals; zero has no sign. */
function fixed(v, decimals) {
  return (+v.toFixed(decimals) + 0).toFixed(decimals);
}
/** A number with `digits` significant ones. */
function number(v, digits = 4) {
  if (!Number.isFinite(v)) return "-";
  if (v === 0) return "0";
  const size = Math.abs(v);
  if (size < 1e-4 || size >= 1e6) return v.toExponential(digits - 1);
  return fixed(v, Math.max(0, Math.min(8, digits - 1 - Math.floor(Math.log10(size)))));
}
function short(v) {
  if (!Number.isFinite(v)) return "";
  if (Math.abs(v) < 1e-12) return "0";
  const size = Math.abs(v);
  if (size < 1e-3 || size >= 1e5) return v.toExponential(0);
  return String(+v.toPrecision(4));
}
function ticks(low, high, most) {
  const raw = (high - low) / Math.max(most, 1), power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw) || 10 * power;
  const out = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i++) out.push(i * step);
  return out;
}
