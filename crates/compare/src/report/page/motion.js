// Velocity, acceleration and jerk against time.

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
        ctx.fillStyle = alarm(entry);
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
        ctx.fillStyle = alarm(entry);
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
