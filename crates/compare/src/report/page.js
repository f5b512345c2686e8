"use strict";
// The report page. Data come from the element #data; everything is drawn on canvas.
// Heights nm, lengths mm, times s.

const DATA = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);

// ------------------------------------------------------------------------------------------------
// Numbers from text

function bytesOf(base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

/** value = offset + scale q; q = -32768 is NaN. */
function unpack(packed) {
  const q = new Int16Array(bytesOf(packed.i16).buffer);
  const values = new Float64Array(q.length);
  for (let i = 0; i < q.length; i++) values[i] = q[i] === -32768 ? NaN : packed.offset + packed.scale * q[i];
  return values;
}

const floats = (base64) => new Float32Array(bytesOf(base64).buffer);
const doubles = (base64) => new Float64Array(bytesOf(base64).buffer);

/** The function, computed once. */
function once(make) {
  let value;
  return () => (value === undefined ? (value = make()) : value);
}

// ------------------------------------------------------------------------------------------------
// Runs and methods

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
    reach: reachAround(map.mean_nm, map.range_nm),
    step: map.height_nm.scale, values: once(() => unpack(map.height_nm)),
  };
}

function entryOf(run, method) {
  const frames = method.frames;
  return {
    run, method,
    label: (DATA.runs.length > 1 ? run.name + " / " : "") + method.name + (method.name === "position" ? " (ideal)" : ""),
    removal: layerOf("predicted removal", method.removal),
    residual: layerOf("residual", method.residual),
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
      const planned = floats(d.planned_s), executed = floats(d.executed_s);
      const x = unpack(d.x_mm), y = unpack(d.y_mm);
      const gap = quantile(x.slice(1).map((v, i) => Math.hypot(v - x[i], y[i + 1] - y[i])), 0.5);
      return { x, y, gap, planned, executed, error: executed.map((v, i) => v - planned[i]) };
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
const ENTRIES = RUNS.flatMap((run) => run.methods.map((method) => entryOf(run, method)));

/** What is shown. */
const state = {
  a: 0, b: -1, scale: "common",
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

// ------------------------------------------------------------------------------------------------
// Colours and numbers for people

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

// ------------------------------------------------------------------------------------------------
// Canvas

/** The context in CSS pixels, cleared. */
function begin(canvas) {
  const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
    canvas.width = Math.round(w * ratio);
    canvas.height = Math.round(h * ratio);
  }
  const ctx = canvas.getContext("2d");
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  ctx.fillStyle = theme.paper;
  ctx.fillRect(0, 0, w, h);
  ctx.font = "12px system-ui, sans-serif";
  return ctx;
}

/** Axes around the box {l, t, w, h}; sx, sy map values to pixels. */
function axes(ctx, box, x, y, labels) {
  ctx.strokeStyle = theme.line;
  ctx.fillStyle = theme.soft;
  ctx.lineWidth = 1;
  ctx.strokeRect(box.l + 0.5, box.t + 0.5, box.w, box.h);
  ctx.beginPath();
  ctx.textAlign = "center";
  for (const v of x.ticks) {
    const p = x.at(v);
    ctx.moveTo(p, box.t + box.h);
    ctx.lineTo(p, box.t + box.h + 4);
    ctx.fillText(short(v), p, box.t + box.h + 16);
  }
  ctx.textAlign = "right";
  for (const v of y.ticks) {
    const p = y.at(v);
    ctx.moveTo(box.l, p);
    ctx.lineTo(box.l - 4, p);
    ctx.fillText(short(v), box.l - 6, p + 4);
  }
  ctx.stroke();
  ctx.fillStyle = theme.ink;
  ctx.textAlign = "center";
  if (labels[0]) ctx.fillText(labels[0], box.l + box.w / 2, box.t + box.h + 31);
  ctx.save();
  ctx.translate(11, box.t + box.h / 2);
  ctx.rotate(-Math.PI / 2);
  if (labels[1]) ctx.fillText(labels[1], 0, 0);
  ctx.restore();
  ctx.textAlign = "left";
}

function linear(low, high, from, to, most) {
  const at = (v) => from + ((v - low) / (high - low)) * (to - from);
  return { at, back: (p) => low + ((p - from) / (to - from)) * (high - low), ticks: ticks(low, high, most) };
}
function logarithmic(low, high, from, to) {
  const at = (v) => from + (Math.log(v / low) / Math.log(high / low)) * (to - from);
  const all = [];
  if (low > 0 && high < Infinity) for (let e = Math.ceil(Math.log10(low)); 10 ** e <= high; e++) all.push(10 ** e);
  const every = Math.max(1, Math.ceil(all.length / (Math.abs(to - from) / 40)));
  return { at, back: (p) => low * (high / low) ** ((p - from) / (to - from)), ticks: all.filter((_, i) => i % every === 0) };
}

/** A button that saves a canvas as PNG. */
function saveButton(canvas, name) {
  const button = document.createElement("button");
  button.type = "button";
  button.className = "screen";
  button.textContent = "PNG";
  button.title = "Save as PNG";
  button.setAttribute("aria-label", "Save " + name + " as PNG");
  button.addEventListener("click", () => canvas.toBlob((blob) => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = name.replace(/[^a-z0-9]+/gi, "-") + ".png";
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }));
  return button;
}

// ------------------------------------------------------------------------------------------------
// Panels in mm: maps, path, dwell. All show the same part of the mirror.

const EXTENT = (() => {
  const of = (l) => [l.x0 - l.dx / 2, l.x0 + (l.nx - 0.5) * l.dx, l.y0 - l.dy / 2, l.y0 + (l.ny - 0.5) * l.dy];
  return RUNS.map((r) => of(r.desired)).reduce((p, q) => [Math.min(p[0], q[0]), Math.max(p[1], q[1]), Math.min(p[2], q[2]), Math.max(p[3], q[3])]);
})();
const around = ([a, b, c, d], rim) => {
  const w = rim * (b - a), h = rim * (d - c);
  return [a - w, b + w, c - h, d + h];
};
const PATH_EXTENT = (() => {
  const all = [...EXTENT];
  for (const e of ENTRIES) {
    const { x_mm, y_mm } = e.method.line;
    const reach = (p) => p.scale * 32767;
    all[0] = Math.min(all[0], x_mm.offset - reach(x_mm)); all[1] = Math.max(all[1], x_mm.offset + reach(x_mm));
    all[2] = Math.min(all[2], y_mm.offset - reach(y_mm)); all[3] = Math.max(all[3], y_mm.offset + reach(y_mm));
  }
  return all;
})();
const WHOLE = around(PATH_EXTENT, 0.02);
state.view = [...WHOLE];
state.pin = [(EXTENT[0] + EXTENT[1]) / 2, (EXTENT[2] + EXTENT[3]) / 2];

const panels = [];

/** One panel; `content()` says what to draw, null hides it. */
class Panel {
  constructor(parent, name, content) {
    this.name = name;
    this.content = content;
    this.figure = document.createElement("figure");
    this.caption = document.createElement("figcaption");
    this.title = document.createElement("span");
    this.canvas = document.createElement("canvas");
    this.canvas.tabIndex = 0;
    this.canvas.dataset.panel = name;
    this.canvas.setAttribute("role", "application");
    this.read = document.createElement("div");
    this.read.className = "read";
    this.caption.append(this.title, saveButton(this.canvas, name));
    this.figure.append(this.caption, this.canvas, this.read);
    byId(parent).append(this.figure);
    this.base = document.createElement("canvas");
    this.image = document.createElement("canvas");
    this.listen();
    panels.push(this);
  }

  /** Where the view is: equal scales, centred. */
  box() {
    const l = 46, t = 4, w = Math.max(20, this.canvas.clientWidth - l - 66), h = this.canvas.clientHeight - t - 36;
    const [x0, x1, y0, y1] = state.view;
    const k = Math.min(w / (x1 - x0), h / (y1 - y0));
    const cx = (x0 + x1) / 2, cy = (y0 + y1) / 2;
    const low = [cx - w / 2 / k, cy - h / 2 / k], high = [cx + w / 2 / k, cy + h / 2 / k];
    return { l, t, w, h, k, low, high, x: linear(low[0], high[0], l, l + w, w / 70), y: linear(low[1], high[1], t + h, t, h / 45) };
  }

  resize() {
    const width = this.canvas.clientWidth - 112;
    const shape = (WHOLE[3] - WHOLE[2]) / (WHOLE[1] - WHOLE[0]);
    this.canvas.style.height = Math.round(Math.min(560, Math.max(90, width * shape)) + 40) + "px";
  }

  draw() {
    const content = this.content();
    this.figure.hidden = !content;
    if (!content) return;
    this.resize();
    this.title.textContent = content.title;
    this.canvas.setAttribute("aria-label", content.title + "; arrows move the pointer, Shift and arrows the map, + and - zoom, 0 shows all, Enter pins the profiles");
    const box = this.box();
    const key = [content.key, state.view, state.moving && content.heavy, this.canvas.clientWidth, this.canvas.clientHeight, theme.paper, state.scale].join("|");
    if (key !== this.baseKey) {
      this.baseKey = key;
      const ctx = begin(this.canvas);
      ctx.fillStyle = theme.field;
      ctx.fillRect(box.l, box.t, box.w, box.h);
      ctx.save();
      ctx.beginPath();
      ctx.rect(box.l, box.t, box.w, box.h);
      ctx.clip();
      content.paint(ctx, box, this);
      ctx.restore();
      axes(ctx, box, box.x, box.y, ["x (mm)", "y (mm)"]);
      colourBar(ctx, box, content);
      this.base.width = this.canvas.width;
      this.base.height = this.canvas.height;
      this.base.getContext("2d").drawImage(this.canvas, 0, 0);
    } else {
      const ctx = this.canvas.getContext("2d");
      ctx.setTransform(1, 0, 0, 1, 0, 0);
      ctx.drawImage(this.base, 0, 0);
      const ratio = window.devicePixelRatio || 1;
      ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    }
    this.overlay(box, content);
  }

  /** Pointer, pin and tool. */
  overlay(box, content) {
    const ctx = this.canvas.getContext("2d");
    ctx.save();
    ctx.beginPath();
    ctx.rect(box.l, box.t, box.w, box.h);
    ctx.clip();
    const cross = ([x, y], colour, size) => {
      const px = box.x.at(x), py = box.y.at(y);
      ctx.strokeStyle = colour;
      ctx.beginPath();
      ctx.moveTo(px - size, py); ctx.lineTo(px + size, py);
      ctx.moveTo(px, py - size); ctx.lineTo(px, py + size);
      ctx.stroke();
    };
    ctx.lineWidth = 1;
    if (content.layer && state.pin) cross(state.pin, "#00000099", 4000);
    for (const place of content.marks || []) {
      ctx.strokeStyle = theme.bad;
      ctx.lineWidth = 2;
      ctx.beginPath();
      ctx.arc(box.x.at(place[0]), box.y.at(place[1]), 6, 0, 7);
      ctx.stroke();
    }
    if (state.pointer) {
      ctx.lineWidth = 3;
      cross(state.pointer, "#ffffffcc", 9);
      ctx.lineWidth = 1;
      cross(state.pointer, "#000000", 9);
    }
    const tool = toolAt(A(), state.hoverTime ?? state.time);
    if (tool && !content.still) {
      const [px, py] = [box.x.at(tool.x), box.y.at(tool.y)];
      ctx.beginPath();
      ctx.arc(px, py, 5, 0, 7);
      ctx.fillStyle = "#ff2bd6";
      ctx.fill();
      ctx.lineWidth = 2;
      ctx.strokeStyle = "#ffffff";
      ctx.stroke();
    }
    ctx.restore();
    this.read.textContent = content.read();
  }

  listen() {
    const canvas = this.canvas;
    const place = (event) => {
      const r = canvas.getBoundingClientRect(), box = this.box();
      return [box.x.back(event.clientX - r.left), box.y.back(event.clientY - r.top)];
    };
    let from = null;
    canvas.addEventListener("pointerdown", (event) => {
      from = { at: place(event), x: event.clientX, y: event.clientY, view: [...state.view], k: this.box().k, moved: false };
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (from && Math.hypot(event.clientX - from.x, event.clientY - from.y) > 4) from.moved = true;
      if (from && from.moved) {
        const dx = (event.clientX - from.x) / from.k, dy = (event.clientY - from.y) / from.k, v = from.view;
        state.view = [v[0] - dx, v[1] - dx, v[2] + dy, v[3] + dy];
        moving();
      } else this.point(place(event));
      redraw();
    });
    canvas.addEventListener("pointerup", (event) => {
      if (from && !from.moved) this.pick(place(event));
      from = null;
      redraw();
    });
    canvas.addEventListener("pointercancel", () => { from = null; });
    canvas.addEventListener("pointerleave", () => { state.pointer = null; state.hoverTime = null; redraw(); });
    canvas.addEventListener("dblclick", showAll);
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas && !event.ctrlKey && !event.metaKey) return;
      event.preventDefault();
      zoom(Math.exp(event.deltaY * 0.0015), place(event));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
      const v = state.view, w = v[1] - v[0], h = v[3] - v[2];
      if (step && event.shiftKey) {
        const [dx, dy] = [step[0] * 0.1 * w, step[1] * 0.1 * h];
        state.view = [v[0] + dx, v[1] + dx, v[2] + dy, v[3] + dy];
        moving();
      } else if (step) {
        const layer = A().residual, at = state.pointer || [(v[0] + v[1]) / 2, (v[2] + v[3]) / 2];
        const many = Math.max(1, Math.round(2 / this.box().k / layer.dx));
        this.point([at[0] + step[0] * many * layer.dx, at[1] + step[1] * many * layer.dy]);
      } else if (event.key === "+" || event.key === "=") zoom(0.7, state.pointer);
      else if (event.key === "-") zoom(1 / 0.7, state.pointer);
      else if (event.key === "0") showAll();
      else if (event.key === "Enter" && state.pointer) this.pick(state.pointer);
      else return;
      event.preventDefault();
      redraw();
    });
  }

  point(at) {
    state.pointer = at;
    const content = this.content();
    if (content && content.point) content.point(at, this.box());
  }

  pick(at) {
    const content = this.content();
    if (content && content.pick) content.pick(at, this.box());
    else state.pin = at;
  }
}

