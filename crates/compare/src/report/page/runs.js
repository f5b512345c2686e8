// Runs and methods, and what of them is shown.

/** Largest distance from the mean; 1 nm for a map that is flat but for rounding. */
function reachAround(mean, [low, high]) {
  const reach = Math.max(high - mean, mean - low);
  return reach > 1e-12 * Math.max(Math.abs(low), Math.abs(high)) ? reach : 1;
}

/** A map on the screen: pixel centres x0 + c dx, y0 + r dy, row 0 is the smallest y. */
function layerOf(title, map) {
  return {
    title, x0: map.start_mm[0], y0: map.start_mm[1], dx: map.step_mm[0], dy: map.step_mm[1],
    nx: map.size[0], ny: map.size[1], every: map.every, mean: map.mean_nm, rms: map.rms_nm,
    reach: reachAround(map.mean_nm, map.range_nm), reach99: map.reach_99_nm,
    step: map.height_nm.scale, values: once(() => unpack(map.height_nm)),
  };
}

function entryOf(run, method) {
  const frames = method.frames;
  return {
    run, method,
    label: (DATA.runs.length > 1 ? run.name + " / " : "") + method.name + (run.summary.methods[method.name].plan.state === "without-motion" ? " (without a motion)" : ""),
    removal: layerOf("predicted removal", method.removal),
    residual: { ...layerOf("residual", method.residual), own: true },
    line: once(() => ({
      x: unpack(method.line.x_mm), y: unpack(method.line.y_mm), t: doubles(method.line.time_s),
      value: floats(method.line.speed_mm_per_s),
    })),
    ranges: once(() => {
      const r = method.ranges, out = { end: doubles(r.end_s) };
      for (const name of ["velocity", "acceleration", "jerk"])
        out[name] = r[name].map((e) => ({ low: unpack(e.low), high: unpack(e.high), step: e.low.scale }));
      return out;
    }),
    dwell: once(() => {
      const d = method.dwell;
      if (!d) return null;
      const planned = floats(d.planned_s), executed = d.executed_s && floats(d.executed_s);
      const x = unpack(d.x_mm), y = unpack(d.y_mm);
      const gap = quantile(x.slice(1).map((v, i) => Math.hypot(v - x[i], y[i + 1] - y[i])), 0.5);
      return { x, y, gap, planned, executed, error: executed && executed.map((v, i) => v - planned[i]) };
    }),
    frames: frames && { time: frames.time_s, values: once(() => unpack(frames.residual_nm)), frame: frames },
    total: doubles(method.ranges.end_s).at(-1),
  };
}

const RUNS = DATA.runs.map((run) => ({
  ...run,
  desired: layerOf("desired removal", run.desired),
  measured: run.measured && layerOf("measured", run.measured),
}));
/** Plan of several tools, whose methods are its tools in the order in which they run; null for any other run. */
const SEVERAL = RUNS.length === 1 ? RUNS[0].summary.several || null : null;
const ENTRIES = RUNS.flatMap((run) => run.methods.map((method) => entryOf(run, method)));

/** What is shown. */
const state = {
  a: 0, b: -1, scale: "apart",
  hand: null,            // nm from the mean at the end of the colours, chosen by hand
  view: null,            // [x low, x high, y low, y high] in mm that the maps show
  pointer: null,         // [x, y] mm under the pointer
  pin: null,             // [x, y] mm of the profiles
  time: 0, timeView: [0, 1], hoverTime: null, playing: false, moving: false,
};
const A = () => ENTRIES[state.a];
const B = () => (state.b < 0 ? null : ENTRIES[state.b]);

/** Value of a layer at a place, with its pixel; null outside. */
function valueAt(layer, x, y) {
  const c = Math.round((x - layer.x0) / layer.dx), r = Math.round((y - layer.y0) / layer.dy);
  if (c < 0 || r < 0 || c >= layer.nx || r >= layer.ny) return null;
  return { row: r, column: c, x: layer.x0 + c * layer.dx, y: layer.y0 + r * layer.dy, value: layer.values()[r * layer.nx + c] };
}

/** residual of a - residual of b, on the pixels of a. */
function differenceOf(a, b) {
  const p = a.residual, q = b.residual;
  const values = once(() => {
    const v = p.values(), w = q.values(), out = new Float64Array(v.length);
    const same = p.nx === q.nx && p.ny === q.ny && p.x0 === q.x0 && p.y0 === q.y0 && p.dx === q.dx && p.dy === q.dy;
    for (let i = 0; i < v.length; i++) {
      if (same) { out[i] = v[i] - w[i]; continue; }
      const at = valueAt(q, p.x0 + (i % p.nx) * p.dx, p.y0 + Math.floor(i / p.nx) * p.dy);
      out[i] = at ? v[i] - at.value : NaN;
    }
    return out;
  });
  const layer = { ...p, title: "difference of the residuals", step: p.step + q.step, values, reach99: undefined };
  let n = 0, sum = 0, low = Infinity, high = -Infinity, squares = 0;
  for (const v of values()) if (!Number.isNaN(v)) { n++; sum += v; low = Math.min(low, v); high = Math.max(high, v); }
  layer.mean = n ? sum / n : 0;
  for (const v of values()) if (!Number.isNaN(v)) squares += (v - layer.mean) ** 2;
  layer.rms = n ? Math.sqrt(squares / n) : 0;
  layer.reach = n ? reachAround(layer.mean, [low, high]) : 1;
  return layer;
}
const differences = new Map();
function difference() {
  const key = state.a + "," + state.b;
  if (!differences.has(key)) differences.set(key, differenceOf(A(), B()));
  return differences.get(key);
}

/** The residual at the last frame that is computed at or before the time; the start is the desired removal. */
function frameAt(entry, time) {
  const f = entry.frames;
  if (!f) return null;
  let i = -1;
  while (i + 1 < f.time.length && f.time[i + 1] <= time * (1 + 1e-9)) i++;
  if (i < 0) return { ...entry.run.desired, title: "residual at 0 s (the start)", key: "start" };
  const { size: [nx, ny], start_mm, step_mm, residual_nm } = f.frame;
  const values = f.values().subarray(i * nx * ny, (i + 1) * nx * ny);
  let n = 0, sum = 0, squares = 0;
  for (const v of values) if (!Number.isNaN(v)) { n++; sum += v; }
  const mean = n ? sum / n : 0;
  for (const v of values) if (!Number.isNaN(v)) squares += (v - mean) ** 2;
  return { title: "residual at " + f.time[i].toFixed(1) + " s", x0: start_mm[0], y0: start_mm[1], dx: step_mm[0], dy: step_mm[1],
    nx, ny, every: 1, mean, rms: n ? Math.sqrt(squares / n) : 0, reach: entry.run.desired.reach, step: residual_nm.scale,
    values: () => values, key: state.a + "/" + i, index: i };
}
