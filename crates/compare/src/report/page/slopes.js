// Maps of the slope along x and along y, before and after.

const slopeLayers = new Map();

/**
 * The slopes of a map along x (axis 0) or y (axis 1), nrad: (z(u + base) - z(u)) / base, 1 nm/mm = 1000 nrad, at the
 * middle between the two pixels. The base is the whole number of pixels of the page that is nearest to `base_mm`, at
 * least one. Null if the base is not known, or the map is not longer than it.
 */
function slopeLayerOf(layer, axis, base_mm) {
  if (base_mm === null) return null;
  const { nx, ny, dx, dy } = layer, pixel_mm = [dx, dy][axis];
  const steps = Math.max(1, Math.round(base_mm / pixel_mm)), columns = axis === 0 ? steps : 0, rows = axis === 1 ? steps : 0;
  if (nx <= columns || ny <= rows) return null;
  const z = layer.values(), values = new Float64Array((nx - columns) * (ny - rows));
  let n = 0, sum = 0, squares = 0, low = Infinity, high = -Infinity;
  for (let r = 0, i = 0; r < ny - rows; r++)
    for (let c = 0; c < nx - columns; c++, i++) {
      const slope = (1000 * (z[(r + rows) * nx + c + columns] - z[r * nx + c])) / (steps * pixel_mm);
      values[i] = slope;
      if (slope === slope) { n++; sum += slope; low = Math.min(low, slope); high = Math.max(high, slope); }
    }
  if (n === 0) return null;
  const mean = sum / n;
  for (const v of values) if (v === v) squares += (v - mean) ** 2;
  return {
    ...layer, title: "slope", unit: "nrad", own: true, x0: layer.x0 + (columns * dx) / 2, y0: layer.y0 + (rows * dy) / 2,
    nx: nx - columns, ny: ny - rows, mean, rms: Math.sqrt(squares / n), reach: reachAround(mean, [low, high]), reach99: undefined,
    base_mm: steps * pixel_mm, values: () => values,
  };
}

/** What a panel shows of the slopes of a map; `rms` is the RMS slope of the whole array along x and y, nrad. */
function slopeContent(layer, key, axis, run, rms, when) {
  const slopeKey = `slope${axis}${key}|${layer.nx}`, along = ["x", "y"][axis];
  if (!slopeLayers.has(slopeKey)) slopeLayers.set(slopeKey, slopeLayerOf(layer, axis, run.summary.slope_base_mm[axis]));
  const slopes = slopeLayers.get(slopeKey);
  const blocks = layer.every > 1 ? `, of means over ${layer.every} x ${layer.every} pixels` : "";
  return slopes && mapContent(slopes, slopeKey, {
    title: `slope along ${along}, ${when}: ${number(rms[axis])} nrad RMS`, still: true, idle: POINT_TO_READ,
    note: `over ${number(slopes.base_mm, 3)} mm${blocks}`,
  });
}

function addSlopePanels() {
  for (const axis of [0, 1]) {
    new Panel("slope-maps", "slope-before-" + "xy"[axis], () =>
      slopeContent(A().run.desired, "desired" + A().run.name, axis, A().run, A().run.summary.initial.slope_rms_nrad, "before"));
    new Panel("slope-maps", "slope-after-" + "xy"[axis], () =>
      slopeContent(A().residual, "residual" + state.a, axis, A().run, A().run.summary.methods[A().method.name].slope_rms_nrad, "after " + A().label));
  }
  byId("slopes").addEventListener("toggle", redraw);
}