function colourBar(ctx, box, { bar }) {
  if (!bar) return;
  const x = box.l + box.w + 8, n = bar.table.length;
  for (let i = 0; i < n; i++) {
    ctx.fillStyle = css(bar.table[n - 1 - i]);
    ctx.fillRect(x, box.t + (box.h * i) / n, 10, box.h / n + 0.6);
  }
  ctx.fillStyle = theme.ink;
  ctx.textAlign = "left";
  ctx.fillText(short(+bar.range[1].toPrecision(3)), x + 13, box.t + 10);
  ctx.fillText(short(+bar.range[0].toPrecision(3)), x + 13, box.t + box.h);
  ctx.fillText(bar.unit, x + 13, box.t + box.h / 2 + 4);
}

function zoom(factor, about) {
  const v = state.view, [x, y] = about || [(v[0] + v[1]) / 2, (v[2] + v[3]) / 2];
  const size = (v[1] - v[0]) * factor, whole = WHOLE[1] - WHOLE[0];
  if (size > 4 * whole || size < whole * 1e-4) return;
  state.view = [x + (v[0] - x) * factor, x + (v[1] - x) * factor, y + (v[2] - y) * factor, y + (v[3] - y) * factor];
  moving();
  redraw();
}
function showAll() {
  state.view = [...WHOLE];
  redraw();
}

