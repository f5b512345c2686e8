// What a panel shows of a path: its speed, and where the tool is.

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

/** The value below which this fraction of the values lies. */
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
    marks: worstPlaces(entry),
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
  if (isStill(entry)) return [];
  const { steps, ...checks } = entry.method.limits;
  const times = [...Object.values(checks).flat().flatMap((check) => check.worst.map((w) => w[0])), ...steps];
  return times.map((t) => toolAt(entry, t)).map((p) => ({ at: [p.x, p.y], colour: alarm(entry) }));
}
