// What a panel shows of the dwell times.

function dwellContent(entry, kind) {
  const d = entry && entry.dwell();
  if (!d || !d[kind]) return null;
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
      // The squares of all points cover most of the picture, and neighbours on the path leave no gap.
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
      const point = `point ${i * entry.method.dwell.every}: planned ${number(d.planned[i], 5)} s`;
      return !d.executed ? point : `${point}, executed ${number(d.executed[i], 5)} s, difference ${number(d.error[i], 3)} s`;
    },
  };
}