/** While something moves, heavy panels draw a part of their lines; soon after, all. */
let settle = 0;
function moving() {
  state.moving = true;
  clearTimeout(settle);
  settle = setTimeout(() => { state.moving = false; redraw(); }, 160);
}

/** Distance from the mean that gets the last colour. */
function reachOf(layer) {
  if (state.scale === "common" && layer.title !== "difference of the residuals")
    return Math.max(...RUNS.map((r) => r.desired.reach));
  if (state.scale === "own99") {
    if (layer.reach99 === undefined) {
      const sizes = Float64Array.from(layer.values()).filter((v) => !Number.isNaN(v)).map((v) => Math.abs(v - layer.mean)).sort();
      layer.reach99 = (sizes.length && sizes[Math.floor(0.99 * (sizes.length - 1))]) || layer.reach;
    }
    return layer.reach99;
  }
  return layer.reach;
}

/** The layer in colours, on the panel's own canvas; drawn anew when layer or scale change. */
function imageOf(panel, layer, key) {
  const reach = reachOf(layer), imageKey = key + "|" + reach + "|" + layer.nx;
  if (panel.imageKey !== imageKey) {
    panel.imageKey = imageKey;
    panel.image.width = layer.nx;
    panel.image.height = layer.ny;
    const ctx = panel.image.getContext("2d"), data = ctx.createImageData(layer.nx, layer.ny);
    const out = new Uint32Array(data.data.buffer), values = layer.values();
    const table = HEIGHT.map(([r, g, b]) => (255 << 24) | (b << 16) | (g << 8) | r);
    for (let r = 0; r < layer.ny; r++)
      for (let c = 0, i = r * layer.nx, o = (layer.ny - 1 - r) * layer.nx; c < layer.nx; c++, i++, o++) {
        const v = values[i];
        if (v === v) out[o] = table[Math.max(0, Math.min(254, Math.round(127 + (127 * (v - layer.mean)) / reach)))];
      }
    ctx.putImageData(data, 0, 0);
  }
  return panel.image;
}

function mapContent(layer, key, more = {}) {
  if (!layer) return null;
  const reach = reachOf(layer);
  return {
    title: more.title || layer.title, layer, key: key + "|" + reach + "|" + layer.nx,
    bar: { table: HEIGHT.filter((_, i) => i % 4 === 0), range: [-reach, reach], unit: "nm" },
    paint(ctx, box, panel) {
      const image = imageOf(panel, layer, key);
      const left = box.x.at(layer.x0 - layer.dx / 2), top = box.y.at(layer.y0 + (layer.ny - 0.5) * layer.dy);
      ctx.imageSmoothingEnabled = layer.dx * box.k < 1;
      ctx.drawImage(image, left, top, layer.nx * layer.dx * box.k, layer.ny * layer.dy * box.k);
    },
    read() {
      const at = state.pointer && valueAt(layer, ...state.pointer);
      if (!at) return `RMS ${number(layer.rms)} nm`;
      const value = Number.isNaN(at.value) ? "invalid" : `${number(at.value, 6)} nm (${number(at.value - layer.mean, 4)} from the mean)`;
      return `x ${number(at.x, 5)}, y ${number(at.y, 5)} mm, [${at.row}, ${at.column}]: ${value}`;
    },
  };
}

// ------------------------------------------------------------------------------------------------
// Path and dwell

/** Index of the last element that is at most v; `values` ascend. */
function lastAtMost(values, v) {
  let low = 0, high = values.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (values[middle] <= v) low = middle + 1; else high = middle;
  }
  return low - 1;
}

function toolAt(entry, time) {
  const l = entry.line(), i = Math.max(0, Math.min(l.t.length - 2, lastAtMost(l.t, time)));
  if (l.t.length < 2) return null;
  const d = l.t[i + 1] - l.t[i], u = d > 0 ? Math.max(0, Math.min(1, (time - l.t[i]) / d)) : 0;
  return { x: l.x[i] + u * (l.x[i + 1] - l.x[i]), y: l.y[i] + u * (l.y[i + 1] - l.y[i]), speed: l.value[i + 1] };
}

/** The value below which this fraction of the values is. */
function quantile(values, fraction) {
  const sorted = Float64Array.from(values).filter((v) => !Number.isNaN(v)).sort();
  return sorted.length ? sorted[Math.round(fraction * (sorted.length - 1))] : 1;
}
function nearest(points, [x, y]) {
  let best = -1, least = Infinity;
  for (let i = 0; i < points.x.length; i++) {
    const d = (points.x[i] - x) ** 2 + (points.y[i] - y) ** 2;
    if (d < least) { least = d; best = i; }
  }
  return { index: best, distance: Math.sqrt(least) };
}
const MOVING_POINTS = 12000;

function pathContent(entry) {
  if (!entry) return null;
  const l = entry.line();
  entry.top = entry.top ?? (quantile(l.value, 0.99) || 1);
  const top = entry.top, n = SPEED.length;
  const near = (at, box) => {
    const found = nearest(l, at);
    return found.distance * box.k < 25 ? found.index : -1;
  };
  return {
    title: "path, speed: " + entry.label, key: "path" + entry.label, heavy: l.x.length > MOVING_POINTS,
    still: entry !== A(),
    bar: { table: SPEED, range: [0, top], unit: "mm/s" },
    marks: entry.marks ?? (entry.marks = worstPlaces(entry)),
    paint(ctx, box) {
      // Lines of one colour in one stroke; only what can be seen.
      const every = state.moving ? Math.ceil(l.x.length / MOVING_POINTS) : 1;
      const bins = Array.from({ length: n + 1 }, () => new Path2D());
      const used = new Array(n + 1).fill(false);
      const [lx, ly] = box.low, [hx, hy] = box.high;
      let px = l.x[0], py = l.y[0];
      for (let i = every; i < l.x.length; i += every) {
        const x = l.x[i], y = l.y[i];
        if (!((px < lx && x < lx) || (px > hx && x > hx) || (py < ly && y < ly) || (py > hy && y > hy))) {
          const v = l.value[i], bin = v === v ? Math.min(n - 1, Math.floor((v / top) * n)) : n;
          bins[bin].moveTo(box.x.at(px), box.y.at(py));
          bins[bin].lineTo(box.x.at(x), box.y.at(y));
          used[bin] = true;
        }
        px = x; py = y;
      }
      ctx.lineCap = "round";
      for (let i = n; i >= 0; i--) {
        if (!used[i]) continue;
        ctx.lineWidth = i === n ? 0.5 : Math.min(3, Math.max(1, box.k * 0.12));
        ctx.strokeStyle = i === n ? theme.soft : css(SPEED[i]);
        ctx.stroke(bins[i]);
      }
    },
    point(at, box) {
      const i = near(at, box);
      state.hoverTime = i >= 0 && entry === A() ? l.t[i] : null;
    },
    pick(at, box) {
      const i = near(at, box);
      if (i >= 0 && entry === A()) setTime(l.t[i]);
    },
    read() {
      const time = state.hoverTime ?? state.time, tool = toolAt(entry, time);
      const jump = Number.isNaN(tool.speed) ? "jump" : number(tool.speed, 4) + " mm/s";
      return `t ${number(time, 6)} s: x ${number(tool.x, 5)}, y ${number(tool.y, 5)} mm, ${jump}; 99 % are below ${number(top, 3)} mm/s`;
    },
  };
}

function worstPlaces(entry) {
  const { steps, ...checks } = entry.method.limits;
  const times = [...Object.values(checks).flat().flatMap((check) => check.worst.map((w) => w[0])), ...steps];
  return times.map((t) => toolAt(entry, t)).map((p) => [p.x, p.y]);
}

function dwellContent(entry, kind) {
  const d = entry && entry.dwell();
  if (!d) return null;
  const values = d[kind], error = kind === "error";
  const table = error ? HEIGHT_BINS : SPEED, n = table.length;
  const reach = error ? Math.max(1e-6, values.reduce((m, v) => Math.max(m, Math.abs(v)), 0)) : Math.max(1e-9, quantile(values, 0.99));
  const range = error ? [-reach, reach] : [0, reach];
  return {
    title: (error ? "executed - planned time: " : "planned dwell time: ") + entry.label,
    key: "dwell" + kind + entry.label, heavy: values.length > MOVING_POINTS, still: entry !== A(),
    bar: { table, range, unit: "s" },
    paint(ctx, box) {
      const every = state.moving ? Math.ceil(values.length / MOVING_POINTS) : 1;
      const area = (WHOLE[1] - WHOLE[0]) * (WHOLE[3] - WHOLE[2]);
      // As large as its fraction of the picture, and no gap to the next one on the path.
      const side_mm = Math.max(Math.sqrt((0.7 * area) / values.length), 1.1 * d.gap);
      const side = Math.max(1.5, Math.min(24, box.k * side_mm));
      const bins = Array.from({ length: n }, () => []);
      for (let i = 0; i < values.length; i += every) {
        const px = box.x.at(d.x[i]), py = box.y.at(d.y[i]);
        if (px < box.l - side || px > box.l + box.w + side || py < box.t - side || py > box.t + box.h + side) continue;
        bins[Math.max(0, Math.min(n - 1, Math.floor(((values[i] - range[0]) / (range[1] - range[0])) * n)))].push(px, py);
      }
      bins.forEach((bin, k) => {
        ctx.fillStyle = css(table[k]);
        for (let j = 0; j < bin.length; j += 2) ctx.fillRect(bin[j] - side / 2, bin[j + 1] - side / 2, side, side);
      });
    },
    read() {
      if (!state.pointer) return `${d.x.length} points`;
      const i = nearest(d, state.pointer).index;
      return `point ${i * entry.method.dwell.every}: planned ${number(d.planned[i], 5)} s, executed ${number(d.executed[i], 5)} s, difference ${number(d.error[i], 3)} s`;
    },
  };
}

// ------------------------------------------------------------------------------------------------
// Charts

function chartBox(canvas) {
  return { l: 66, t: 18, w: Math.max(30, canvas.clientWidth - 66 - 14), h: canvas.clientHeight - 18 - 38 };
}
function clipped(ctx, box, draw) {
  ctx.save();
  ctx.beginPath();
  ctx.rect(box.l, box.t, box.w, box.h);
  ctx.clip();
  draw();
  ctx.restore();
}
function legend(ctx, box, entries) {
  ctx.textAlign = "left";
  ctx.save();
  const total = entries.reduce((sum, [name]) => sum + 30 + ctx.measureText(name).width, 0);
  if (total > box.w) ctx.font = "10px system-ui, sans-serif";
  let x = total > box.w ? 2 : box.l + 4;
  for (const [name, colour] of entries) {
    ctx.fillStyle = colour;
    ctx.fillRect(x, box.t - 12, 14, 4);
    ctx.fillStyle = theme.ink;
    ctx.fillText(name, x + 18, box.t - 6);
    x += (total > box.w ? 23 : 30) + ctx.measureText(name).width;
  }
  ctx.restore();
}
function curve(ctx, x, y, points, colour, width = 1.5) {
  ctx.beginPath();
  let down = false;
  for (const [u, v] of points) {
    if (!(v === v)) { down = false; continue; }
    if (down) ctx.lineTo(x.at(u), y.at(v)); else ctx.moveTo(x.at(u), y.at(v));
    down = true;
  }
  ctx.strokeStyle = colour;
  ctx.lineWidth = width;
  ctx.stroke();
}

/** Heights along a row (axis 0) or a column (axis 1) through the pin. */
function profile(layer, axis) {
  const at = valueAt(layer, ...state.pin), values = layer.values();
  if (!at) return [];
  return axis === 0
    ? Array.from({ length: layer.nx }, (_, c) => [layer.x0 + c * layer.dx, values[at.row * layer.nx + c]])
    : Array.from({ length: layer.ny }, (_, r) => [layer.y0 + r * layer.dy, values[r * layer.nx + at.column]]);
}
function drawProfiles() {
  byId("pin").textContent = `x ${number(state.pin[0], 5)} mm, y ${number(state.pin[1], 5)} mm`;
  for (const axis of [0, 1]) {
    const canvas = byId(["profile-x", "profile-y"][axis]), ctx = begin(canvas), box = chartBox(canvas);
    const wanted = [[A().run.desired, "desired"], [A().removal, "removal"], [A().residual, "residual"]];
    if (B()) wanted.push([B().residual, "residual, " + B().label]);
    const colours = LINES();
    const series = wanted.map(([layer, name], i) => ({ name, colour: colours[i], points: profile(layer, axis).map(([u, v]) => [u, v - layer.mean]) }));
    const all = series.flatMap((s) => s.points.map((p) => p[1])).filter((v) => v === v);
    const low = all.length ? Math.min(...all) : -1, high = all.length ? Math.max(...all) : 1, rim = 0.05 * (high - low) || 1;
    const [from, to] = axis === 0 ? [state.view[0], state.view[1]] : [state.view[2], state.view[3]];
    const x = linear(from, to, box.l, box.l + box.w, box.w / 70), y = linear(low - rim, high + rim, box.t + box.h, box.t, 5);
    clipped(ctx, box, () => {
      for (const s of series) curve(ctx, x, y, s.points, s.colour);
      curve(ctx, x, y, [[state.pin[axis], low - rim], [state.pin[axis], high + rim]], theme.line, 1);
    });
    axes(ctx, box, x, y, [["x (mm)", "y (mm)"][axis], "from the mean (nm)"]);
    legend(ctx, box, series.map((s) => [s.name, s.colour]));
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", "Profile along " + ["x", "y"][axis]);
  }
}

const CHARTS = [["velocity", "velocity (mm/s)"], ["acceleration", "acceleration (mm/s²)"], ["jerk", "jerk (mm/s³)"]];

/** Smallest and largest value in each column of pixels. */
function columnsOf(end, e, [from, to], width) {
  const low = new Float64Array(width).fill(Infinity), high = new Float64Array(width).fill(-Infinity);
  const first = Math.max(0, lastAtMost(end, from) + 1);
  let start = first > 0 ? end[first - 1] : 0;
  for (let i = first; i < end.length && start < to; i++) {
    const a = Math.max(0, Math.floor(((start - from) / (to - from)) * width));
    const b = Math.min(width - 1, Math.floor(((end[i] - from) / (to - from)) * width));
    for (let c = a; c <= b; c++) {
      if (e.low[i] < low[c]) low[c] = e.low[i];
      if (e.high[i] > high[c]) high[c] = e.high[i];
    }
    start = end[i];
  }
  return { low, high };
}

/** Over a limit by more than the rounding of the page and of the verdict. */
const beyond = (v, limit, step) => Math.abs(v) > limit * (1 + 1e-6) + step;

function drawMotion() {
  const entry = A(), other = B();
  for (const [name, label] of CHARTS) {
    const canvas = byId(name), ctx = begin(canvas), box = chartBox(canvas);
    const ranges = entry.ranges(), limits = entry.method.limits[name];
    const of = (e) => e.ranges()[name].map((r) => Math.max(...[r.low, r.high].map((v) => v.reduce((m, q) => Math.max(m, Math.abs(q)), 0))));
    entry.peaks = entry.peaks || {};
    const peaks = (entry.peaks[name] = entry.peaks[name] || of(entry));
    let reach = Math.max(...peaks) || 1;
    const notes = [];
    limits.forEach((check, axis) => {
      const l = check.limit;
      if (l === null || l === undefined) return;
      const axisName = ["x", "y"][axis];
      if (l <= 3 * Math.max(...peaks)) notes.push([l, axis]);
      else notes.push(`${axisName} limit ${short(l)}`);
    });
    for (const note of notes) if (Array.isArray(note)) reach = Math.max(reach, note[0]);
    const x = linear(...state.timeView, box.l, box.l + box.w, box.w / 80), y = linear(-1.08 * reach, 1.08 * reach, box.t + box.h, box.t, 5);
    const width = Math.max(1, Math.round(box.w));
    clipped(ctx, box, () => {
      const zero = y.at(0);
      ctx.fillStyle = theme.line;
      ctx.fillRect(box.l, zero, box.w, 1);
      const band = (e, axis, colour, alpha) => {
        const { low, high } = columnsOf(e.ranges().end, e.ranges()[name][axis], state.timeView, width);
        ctx.globalAlpha = alpha;
        ctx.fillStyle = colour;
        for (let c = 0; c < width; c++) {
          if (!(low[c] <= high[c])) continue;
          const top = y.at(high[c]), height = Math.max(1.2, y.at(low[c]) - top);
          ctx.fillRect(box.l + (c * box.w) / width, top, box.w / width + 0.3, height);
        }
        ctx.globalAlpha = 1;
        return { low, high };
      };
      if (other) for (const axis of [0, 1]) band(other, axis, theme.soft, 0.45);
      [0, 1].forEach((axis) => {
        const { low, high } = band(entry, axis, axis ? theme.y : theme.x, 0.7);
        const limit = limits[axis].limit, step = ranges[name][axis].step;
        if (limit === null || limit === undefined) return;
        ctx.fillStyle = theme.bad;
        for (let c = 0; c < width; c++)
          if (low[c] <= high[c] && (beyond(low[c], limit, step) || beyond(high[c], limit, step)))
            ctx.fillRect(box.l + (c * box.w) / width - 1, box.t, 3, 7);
      });
      for (const note of notes) {
        if (!Array.isArray(note)) continue;
        ctx.setLineDash([7, 4]);
        for (const sign of [-1, 1])
          curve(ctx, x, y, state.timeView.map((t) => [t, sign * note[0]]), note[1] ? theme.y : theme.x, 1.2);
        ctx.setLineDash([]);
      }
      const marked = [...limits.flatMap((check) => check.worst.map((w) => w[0])), ...(name === "velocity" ? entry.method.limits.steps : [])];
      for (const t of marked) {
        ctx.fillStyle = theme.bad;
        ctx.beginPath();
        ctx.arc(x.at(t), box.t + 10, 4, 0, 7);
        ctx.fill();
      }
      const time = state.hoverTime ?? state.time;
      curve(ctx, x, y, [[time, -2 * reach], [time, 2 * reach]], "#ff2bd6", 1.5);
    });
    const far = notes.filter((n) => !Array.isArray(n));
    axes(ctx, box, x, y, [far.length ? `time (s); ${far.join(", ")} beyond the axis` : "time (s)", label]);
    const i = Math.min(ranges.end.length - 1, Math.max(0, lastAtMost(ranges.end, state.hoverTime ?? state.time) + 1));
    const range = ranges[name].map((r, axis) => `${["x", "y"][axis]} ${[r.low[i], r.high[i]].map((v) => number(Math.abs(v) < r.step ? 0 : v, 3)).join(" to ")}`);
    legend(ctx, box, [[range[0], theme.x], [range[1], theme.y], ...(other ? [[other.label, theme.soft]] : [])]);
    canvas.setAttribute("aria-label", label + " against time; arrows move the time, + and - zoom, 0 shows all");
  }
}

function listenToChart(canvas) {
  canvas.tabIndex = 0;
  canvas.setAttribute("role", "application");
  const scale = () => {
    const box = chartBox(canvas);
    return linear(...state.timeView, box.l, box.l + box.w, 5);
  };
  const timeOf = (event) => scale().back(event.clientX - canvas.getBoundingClientRect().left);
  let from = null;
  canvas.addEventListener("pointerdown", (event) => {
    from = { x: event.clientX, view: [...state.timeView], moved: false };
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (from && Math.abs(event.clientX - from.x) > 4) from.moved = true;
    if (from && from.moved) {
      const shift = ((event.clientX - from.x) / chartBox(canvas).w) * (from.view[1] - from.view[0]);
      setTimeView([from.view[0] - shift, from.view[1] - shift]);
    } else state.hoverTime = Math.max(0, Math.min(A().total, timeOf(event)));
    redraw();
  });
  canvas.addEventListener("pointerup", (event) => {
    if (from && !from.moved) setTime(timeOf(event));
    from = null;
  });
  canvas.addEventListener("pointercancel", () => { from = null; });
  canvas.addEventListener("pointerleave", () => { state.hoverTime = null; redraw(); });
  canvas.addEventListener("dblclick", () => { setTimeView([0, A().total]); redraw(); });
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas && !event.ctrlKey && !event.metaKey) return;
    event.preventDefault();
    zoomTime(Math.exp(event.deltaY * 0.0015), timeOf(event));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const width = state.timeView[1] - state.timeView[0];
    if (event.key === "ArrowLeft") setTime(state.time - width / 100);
    else if (event.key === "ArrowRight") setTime(state.time + width / 100);
    else if (event.key === "+" || event.key === "=") zoomTime(0.7, state.time);
    else if (event.key === "-") zoomTime(1 / 0.7, state.time);
    else if (event.key === "0") { setTimeView([0, A().total]); redraw(); }
    else return;
    event.preventDefault();
  });
}
function setTimeView([low, high]) {
  const width = Math.min(high - low, A().total), from = Math.max(0, Math.min(A().total - width, low));
  state.timeView = [from, from + width];
}
function zoomTime(factor, about) {
  const [low, high] = state.timeView;
  if ((high - low) * factor < A().total * 1e-5) return;
  setTimeView([about + (low - about) * factor, about + (high - about) * factor]);
  redraw();
}

function drawHistogram() {
  const canvas = byId("histogram"), ctx = begin(canvas), box = chartBox(canvas), colours = LINES();
  const series = [["before", A().run.histogram], [A().label, A().method.histogram]];
  if (B()) series.push([B().label, B().method.histogram]);
  const top = Math.max(...series.flatMap(([, h]) => h.density_per_nm)), low = top * 1e-5;
  const reach = Math.max(...series.map(([, h]) => -h.low_nm));
  const x = linear(-reach, reach, box.l, box.l + box.w, box.w / 70), y = logarithmic(low, top * 2, box.t + box.h, box.t);
  clipped(ctx, box, () => series.forEach(([, h], i) =>
    curve(ctx, x, y, h.density_per_nm.map((v, k) => [h.low_nm + (k + 0.5) * h.width_nm, Math.max(v, low)]), colours[i])));
  axes(ctx, box, x, y, ["height from the mean (nm)", "share of pixels (1/nm)"]);
  legend(ctx, box, series.map(([name], i) => [name, colours[i]]));
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", "Histogram of the heights before and after");
}

function drawSpectrum() {
  const canvas = byId("spectrum"), ctx = begin(canvas), box = chartBox(canvas), colours = LINES();
  const series = [["before", A().run.spectrum], [A().label, A().method.spectrum]];
  if (B()) series.push([B().label, B().method.spectrum]);
  const f = series.flatMap(([, s]) => s.frequency_per_mm), p = series.flatMap(([, s]) => s.psd_nm2_mm2).filter((v) => v > 0);
  const high = p.length ? Math.max(...p) * 2 : 1, low = Math.max(p.length ? Math.min(...p) : 0.1, high * 1e-10);
  const x = logarithmic(Math.min(...f), Math.max(...f) * 1.0001, box.l, box.l + box.w), y = logarithmic(low, high, box.t + box.h, box.t);
  clipped(ctx, box, () => {
    for (const period of DATA.band_period_mm) {
      ctx.setLineDash([3, 3]);
      curve(ctx, x, y, [[1 / period, low], [1 / period, high]], theme.soft, 1);
      ctx.setLineDash([]);
      ctx.fillStyle = theme.soft;
      ctx.fillText(period + " mm", x.at(1 / period) + 4, box.t + box.h - 6);
    }
    series.forEach(([, s], i) => curve(ctx, x, y, s.frequency_per_mm.map((v, k) => [v, Math.max(s.psd_nm2_mm2[k], low)]), colours[i]));
  });
  axes(ctx, box, x, y, ["spatial frequency (1/mm)", "PSD (nm² mm²)"]);
  legend(ctx, box, series.map(([name], i) => [name, colours[i]]));
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", "Power spectral density before and after");
}

function drawRounds() {
  const rounds = A().method.rounds || (B() && B().method.rounds);
  byId("rounds-section").hidden = !rounds;
  if (!rounds) return;
  const canvas = byId("rounds"), ctx = begin(canvas), box = chartBox(canvas);
  const n = rounds.rms_nm.length, top = Math.max(...rounds.rms_nm) * 1.1;
  const x = linear(-0.3, Math.max(n - 0.7, 0.7), box.l, box.l + box.w, Math.min(n, 12)), y = linear(0, top, box.t + box.h, box.t, 5);
  x.ticks = x.ticks.filter((v) => Number.isInteger(v));
  const points = rounds.rms_nm.map((v, i) => [i, v]);
  curve(ctx, x, y, points, theme.x);
  points.forEach(([i, v]) => {
    ctx.beginPath();
    ctx.arc(x.at(i), y.at(v), 4, 0, 7);
    ctx.fillStyle = rounds.best === i ? theme.x : theme.paper;
    ctx.fill();
    ctx.stroke();
    ctx.fillStyle = theme.soft;
    ctx.textAlign = "center";
    ctx.fillText(`${number(rounds.total_time_s[i], 5)} s`, x.at(i), y.at(v) + 18);
  });
  axes(ctx, box, x, y, ["round (the full dot is kept)", "executed RMS (nm)"]);
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", "RMS of the executed residual in every round: " + rounds.rms_nm.map((v) => number(v)).join(", ") + " nm");
}

// ------------------------------------------------------------------------------------------------
// Tables and text

function element(name, text, attributes = {}) {
  const e = document.createElement(name);
  if (text !== undefined) e.textContent = text;
  for (const [key, value] of Object.entries(attributes)) e.setAttribute(key, value);
  return e;
}

const ROWS = [
  ["RMS (nm)", "rms_nm", 4], ["RMS, plane removed (nm)", "rms_detilted_nm", 4], ["PV (nm)", "pv_nm", 3],
  ["time (s)", "total_time_s", 2],
  ["largest velocity x, y (mm/s)", "max_velocity_mm_per_s", 2],
  ["largest acceleration x, y (mm/s²)", "max_acceleration_mm_per_s2", 1],
  ["largest velocity step x, y (mm/s)", "max_velocity_step_mm_per_s", 3],
  ["largest acceleration step x, y (mm/s²)", "max_acceleration_step_mm_per_s2", 1],
  ["largest jerk x, y (mm/s³)", "max_jerk_mm_per_s3", 0],
  ["dwell error, RMS (s)", "dwell_error_rms_s", 6], ["dwell error, worst (s)", "dwell_error_worst_s", 6],
  ["points with overshoot x, y", "overshoot_points", 0], ["largest overshoot x, y (mm)", "max_overshoot_mm", 6],
  ["limits of the machine", "limits_respected"],
  ["plan", "plan"],
  ["schedule (s of computing)", "schedule_wall_s", 3], ["simulate (s of computing)", "simulate_wall_s", 3],
];

function fillSummary() {
  const table = byId("summary"), head = element("tr");
  head.append(element("th", "", { scope: "col" }));
  for (const e of ENTRIES) head.append(element("th", e.label, { scope: "col" }));
  table.append(element("thead"), element("tbody"));
  table.tHead.append(head);
  const numbers = ENTRIES.map((e) => e.run.summary.methods[e.method.name]).map((m) => ({ ...m, ...m.execution }));
  const kept = numbers.map((m) => m.limits_respected && m.plan.state !== "ideal");
  const rated = kept.some(Boolean) ? kept : kept.map(() => true);
  for (const [title, key, decimals] of ROWS) {
    const row = element("tr"), values = numbers.map((m) => m[key]);
    row.append(element("th", title, { scope: "row" }));
    const inWords = { limits_respected: (v) => (v ? "kept" : "exceeded"), plan: (v) => v.word }[key];
    // Equal where the digits shown are: a step of 1e-13 is none.
    const size = (v) => +Math.max(...[v].flat().map(Math.abs)).toFixed(decimals);
    const counts = (i) => values[i] !== null && (key.endsWith("wall_s") || rated[i]);
    const best = inWords ? null : Math.min(...values.filter((_, i) => counts(i)).map(size));
    values.forEach((v, i) => {
      const one = (u) => (u === null ? "-" : fixed(u, decimals));
      const text = inWords ? inWords(v) : [v].flat().map(one).join(", ");
      const exact = inWords ? v.text || text : [v].flat().map((u) => (u === null ? "-" : +u.toPrecision(9))).join(", ");
      const cell = element("td", text, { "data-key": key, "data-entry": i, "data-value": JSON.stringify(v), title: exact });
      if (key === "limits_respected" ? !v : key === "plan" && v.state === "unconverged") cell.className = "bad";
      else if (!inWords && ENTRIES.length > 1 && counts(i) && size(v) === best) cell.className = "best";
      row.append(cell);
    });
    table.tBodies[0].append(row);
  }
  byId("heading").textContent = RUNS.map((r) => {
    const s = r.summary, ideal = s.ideal ? `; dwell at the dwell points alone would leave ${number(s.ideal.rms_nm)} nm RMS in ${fixed(s.ideal.total_time_s, 1)} s` : "";
    const name = [r.name, s.pipeline, s.fixture].filter((n, i, all) => n && all.indexOf(n) === i).join(", ");
    return `${name}: ${number(s.initial.rms_nm)} nm RMS, ${number(s.initial.pv_nm)} nm PV before${ideal}; best within the limits: ${r.best || "none"}`;
  }).join(". ") + ".";
  for (const r of RUNS) {
    const whose = (name) => (RUNS.length > 1 ? r.name + " / " + name : name);
    const note = (text, bad) => byId("notes").append(element("p", text, { class: bad ? "violation" : "note" }));
    for (const left of r.summary.left_out) {
      const bad = left.standing === "not-valid";
      note(`${whose(left.name)}: ${bad ? "not valid" : "out of date, left out"}: ${left.reasons.join("; ")}`, bad);
    }
    for (const text of r.summary.remarks) note(RUNS.length > 1 ? `${r.name}: ${text}` : text, true);
    // Methods of which the same is said share a line.
    const said = new Map();
    for (const [name, m] of Object.entries(r.summary.methods))
      for (const text of [`${m.plan.word}: ${m.plan.text}`, ...m.remarks]) {
        const bad = m.plan.state === "unconverged" && text.startsWith(m.plan.word);
        if (!said.has(text)) said.set(text, { names: [], bad });
        said.get(text).names.push(whose(name));
      }
    for (const [text, { names, bad }] of said) note(`${names.join(", ")}: ${text}`, bad);
  }
  for (const e of ENTRIES) for (const text of e.method.violations)
    byId("violations").append(element("p", `${e.label}: ${text}`, { class: "violation" }));
}

function fillBands() {
  const table = byId("bands");
  table.replaceChildren();
  const [long, short_] = DATA.band_period_mm;
  const head = element("tr"), names = ["RMS by period", `above ${long} mm (nm)`, `${short_} to ${long} mm (nm)`, `below ${short_} mm (nm)`];
  names.forEach((n) => head.append(element("th", n)));
  table.append(head);
  const rows = [["before", A().run.spectrum], [A().label, A().method.spectrum]];
  if (B()) rows.push([B().label, B().method.spectrum]);
  for (const [name, s] of rows) {
    const row = element("tr");
    row.append(element("th", name), ...s.band_rms_nm.map((v) => element("td", number(v))));
    table.append(row);
  }
}

function fillProvenance() {
  const parent = byId("provenance");
  const show = (owner, list) => {
    for (const p of list) {
      const details = element("details"), head = element("summary");
      head.append(element("strong", `${owner}${p.role} `), element("span", `${p.tool} ${p.tool_version} ${p.method}${p.status ? ", " + p.status : ""}`));
      const inputs = (p.inputs || []).map((i) => `${i.role}  ${i.path}  ${i.kind}  blake3 ${i.blake3}`).join("\n");
      details.append(head, element("pre", p.command), element("pre", "settings " + JSON.stringify(p.settings, null, 1)));
      if (inputs) details.append(element("pre", inputs));
      parent.append(details);
    }
  };
  for (const r of RUNS) {
    const prefix = RUNS.length > 1 ? r.name + " / " : "";
    show(prefix, r.provenance);
    for (const m of r.methods) show(prefix + m.name + " / ", m.provenance);
  }
  const list = byId("contents");
  const map = ENTRIES.length ? A().residual : null;
  const add = (text) => list.append(element("li", text));
  for (const r of map ? RUNS : []) {
    const l = r.desired, size = `${l.nx} x ${l.ny}`;
    const how = l.every === 1 ? "every pixel of the arrays" : `means over ${l.every} x ${l.every} pixels of the arrays`;
    add(`${RUNS.length > 1 ? r.name + ": " : ""}maps of ${size} pixels, ${how}, in steps of ${number(l.step, 2)} nm (desired removal) and ${number(map.step, 2)} nm (residual); RMS, PV, histogram and spectrum are of the whole arrays`);
  }
  for (const e of ENTRIES) {
    const m = e.method, each = (n, what) => (n > 1 ? `every ${n} ${what} together` : `every one of the ${what}`);
    const f = m.frames ? `, ${m.frames.time_s.length} frames of ${m.frames.size.join(" x ")} pixels` : "";
    add(`${e.label}: line with ${each(m.line.every, "segments")}, ranges of ${each(m.ranges.every, "segments")} (no peak is lost)${m.dwell ? `, ${m.dwell.every > 1 ? "one in " + m.dwell.every : "all"} dwell points` : ""}${f}`);
  }
}

// ------------------------------------------------------------------------------------------------
// Full values

/** An array of 64-bit floats from the bytes of a .npy file. */
function parseNpy(buffer) {
  const bytes = new Uint8Array(buffer), long = bytes[6] > 1;
  const view = new DataView(buffer), length = long ? view.getUint32(8, true) : view.getUint16(8, true), start = long ? 12 : 10;
  const header = new TextDecoder("latin1").decode(bytes.subarray(start, start + length));
  const shape = /'shape': \((\d+), (\d+)\)/.exec(header);
  if (bytes[0] !== 0x93 || !header.includes("'<f8'") || !header.includes("'fortran_order': False") || !shape) return null;
  return { ny: +shape[1], nx: +shape[2], values: new Float64Array(buffer.slice(start + length)) };
}
async function loadFull(file) {
  const layer = { "removal_nm.npy": A().removal, "residual_nm.npy": A().residual, "height_nm.npy": A().run.desired }[file.name];
  const array = parseNpy(await file.arrayBuffer());
  const k = layer && layer.every;
  const fits = layer && array && Math.ceil(array.nx / k) === layer.nx && Math.ceil(array.ny / k) === layer.ny;
  if (!fits) {
    byId("loaded").textContent = `${file.name}: is not a map of this method with its ${layer ? `${layer.nx * layer.every} x ${layer.ny * layer.every} pixels or a little less` : "usual name"}.`;
    return;
  }
  Object.assign(layer, { x0: layer.x0 - ((k - 1) / 2) * (layer.dx / k), y0: layer.y0 - ((k - 1) / 2) * (layer.dy / k), dx: layer.dx / k, dy: layer.dy / k,
    nx: array.nx, ny: array.ny, every: 1, step: 0, reach99: undefined, values: () => array.values });
  differences.clear();
  byId("loaded").textContent = `${layer.title} of ${A().label}: all ${array.nx} x ${array.ny} values of ${file.name}.`;
  for (const p of panels) { p.baseKey = null; p.imageKey = null; }
  redraw();
}

// ------------------------------------------------------------------------------------------------
// All together

function setTime(t) {
  state.time = Math.max(0, Math.min(A().total, t));
  byId("time").value = Math.round((1000 * state.time) / A().total);
  redraw();
}
function showMethod(a, b) {
  state.a = a;
  state.b = b === a ? -1 : b;
  byId("a").value = a;
  byId("b").value = state.b;
  state.timeView = [0, A().total];
  for (const option of byId("b").options) option.disabled = +option.value === a;
  byId("frame-note").textContent = A().frames
    ? `The surface is the one simulated at the last of ${A().frames.time.length} times before the slider.`
    : "No frames for this method: planish-simulate --frames N writes them to methods/<method>/frames; the tool moves all the same.";
  const d = A().method.dwell;
  byId("dwell-section").hidden = !d;
  if (d) byId("dwell-note").textContent = `Time at every dwell point as planned, and what the motion takes there instead; differences add up to ${number(d.total_error_s)} s.`;
  fillBands();
  setTime(A().total);
}

let asked = false;
function redraw() {
  if (asked) return;
  asked = true;
  requestAnimationFrame(() => {
    asked = false;
    drawAll();
  });
}
function drawAll() {
  for (const p of panels) p.draw();
  drawProfiles();
  drawMotion();
  if (drawAll.key !== [state.a, state.b, theme.paper, innerWidth].join()) {
    drawAll.key = [state.a, state.b, theme.paper, innerWidth].join();
    drawHistogram();
    drawSpectrum();
    drawRounds();
  }
  const tool = toolAt(A(), state.time);
  byId("now").textContent = `${fixed(state.time, 2)} of ${fixed(A().total, 2)} s, x ${fixed(tool.x, 2)}, y ${fixed(tool.y, 2)} mm`;
}

let last = 0;
function tick(now) {
  if (!state.playing) return;
  const pace = +byId("pace").value, seconds = Math.min(0.1, (now - last) / 1000);
  last = now;
  const t = state.time + seconds * (pace ? A().total / pace : 1);
  setTime(t);
  if (t >= A().total) play(false);
  else requestAnimationFrame(tick);
}
function play(on) {
  state.playing = on;
  byId("play").textContent = on ? "pause" : "play";
  if (!on) return;
  if (state.time >= A().total) setTime(0);
  last = performance.now();
  requestAnimationFrame(tick);
}

function start() {
  readTheme();
  fillSummary();
  fillProvenance();
  if (!ENTRIES.length) {
    // Every method is left out, and why is said: there is nothing to draw.
    byId("bar").hidden = true;
    for (const section of document.querySelectorAll("section")) section.hidden = !section.querySelector("#summary, #provenance");
    return;
  }
  ENTRIES.forEach((e, i) => {
    byId("a").append(element("option", e.label, { value: i }));
    byId("b").append(element("option", e.label, { value: i }));
  });
  byId("b").prepend(element("option", "none", { value: -1 }));
  new Panel("maps", "measured", () => mapContent(A().run.measured, "measured" + A().run.name));
  new Panel("maps", "desired", () => mapContent(A().run.desired, "desired" + A().run.name));
  new Panel("maps", "removal", () => mapContent(A().removal, "removal" + state.a, { title: "predicted removal: " + A().label }));
  new Panel("maps", "residual", () => mapContent(A().residual, "residual" + state.a, { title: "residual: " + A().label }));
  new Panel("maps", "residual-b", () => B() && mapContent(B().residual, "residual" + state.b, { title: "residual: " + B().label }));
  new Panel("maps", "difference", () => B() && mapContent(difference(), "difference" + state.a + "," + state.b, { title: `residual of ${A().label} - residual of ${B().label}` }));
  new Panel("paths", "frame", () => {
    const layer = frameAt(A(), state.time);
    return layer && mapContent(layer, "frame" + layer.key, { title: layer.title });
  });
  new Panel("paths", "path", () => pathContent(A()));
  new Panel("paths", "path-b", () => pathContent(B()));
  new Panel("dwells", "dwell", () => dwellContent(A(), "planned"));
  new Panel("dwells", "dwell-error", () => dwellContent(A(), "error"));
  new Panel("dwells", "dwell-error-b", () => B() && dwellContent(B(), "error"));
  for (const [name] of CHARTS) listenToChart(byId(name));
  for (const canvas of document.querySelectorAll("canvas.chart")) {
    const caption = element("figcaption");
    caption.append(element("span", ""), saveButton(canvas, canvas.id));
    canvas.before(caption);
  }
  byId("a").addEventListener("change", (event) => showMethod(+event.target.value, state.b));
  byId("b").addEventListener("change", (event) => showMethod(state.a, +event.target.value));
  byId("scale").addEventListener("change", (event) => { state.scale = event.target.value; redraw(); });
  byId("zoom-in").addEventListener("click", () => zoom(0.6, null));
  byId("zoom-out").addEventListener("click", () => zoom(1 / 0.6, null));
  byId("zoom-all").addEventListener("click", showAll);
  byId("time").addEventListener("input", (event) => setTime((A().total * event.target.value) / 1000));
  byId("play").addEventListener("click", () => play(!state.playing));
  byId("npy").addEventListener("change", (event) => event.target.files[0] && loadFull(event.target.files[0]));
  const themed = () => { readTheme(); redraw(); };
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", themed);
  window.addEventListener("beforeprint", () => { document.documentElement.classList.add("paper"); readTheme(); drawAll(); });
  window.addEventListener("afterprint", () => { document.documentElement.classList.remove("paper"); themed(); });
  new ResizeObserver(redraw).observe(document.body);
  const best = ENTRIES.findIndex((e) => e.method.name === e.run.best);
  showMethod(best < 0 ? ENTRIES.length - 1 : best, -1);
  drawAll();
}
start();

// For tests.
window.planish = { DATA, ENTRIES, RUNS, state, valueAt, panels, drawAll, zoom, toolAt };
